"""Certificates end at night: who runs nodes is told in time, every day, and of every fault."""

from __future__ import annotations

import datetime as dt
import io
import threading
from pathlib import Path

import pytest
from vla_zenoh_secure.lab_certificates import LabCertificates

from vla_zenoh.cli import status_table
from vla_zenoh.cli.output import Screen
from vla_zenoh.profile import Profile, load_profile, override
from vla_zenoh.profile.schema import SecurityProfile
from vla_zenoh.runtime import launch
from vla_zenoh.runtime.certificate_expiry import (
    LOOK_PERIOD_S,
    TELL_PERIOD_S,
    CertificateExpiry,
    ExpiryOutlook,
    outlook,
)
from vla_zenoh.security.roles import Identity, Role
from vla_zenoh.types import NodeStatus

NOW = dt.datetime(2026, 3, 1, 12, tzinfo=dt.UTC)
HOST = "gpu"
PATIENCE_S = 20.0


@pytest.fixture
def security(tmp_path: Path) -> SecurityProfile:
    """One certificate for 50 days, one for 40."""
    store = LabCertificates(tmp_path)
    store.make_authority("test lab", NOW)
    store.add([Identity(Role.WORKER, "worker-a", HOST, worker="a")], NOW, days=50)
    store.add([Identity(Role.VIEWER, "viewer", HOST)], NOW, days=40)
    return SecurityProfile(folder=str(tmp_path), host=HOST)


class Time:
    """A clock that is set by hand."""

    def __init__(self) -> None:
        self.s = 0.0

    def monotonic(self) -> float:
        return self.s

    def now(self) -> dt.datetime:
        return NOW + dt.timedelta(seconds=self.s)


def days(count: float) -> float:
    return count * 24 * 3600.0


def test_what_ends_soon_is_told_beside_what_has_ended(security: SecurityProfile) -> None:
    assert outlook(security, NOW) == ExpiryOutlook(40)
    soon = outlook(security, NOW + dt.timedelta(days=20))
    assert [said.partition("viewer.pem ")[2] for said in soon.wrong] == [
        "ends in 20 days; renew it"
    ]
    later = outlook(security, NOW + dt.timedelta(days=45))
    assert later.days == -5
    said = sorted(what.rpartition("/")[2] for what in later.wrong)
    assert said == [
        "viewer.pem expired on 2026-04-10; renew it",
        "worker-a.pem ends in 5 days; renew it",
    ]


def test_it_is_told_when_it_begins_and_once_a_day_from_then_on(security: SecurityProfile) -> None:
    time = Time()
    expiry = CertificateExpiry(security, time.monotonic, time.now)
    told: dict[int, int] = {}
    for third in range(8 * 3, 16 * 3):
        time.s = days(third / 3)
        told[third // 3] = told.get(third // 3, 0) + len(expiry.due())
        assert expiry.due() == ()
    assert [day for day in told if told[day]] == list(range(10, 16))
    assert all(told[day] <= 2 * len(("viewer", "worker-a")) for day in told)


def test_a_certificate_that_is_renewed_is_told_of_no_more(security: SecurityProfile) -> None:
    time = Time()
    expiry = CertificateExpiry(security, time.monotonic, time.now)
    time.s = days(45)
    assert len(expiry.due()) == 2
    renewed = [Identity(Role.VIEWER, "viewer", HOST)]
    LabCertificates(security.folder).add(renewed, time.now(), renew=True)
    time.s += LOOK_PERIOD_S
    (left,) = expiry.due()
    assert "worker-a.pem" in left
    time.s += TELL_PERIOD_S / 2
    assert len(expiry.due()) <= 1


def test_a_computer_that_cannot_say_which_it_is_says_so_once(security: SecurityProfile) -> None:
    LabCertificates(security.folder).add([Identity(Role.VIEWER, "viewer", "wall")], NOW)
    time = Time()
    expiry = CertificateExpiry(security.model_copy(update={"host": None}), time.monotonic, time.now)
    (said,) = expiry.due()
    assert "gpu, wall" in said
    time.s = days(3)
    assert expiry.due() == ()


def test_without_certificates_there_is_nothing_to_tell() -> None:
    assert CertificateExpiry(None).due() == ()
    assert CertificateExpiry(None).outlook == ExpiryOutlook()


def secured(folder: str) -> Profile:
    return override(
        load_profile("panda_sim"),
        {
            "session": {
                "listen": ["tls/127.0.0.1:7447"],
                "connect": ["tls/127.0.0.1:7447"],
                "security": {"folder": folder, "host": HOST},
            },
            "hosts": {
                HOST: {"nodes": ["worker"]},
                "robot": {"nodes": ["router", "sim", "command", "camera"]},
            },
        },
    )


def test_up_tells_of_certificates_while_its_nodes_run(tmp_path: Path) -> None:
    store, now = LabCertificates(tmp_path), dt.datetime.now(dt.UTC)
    store.make_authority("test lab", now)
    store.add([Identity(Role.WORKER, "worker-scripted", HOST, worker="scripted")], now, days=5)
    store.add([Identity(Role.VIEWER, "viewer", HOST)], now - dt.timedelta(days=9), days=3)
    told: list[str] = []
    ended, heard = threading.Event(), threading.Event()

    def tell(node: str, sentence: str) -> None:
        if node == "up":
            told.append(sentence)
        if len(told) == 2:
            heard.set()

    host = launch.Host(secured(str(tmp_path)), HOST, log=lambda *_: None, tell=tell)
    serving = threading.Thread(target=host.serve, args=(ended,))
    serving.start()
    try:
        assert heard.wait(PATIENCE_S), told
    finally:
        ended.set()
        serving.join()
        host.stop()
    assert any("worker-scripted.pem ends in 4 days" in said for said in told)
    assert any("viewer.pem expired on" in said for said in told)


def shown(detail: dict[str, object]) -> str:
    router = NodeStatus("router", "routing", "robot", 1, 2, detail=detail)
    screen = Screen(file=io.StringIO(), width=200)
    screen.print(status_table.render("panda", {"router": (router, 0.1, True)}, []))
    assert isinstance(screen.file, io.StringIO)
    return screen.file.getvalue()


def test_status_shows_how_long_certificates_last_and_what_is_wrong_above_all() -> None:
    assert "certificates last 200 days" in shown({"certificates": {"days": 200, "wrong": []}})
    wrong = ["camera.pem ends in 3 days; renew it"]
    said = shown({"certificates": {"days": 3, "wrong": wrong}})
    assert said.splitlines()[0] == f"certificates of router on robot: {wrong[0]}"


@pytest.mark.parametrize("said", [5, "x", {"days": "[/x]", "wrong": 7}, {"wrong": [["\x1b[2J"]]}])
def test_a_router_that_lies_of_its_certificates_breaks_nothing(said: object) -> None:
    assert "\x1b" not in shown({"certificates": said})
