"""Where a node says that it runs, and when two are certainly on one computer."""

from __future__ import annotations

from pathlib import Path

import pytest

from vla_zenoh.bus.host import HOST_VARIABLE, HostId, own_boot_id, own_host_id
from vla_zenoh.errors import ProfileError
from vla_zenoh.profile import SessionProfile
from vla_zenoh.profile.schema import SecurityProfile
from vla_zenoh.security.store import THIS_HOST

PLAIN = SessionProfile()
COMPUTER = "ubuntu"


@pytest.fixture(autouse=True)
def computer(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("socket.gethostname", lambda: COMPUTER)
    monkeypatch.delenv(HOST_VARIABLE, raising=False)


def secured(folder: Path, host: str | None = None) -> SessionProfile:
    endpoints = ("tls/10.0.0.2:7447",)
    security = SecurityProfile(folder=str(folder), host=host)
    return SessionProfile(connect=endpoints, listen=endpoints, security=security)


def test_a_host_is_what_somebody_said_or_else_the_computers_own_name(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    assert own_host_id(PLAIN).host == COMPUTER
    monkeypatch.setenv(HOST_VARIABLE, "gpu")
    assert own_host_id(PLAIN).host == "gpu"
    assert own_host_id(PLAIN, "desk").host == "desk"


def test_with_certificates_it_is_the_host_whose_they_are(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert own_host_id(secured(tmp_path)).host == COMPUTER  # there are none
    for name in ("gpu", "robot"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "ca.pem").touch()
    assert own_host_id(secured(tmp_path)).host == COMPUTER  # it may be either
    (tmp_path / THIS_HOST).write_text("gpu\n")
    assert own_host_id(secured(tmp_path)).host == "gpu"
    monkeypatch.setenv(HOST_VARIABLE, "desk")
    assert own_host_id(secured(tmp_path)).host == "desk"
    assert own_host_id(secured(tmp_path, "robot")).host == "robot"


def test_what_cannot_be_a_host_is_refused() -> None:
    with pytest.raises(ProfileError, match="host 'a/b' cannot be"):
        own_host_id(PLAIN, "a/b")


def test_every_node_of_a_computer_knows_its_start() -> None:
    assert own_host_id(PLAIN, "a").boot == own_host_id(PLAIN, "b").boot == own_boot_id()


@pytest.mark.skipif(not Path("/proc/sys/kernel").exists(), reason="Linux alone tells it")
def test_the_start_of_a_computer_is_told() -> None:
    assert len(own_boot_id()) == 36


def test_clocks_are_shared_where_name_and_start_are_the_same_and_known() -> None:
    here = HostId("ubuntu", "1")
    assert here.shares_clock(HostId("ubuntu", "1"))
    assert not here.shares_clock(HostId("ubuntu", "2"))  # a copy of this computer
    assert not here.shares_clock(HostId("gpu", "1"))
    assert not HostId("ubuntu", "").shares_clock(HostId("ubuntu", ""))
