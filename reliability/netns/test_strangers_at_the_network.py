"""Three hosts with certificates move the arm; whoever has none of these, or too little, does not.

Real namespaces, a real router with mutual TLS and access control, a real session for each attempt;
each result is looked at from the attacker's side and from the robot's. What the attacker does would
move the arm, stop it and put its simulation back: done by an operator, at last, it does.
"""

from __future__ import annotations

import datetime as dt
import json
import shutil
import sys
from collections.abc import Callable, Iterator
from typing import Any

import pytest
from netns.attack import MARK, MOTION, RATE
from netns.lab import needs_namespaces
from netns.site import HERE, Site, secured_site
from vla_zenoh_secure.lab_certificates import LabCertificates

from vla_zenoh.bus.session import session_config
from vla_zenoh.profile import load_profile, override
from vla_zenoh.security.roles import Identity, Role

pytestmark = [pytest.mark.netns, pytest.mark.slow, needs_namespaces, pytest.mark.timeout(240)]

PORT = 7447
STEPS, STEP_M, TOLERANCE_M = 10, 0.01, 0.001
STILL_M = 0.001
"""An arm that nobody moves stays within this."""
MOVED_M = 0.05
"""An arm that obeys the attacker goes down 0.1 m."""
RATE_HZ = float(RATE)
OTHER = "other"
NODES = ["camera", "command", "rolling", "router", "sim", "worker-scripted"]
PLAIN = f"""\
extends: panda_sim_two_hosts
cameras:
  front: {{source: "sim:front", width: 160, height: 120, rate_hz: 20}}
  wrist: null
session:
  listen: [tcp/127.0.0.1:{PORT}]
  connect: [tcp/127.0.0.1:{PORT}]
hosts:
  robot: {{nodes: [router, sim, camera, command]}}
  gpu: {{nodes: [worker], connect: ["tcp/127.0.0.1:{PORT}"]}}
"""


@pytest.fixture(scope="module")
def site() -> Iterator[Site]:
    with secured_site(PLAIN, ("robot", "gpu", "desk", "strange"), ("robot",)) as made:
        made.add("desk", "operator")
        made.add("wall", "viewer")
        made.equip("robot", "gpu", "desk")
        made.up("robot", "gpu")
        yield made


def test_three_hosts_with_certificates_carry_out_the_motion(site: Site) -> None:
    found = site.drive("desk", "up", STEPS)
    assert found["way_m"] == pytest.approx([0.0, 0.0, STEPS * STEP_M], abs=TOLERANCE_M)
    assert found["jpeg"] > 0  # pictures crossed the network as JPEG ...
    assert found["raw"] == 0  # ... and none as pixels
    assert found["refused"] == {}


def plain_tcp(site: Site) -> dict[str, Any]:
    profile = load_profile("panda_sim")
    return session_config(profile.session, connect=(f"tcp/{site.hosts['robot'].address}:{PORT}",))


def with_files(site: Site, store: LabCertificates, host: str, node: str) -> dict[str, Any]:
    """The configuration that shows this certificate."""
    lab_profile = load_profile(str(site.folder / "plain_secure.yaml"))
    changes = {"session": {"security": {"folder": str(store.folder), "host": host}}}
    return session_config(override(lab_profile, changes).session, identity=node)


def no_certificate(site: Site) -> dict[str, Any]:
    found = with_files(site, site.store, "wall", "viewer")
    tls = found["transport"]["link"]["tls"]
    tls["enable_mtls"] = False
    del tls["connect_private_key"], tls["connect_certificate"]
    return found


def another_authority(site: Site) -> dict[str, Any]:
    """An operator, says a certificate that somebody else's lab made."""
    other, now = LabCertificates(site.folder / "other"), dt.datetime.now(dt.UTC)
    other.make_authority("vla-zenoh lab", now)
    other.add([Identity(Role.OPERATOR, "operator", "desk")], now)
    found = with_files(site, other, "desk", "operator")
    # It knows the lab's own authority, so that nothing on its side refuses the router.
    found["transport"]["link"]["tls"]["root_ca_certificate"] = str(site.store.folder / "ca.pem")
    return found


def expired(site: Site) -> dict[str, Any]:
    """An operator of this lab, until two days ago."""
    old, now = LabCertificates(site.folder / "old"), dt.datetime.now(dt.UTC)
    for name in ("ca.pem", "ca.key"):
        old.folder.mkdir(exist_ok=True)
        shutil.copy(site.store.folder / name, old.folder / name)
    long_ago = now - dt.timedelta(days=4)
    old.add([Identity(Role.OPERATOR, "operator", "desk")], long_ago, days=2)
    return with_files(site, old, "desk", "operator")


