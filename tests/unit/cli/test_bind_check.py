"""Ports without certificates stay on this computer, unless somebody says what he means."""

from __future__ import annotations

import re
from pathlib import Path
from threading import Event

import pytest
from typer.testing import CliRunner

from vla_zenoh.errors import SecurityError
from vla_zenoh.lab.cli.loopback import require_loopback
from vla_zenoh.lab.recording.writer import RecordingWriter
from vla_zenoh.profile import Profile, load_profile, override, to_yaml
from vla_zenoh.program.main import app

SERVE = ("serve", "policy", "--worker", "no_such_model", "--port", "8123")
VIEW = ("view", "--serve", "--port", "9123", "--seconds", "0.1")


def door(profile: Profile, address: str) -> None:
    require_loopback(profile, "--bind", address, "look", "leave it out")


@pytest.mark.parametrize("address", ["127.0.0.1", "127.3.2.1", "::1", "localhost"])
def test_on_this_computer_a_door_may_be_plain(address: str) -> None:
    door(load_profile("panda_sim"), address)


@pytest.mark.parametrize("address", ["0.0.0.0", "::", "10.0.0.2", "fe80::1%eth0", "", "a-computer"])
def test_on_a_network_it_may_not(address: str) -> None:
    with pytest.raises(SecurityError, match="anyone on that network look: leave it out"):
        door(load_profile("panda_sim"), address)


def test_who_says_insecure_means_it() -> None:
    door(override(load_profile("panda_sim"), {"session": {"insecure": True}}), "0.0.0.0")


def test_a_secured_profile_is_not_told_to_become_insecure() -> None:
    endpoints = ["tls/10.0.0.2:7447"]
    session = {"listen": endpoints, "connect": endpoints, "security": {}}
    with pytest.raises(SecurityError, match=r"look: leave it out$"):
        door(override(load_profile("panda_sim"), {"session": session}), "0.0.0.0")
    with pytest.raises(SecurityError, match=r"set session\.insecure: true in profile panda_sim$"):
        door(load_profile("panda_sim"), "0.0.0.0")


def said(*words: str) -> str:
    """What a command that is refused says, in one line."""
    done = CliRunner().invoke(app, words)
    assert done.exit_code == 1
    return re.sub(r"\s+", " ", f"{done.exception or ''} {done.output}")


def test_pictures_are_not_served_to_a_network() -> None:
    why = said(*VIEW, "--bind", "0.0.0.0")
    assert "--bind 0.0.0.0 lets anyone on that network look through the cameras" in why
    assert "`ssh -L 9123:127.0.0.1:9123 -L 9124:127.0.0.1:9124 THIS_COMPUTER`" in why


def test_nor_those_of_a_recording(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("vla_zenoh_view.cli.stop_on_signals", Event)
    path, profile = tmp_path / "run.mcap", load_profile("panda_sim")
    text = to_yaml(profile)
    RecordingWriter(path, profile.keys, profile_yaml=text, base_frame="base", began_ns=1).finish()
    assert "look through the cameras" in said("view", str(path), *VIEW[1:], "--bind", "0.0.0.0")


def test_a_model_is_not_served_to_a_network_without_a_key(tmp_path: Path) -> None:
    why = said(*SERVE, "--host", "0.0.0.0")
    assert "--host 0.0.0.0 lets anyone on that network use this model without a key" in why
    assert "give --api-key KEY" in why
    for more in (("--host", "0.0.0.0", "--api-key", "k"), ("--host", "127.0.0.1")):
        assert "no_such_model" in said(*SERVE, *more)  # which is looked for only then
    open_ = tmp_path / "open.yaml"
    open_.write_text("extends: panda_sim\nsession: {insecure: true}\n")
    assert "no_such_model" in said(*SERVE, "--host", "0.0.0.0", "--profile", str(open_))


def test_the_page_is_not_served_to_a_network_without_tls(tmp_path: Path) -> None:
    for address in ("0.0.0.0", "::", "10.0.0.2", "a-computer"):
        why = said("web", "--bind", address)
        assert "without TLS anyone on that network could read the tokens and drive" in why
        assert "Give --certificate and --key" in why
    file = tmp_path / "cert.pem"
    assert "together" in said("web", "--bind", "0.0.0.0", "--certificate", str(file))
    why = said("web", "--bind", "0.0.0.0", "--certificate", str(file), "--key", str(file))
    assert "cert.pem is not there" in why
