"""``vla-zenoh node router``: ours, and its configuration for the program zenohd."""

from __future__ import annotations

import datetime as dt
import json
import shutil
import subprocess
import threading
from pathlib import Path

import pytest
import zenoh
from camera_rig import free_endpoint, until
from typer.testing import CliRunner
from vla_zenoh_secure.lab_certificates import LabCertificates
from vla_zenoh_secure.secure_profile import profile_text, serving_addresses

from vla_zenoh.bus.buffers import CallbackRing
from vla_zenoh.bus.session import open_session
from vla_zenoh.errors import SecurityError
from vla_zenoh.profile import load_profile
from vla_zenoh.program.main import app
from vla_zenoh.runtime.router import router_config, run_router
from vla_zenoh.security.roles import access_control, identities

LIMIT_S = 20.0


def secured(folder: Path) -> Path:
    """A lab with certificates, at a free port of this computer."""
    plain = folder / "plain.yaml"
    endpoint = free_endpoint()
    plain.write_text(
        f"extends: panda_sim\nsession: {{listen: [{endpoint}], connect: [{endpoint}]}}\n"
    )
    profile, store, now = (
        load_profile(str(plain)),
        LabCertificates(folder / "keys"),
        dt.datetime.now(dt.UTC),
    )
    store.make_authority("test lab", now)
    store.add(identities(profile), now, addresses=serving_addresses(profile))
    file = folder / "lab.yaml"
    file.write_text(profile_text(profile, "plain", store.folder))
    return file


def test_the_configuration_is_one_that_zenoh_takes(tmp_path: Path) -> None:
    profile = load_profile(str(secured(tmp_path)))
    settings = router_config(profile)
    zenoh.Config.from_json5(json.dumps(settings))
    assert settings["access_control"] == access_control([profile])
    tls = settings["transport"]["link"]["tls"]
    assert tls["enable_mtls"]
    assert tls["listen_certificate"].endswith("here/router.pem")


def test_the_command_prints_the_configuration_that_our_own_router_has(tmp_path: Path) -> None:
    file = secured(tmp_path)
    shown = CliRunner().invoke(app, ["node", "router", "--profile", str(file), "--config"])
    assert shown.exit_code == 0, shown.output
    assert json.loads(shown.stdout) == router_config(load_profile(str(file)))


@pytest.mark.skipif(shutil.which("zenohd") is None, reason="there is no zenohd on PATH")
def test_a_real_zenohd_lets_each_do_its_part_and_no_more(tmp_path: Path) -> None:
    profile = load_profile(str(secured(tmp_path)))
    file = tmp_path / "zenohd.json5"
    file.write_text(json.dumps(router_config(profile)))
    words = ["zenohd", "--config", str(file)]
    program = subprocess.Popen(words, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    keys, heard = profile.keys, CallbackRing(16)
    try:
        with (
            open_session(profile.session, identity="command", wait_s=LIMIT_S) as command,
            open_session(profile.session, identity="worker-scripted") as worker,
            open_session(profile.session, identity="camera") as camera,
        ):
            handler = zenoh.handlers.Callback(heard, indirect=False)
            reader = command.declare_subscriber(keys.all_deltas, handler)
            own = worker.declare_publisher(keys.delta("scripted"))
            until("the command node", lambda: own.matching_status.matching)
            for session, key in (
                (worker, keys.delta("other")),
                (worker, keys.prompt),
                (camera, keys.delta("scripted")),
            ):
                session.put(key, "not mine")
            own.put("mine")
            until("the chunk", lambda: heard._arrivals)
            said = [arrival.sample.payload.to_string() for arrival in heard.drain()]
            assert said == ["mine"]
            own.undeclare()
            reader.undeclare()
    finally:
        program.terminate()
        program.wait(LIMIT_S)


def test_a_router_without_its_certificate_says_how_to_get_one(tmp_path: Path) -> None:
    profile = load_profile(str(secured(tmp_path)))
    (tmp_path / "keys" / "here" / "router.key").unlink()
    with pytest.raises(SecurityError, match=r"[Mm]ake it with `vla-zenoh secure add here`"):
        run_router(profile, threading.Event())


def test_status_says_in_red_that_strangers_may_command(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    endpoint = free_endpoint()
    file = tmp_path / "open.yaml"
    session = f"{{listen: [{endpoint}], connect: [{endpoint}], insecure: true}}"
    file.write_text(f"extends: panda_sim\nsession: {session}\n")
    stop = threading.Event()
    profile = load_profile(str(file))
    thread = threading.Thread(target=run_router, args=(profile, stop))
    thread.start()
    monkeypatch.setenv("FORCE_COLOR", "1")
    monkeypatch.setenv("COLUMNS", "200")
    try:
        open_session(profile.session, wait_s=LIMIT_S).close()  # it listens
        shown = CliRunner().invoke(app, ["status", "--once", "--profile", str(file)])
    finally:
        stop.set()
        thread.join(LIMIT_S)
    red = [line for line in shown.output.splitlines() if "\x1b[1;31m" in line]
    assert any("insecure: anyone on the network can command" in line for line in red), shown