def unknown_name(site: Site) -> dict[str, Any]:
    """A certificate of this lab about somebody whom the profile does not name."""
    more, now = LabCertificates(site.folder / "more"), dt.datetime.now(dt.UTC)
    for name in ("ca.pem", "ca.key"):
        more.folder.mkdir(exist_ok=True)
        shutil.copy(site.store.folder / name, more.folder / name)
    more.add([Identity(Role.OPERATOR, "operator", "attic")], now)
    return with_files(site, more, "attic", "operator")


def viewer(site: Site) -> dict[str, Any]:
    return with_files(site, site.store, "wall", "viewer")


def camera(site: Site) -> dict[str, Any]:
    """The camera's own certificate, in the hands of a thief."""
    return with_files(site, site.store, "robot", "camera")


def worker(site: Site) -> dict[str, Any]:
    """A worker's certificate, in the hands of a thief."""
    return with_files(site, site.store, "gpu", "worker-scripted")


def attack(site: Site, settings: dict[str, Any]) -> tuple[dict[str, Any], dict[str, Any]]:
    """What the attacker got, and what the robot's host saw of it."""
    file = site.folder / "attack.json"
    file.write_text(json.dumps(settings))
    watching = site.hosts["robot"].talk(
        sys.executable, str(HERE / "watch.py"), str(site.profile("robot")), MARK
    )
    assert watching.stdin is not None
    assert watching.stdout is not None
    assert watching.stdout.readline().strip() == "watching", site.logs()
    got = site.hosts["strange"].ask(HERE / "attack.py", str(file), "panda", OTHER)
    watching.stdin.write("\n")
    watching.stdin.flush()
    seen = watching.stdout.readline()
    assert watching.wait(60.0) == 0, site.logs()
    return got, json.loads(seen)


def nothing_came_of_it(seen: dict[str, Any]) -> None:
    assert seen["marked"] == {}
    assert seen["moved_m"] < STILL_M
    ((prompt, worker, rate_hz, active),) = seen["tasks"]  # one, from the beginning to the end
    assert prompt != MOTION
    assert MARK not in prompt
    assert (worker, active) == ("scripted", False)
    assert rate_hz != RATE_HZ
    assert seen["transitions"] == []
    assert seen["resets"] == 0
    assert seen["held"] == []
    assert seen["alive"] == NODES


@pytest.mark.parametrize(
    "who", [plain_tcp, no_certificate, another_authority, expired], ids=lambda who: who.__name__
)
def test_a_host_without_a_good_certificate_gets_no_session(
    site: Site, who: Callable[[Site], dict[str, Any]]
) -> None:
    got, seen = attack(site, who(site))
    assert not got["opened"], got
    nothing_came_of_it(seen)


def test_a_name_that_the_profile_does_not_know_hears_nothing_and_is_not_heard(site: Site) -> None:
    got, seen = attack(site, unknown_name(site))
    assert got["heard"] == {}
    assert got["answers"] == got["alive"] == 0
    nothing_came_of_it(seen)


def test_a_viewer_sees_states_but_no_picture_and_moves_nothing(site: Site) -> None:
    got, seen = attack(site, viewer(site))
    assert got["opened"]
    assert got["heard"]["state/pose"] > 0
    assert not any(key.startswith(("camera/", "seen/", "sim/scene")) for key in got["heard"])
    assert got["answers"] > 0
    nothing_came_of_it(seen)


def test_a_stolen_camera_reads_no_other_picture_and_moves_nothing(site: Site) -> None:
    got, seen = attack(site, camera(site))
    assert got["opened"]
    assert got["heard"] == {}
    nothing_came_of_it(seen)


def test_a_stolen_worker_speaks_for_no_other_worker_and_moves_nothing(site: Site) -> None:
    got, seen = attack(site, worker(site))
    assert got["opened"]
    assert not any(key.startswith("command/") for key in got["heard"])
    nothing_came_of_it(seen)


def operator(site: Site) -> dict[str, Any]:
    return with_files(site, site.store, "desk", "operator")


def test_the_same_attack_by_an_operator_does_all_that_strangers_did_not(site: Site) -> None:
    """Else the tests above would pass whatever a stranger may do."""
    try:
        got, seen = attack(site, operator(site))
    finally:
        site.vla("desk", "use", "scripted", "--profile", str(site.profile("desk")))
    assert got["opened"]
    assert any(key.startswith("camera/") for key in got["heard"])
    assert seen["moved_m"] > MOVED_M
    assert [MOTION, "scripted", RATE_HZ, True] in seen["tasks"]
    assert any(worker == MARK for _, worker, _, _ in seen["tasks"])
    assert any(what.endswith("->stopped") for what in seen["transitions"])
    assert any(what.startswith("stopped->") for what in seen["transitions"])
    assert seen["resets"] == 1
    assert seen["held"] == [MARK]
    # What nodes say, and that they live, is not for people either.
    assert not {"command/pose", f"delta/{OTHER}"} & seen["marked"].keys()
    assert seen["alive"] == NODES
