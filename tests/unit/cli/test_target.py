"""What a command tells people to type: it leads to the robot that it spoke of."""

from __future__ import annotations

import shlex
from pathlib import Path

import pytest

from vla_zenoh.cli.target import RobotTarget
from vla_zenoh.cli.up import target_of
from vla_zenoh.profile import load_profile, override
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
