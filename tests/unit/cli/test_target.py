"""What a command tells people to type: it leads to the robot that it spoke of."""

from __future__ import annotations

import shlex
import socket
from pathlib import Path

import pytest
from camera_rig import free_endpoint, until

from vla_zenoh.bus.session import open_session
from vla_zenoh.cli.stop import StopAttempt
from vla_zenoh.cli.target import RobotTarget
from vla_zenoh.cli.up import target_of
from vla_zenoh.client.client import Client
from vla_zenoh.errors import ProfileError
from vla_zenoh.profile import load_profile, override
from vla_zenoh.resources import names
from vla_zenoh.runtime.launch import Host

VARIABLES = ("VLA_ZENOH_PROFILE", "VLA_ZENOH_CONNECT", "VLA_ZENOH_HOST")


@pytest.fixture(autouse=True)
def nothing_said_before(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in VARIABLES:
        monkeypatch.delenv(name, raising=False)


def test_what_is_usual_is_not_typed() -> None:
    assert RobotTarget().typed("stop") == "vla-zenoh stop"


def test_what_was_said_is_typed_again() -> None:
    aim = RobotTarget("./my lab.yaml", ["tcp/10.0.0.2:7447", "tcp/10.0.0.3:7447"], "gpu")
    assert shlex.split(aim.typed("prompt", "go up")) == [
        *("vla-zenoh", "prompt", "go up", "--profile", "./my lab.yaml"),
        *("--connect", "tcp/10.0.0.2:7447", "--connect", "tcp/10.0.0.3:7447", "--host", "gpu"),
    ]
    assert "--robot" not in aim.typed("stop")
    assert aim.typed("stop", robot="ur", host="desk").endswith("--host desk --robot ur")
    assert RobotTarget(robot="ur").typed("reset") == "vla-zenoh reset --robot ur"


def test_the_usual_profile_is_typed_where_the_environment_names_another(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("VLA_ZENOH_PROFILE", "ur5")
    assert RobotTarget().typed("stop") == "vla-zenoh stop --profile panda_sim"


def test_another_robot_has_the_profile_of_this_one() -> None:
    profile = RobotTarget("panda_sim", ["tcp/10.0.0.2:7447"], robot="ur").load()
    assert profile.keys.stop == "vla/ur/stop"
    assert profile.session.connect == ("tcp/10.0.0.2:7447",)
    assert profile.robot.description == load_profile("panda_sim").robot.description


@pytest.mark.parametrize("name", names("profiles"))
def test_a_stop_leads_where_the_whole_profile_does(name: str) -> None:
    whole, brief = load_profile(name), RobotTarget(name).load_for_stop()
    assert brief.keys == whole.keys
    assert brief.part_names == whole.part_names
    assert brief.session == whole.session
    assert brief.name == whole.name


FAULTS = """
robot: {driver: none_of_that_name, description: ./gone.urdf}
cameras: {front: {sauce: 3}}
limits: {contact: 7}
colour: red
workers: [a, a]
"""


def test_a_stop_needs_nothing_that_is_wrong_elsewhere_in_the_profile(tmp_path: Path) -> None:
    file = tmp_path / "lab.yaml"
    file.write_text(f"extends: panda_sim\nroot: lab{FAULTS}")
    with pytest.raises(ProfileError):
        load_profile(str(file))
    there = ["tcp/10.0.0.2:7447"]
    brief = RobotTarget(str(file), there, robot="ur").load_for_stop()
    assert brief.keys.stop == "lab/ur/stop"
    assert brief.session.connect == tuple(there)


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ("session: {connect: [nowhere]}", "lab.yaml:2: session.connect.0"),
        ("session: {lease: 3}", "lab.yaml:2: session.lease: unknown key"),
        ("robot: {name: a/b}", "lab.yaml:2: robot.name"),
        ("robot: 3", "lab.yaml:2: robot"),
    ],
)
def test_what_a_stop_needs_is_checked(text: str, named: str, tmp_path: Path) -> None:
    file = tmp_path / "lab.yaml"
    file.write_text(f"extends: panda_sim\n{text}\n")
    with pytest.raises(ProfileError) as caught:
        RobotTarget(str(file)).load_for_stop()
    assert named in str(caught.value)


def test_a_stop_knows_the_hosts_of_the_profile() -> None:
    with pytest.raises(ProfileError, match="has no host 'nowhere'"):
        RobotTarget("panda_sim", host="nowhere").load_for_stop()


@pytest.mark.parametrize(
    ("connect", "words"), [((), []), (("tcp/10.0.0.2:7447",), ["--connect", "tcp/10.0.0.2:7447"])]
)
def test_up_tells_what_leads_to_its_robot_from_any_folder(
    connect: tuple[str, ...], words: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = tmp_path / "ur5.yaml"
    file.write_text("extends: panda_sim\nrobot: {name: ur5}\n")
    monkeypatch.chdir(tmp_path)
    profile = load_profile("./ur5.yaml")
    if connect:
        profile = override(profile, {"session": {"connect": list(connect)}})
    host = Host(profile, None, log=print, tell=print)
    try:
        typed = target_of("./ur5.yaml", host).typed("stop")
    finally:
        host.stop()
    assert shlex.split(typed) == ["vla-zenoh", "stop", "--profile", str(file), *words]


def test_up_tells_of_a_router_that_its_host_alone_goes_to() -> None:
    host = Host(load_profile("panda_sim_two_sites"), "gpu", log=print, tell=print)
    try:
        typed = target_of("panda_sim_two_sites", host).typed("status")
    finally:
        host.stop()
    assert typed == ("vla-zenoh status --profile panda_sim_two_sites --connect tcp/127.0.0.1:7467")


def test_a_router_that_is_gone_or_hangs_is_named_by_its_endpoint() -> None:
    where = free_endpoint()
    aim = RobotTarget("panda_sim", [where])
    profile = override(aim.load(), {"session": {"listen": [where]}})
    router = open_session(profile.session, mode="router")
    with open_session(profile.session) as session:
        client = Client(profile, session)
        assert "no command node of robot panda" in aim.no_node(client, kind="command node")
        router.close()
        until("the link is lost", lambda: not session.info.routers_zid())
        assert f"no Zenoh router answers at {where} any more" in aim.no_node(client)
    with socket.create_server(("127.0.0.1", int(where.rpartition(":")[2]))):  # no Zenoh there
        attempt = StopAttempt(aim, aim.load_for_stop(), every=False)
        assert attempt.why == f"the router at {where} does not answer"
        attempt.over.set()
