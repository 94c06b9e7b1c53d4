"""Which nodes a host starts, and how."""

from __future__ import annotations

import os
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any, cast, get_args

import pytest

from vla_zenoh import plugins
from vla_zenoh.bus.host import own_boot_id
from vla_zenoh.client.client import Client
from vla_zenoh.errors import ProfileError
from vla_zenoh.keys import LOADING, NODE_KINDS, OPENING, ROLLING, STARTING
from vla_zenoh.profile import Profile, load_profile
from vla_zenoh.profile.robot import RobotProfile
from vla_zenoh.profile.schema import NodeKind
from vla_zenoh.program.main import COMMANDS, CommandGroup
from vla_zenoh.runtime.launch import Host, node_commands, still_starting
from vla_zenoh.runtime.supervisor import STOP_ORDER
from vla_zenoh.types import NodeStatus

FILE = Path("mine.yaml")
OTHERS = (Path("left.yaml"), Path("right.yaml"))


def words_of(profile: Profile, host: str, kind: str, *also: Path) -> tuple[str, ...]:
    """The command line of the only node of a kind."""
    found = node_commands(profile, host, FILE, also_files=also)
    (words,) = [each.arguments for each in found if each.kind == kind]
    return words


def test_nodes_start_from_the_router_on_and_the_robot_stops_after_what_drives_it() -> None:
    robots = ["sim", "ros2", "arm"]
    assert list(NODE_KINDS) == [
        *("router", *robots, "command"),
        *("camera", "worker", "primitives"),
    ]
    assert [set(kinds) for kinds, _ in STOP_ORDER] == [
        {"worker", "primitives", "camera", "command"},
        {"sim", "ros2", "arm"},
        {"rolling"},
        {"router"},
    ]


def test_every_kind_of_node_may_stand_in_a_profile_and_every_robot_driver_is_one() -> None:
    assert set(get_args(NodeKind)) == set(NODE_KINDS)
    robots = {kind for kind, traits in NODE_KINDS.items() if traits.role == "robot"}
    drivers = plugins.installed(plugins.ROBOTS)
    assert robots == {RobotProfile.model_construct(driver=name).node for name in drivers}


def test_every_kind_of_node_has_a_command() -> None:
    nodes = COMMANDS["Run"]["node"]
    assert isinstance(nodes, CommandGroup)
    of_packages = {name.partition("node.")[2] for name in plugins.PACKAGES} - {""}
    assert {*nodes.commands, *of_packages, "worker"} == {*NODE_KINDS, ROLLING}
    assert "worker" in COMMANDS["Run"]


def test_the_router_is_told_of_every_robot_it_serves() -> None:
    words = words_of(load_profile("panda_sim_lab"), "robot", "router", *OTHERS)
    assert words[-4:] == ("--also", "left.yaml", "--also", "right.yaml")


def test_no_other_node_is_told_of_other_robots() -> None:
    profile = load_profile("panda_sim_lab")
    alone, among = (node_commands(profile, "robot", FILE, also_files=f) for f in ((), OTHERS))
    assert [c for c in among if c.kind != "router"] == [c for c in alone if c.kind != "router"]


def test_a_host_without_a_router_cannot_serve_other_robots_and_says_who_can() -> None:
    with pytest.raises(ProfileError, match=r"'gpu'.*no router.*; robot does"):
        node_commands(load_profile("panda_sim_lab"), "gpu", FILE, also_files=OTHERS)


def test_a_dry_run_is_for_the_command_node_alone() -> None:
    profile = load_profile("panda_sim")
    wet, dry = (node_commands(profile, "here", FILE, dry_run=dry) for dry in (False, True))
    for before, after in zip(wet, dry, strict=True):
        more = ("--dry-run",) if after.kind == "command" else ()
        assert after.arguments == (*before.arguments, *more)


def test_a_dry_run_where_nothing_commands_is_refused() -> None:
    with pytest.raises(ProfileError, match=r"'gpu'.*no command node"):
        node_commands(load_profile("panda_sim_lab"), "gpu", FILE, dry_run=True)


WORKER, ELSEWHERE = "worker-scripted", "ad9c3d40-11c5-4f0e-8a0b-0d3b1f6f2a77"


class Lab:
    """What a client hears of a lab, and whether the arm was told to brake."""

    def __init__(self, *statuses: NodeStatus) -> None:
        self.said = {status.node: status for status in statuses}
        self.alive = frozenset({"command", *self.said})
        self.braked = False

    def status(self, name: str) -> NodeStatus | None:
        return self.said.get(name)

    def deactivate(self, timeout_s: float) -> bool:
        self.braked = True
        return True


@pytest.fixture
def child() -> Iterator[tuple[subprocess.Popen[Any], int]]:
    """A node's process as `up` starts it, and the one that it has started in turn."""
    words = ["sh", "-c", "sleep 60 & echo $!; wait"]
    with subprocess.Popen(words, stdout=subprocess.PIPE, start_new_session=True) as process:
        assert process.stdout is not None
        yield process, int(process.stdout.readline())


def brakes(process: subprocess.Popen[Any], host: str, *said: NodeStatus) -> bool:
    """Whether a host that has started `process` as its first node brakes the arm when it ends."""
    lab = Lab(*said)
    up = Host(load_profile("panda_sim_lab"), host, log=lambda *_: None, tell=lambda *_: None)
    up.client, up.supervisor.children[0].process = cast("Client", lab), process
    up.stop()
    assert process.poll() is not None
    return lab.braked


def worker_at(pid: int, boot: str | None = None) -> NodeStatus:
    here = own_boot_id() if boot is None else boot
    return NodeStatus(WORKER, "inferring", "gpu", pid, 1, boot=here)


def test_a_host_whose_node_lives_brakes_before_it_ends(
    child: tuple[subprocess.Popen[Any], int],
) -> None:
    process, _ = child
    assert brakes(process, "gpu", worker_at(process.pid))


def test_so_does_one_whose_model_has_an_environment_of_its_own(
    child: tuple[subprocess.Popen[Any], int],
) -> None:
    process, started = child
    assert brakes(process, "gpu", worker_at(started))


def test_a_second_one_of_a_host_leaves_the_arm_of_the_lab_alone(
    child: tuple[subprocess.Popen[Any], int],
) -> None:
    process, _ = child  # on its way to be refused
    assert not brakes(process, "gpu", worker_at(os.getpid()))


def test_so_does_one_on_another_computer_where_the_numbers_of_processes_meet(
    child: tuple[subprocess.Popen[Any], int],
) -> None:
    process, _ = child
    assert not brakes(process, "gpu", worker_at(process.pid, ELSEWHERE))


def test_a_router_that_says_nothing_takes_part(child: tuple[subprocess.Popen[Any], int]) -> None:
    process, _ = child
    assert brakes(process, "robot")


@pytest.mark.parametrize(
    ("state", "detail", "said"),
    [
        ("streaming", {"cameras": {"front": {"why": OPENING}}}, ["camera 'front': " + OPENING]),
        (
            "streaming",
            {"cameras": {"front": {"why": f"{OPENING}: no scene yet"}, "wrist": {"why": ""}}},
            [f"camera 'front': {OPENING}: no scene yet"],
        ),
        ("streaming", {"cameras": {"front": {"why": "there is no file a.mp4"}}}, []),
        (STARTING, {"complaint": LOADING}, [f"node: {LOADING}"]),
        (STARTING, {}, ["node: it has not reported yet"]),
        ("inactive", {}, []),
    ],
)
def test_up_is_not_ready_while_a_camera_is_being_opened_or_a_model_loads(
    state: str, detail: dict[str, Any], said: list[str]
) -> None:
    assert still_starting(NodeStatus("node", state, "here", 1, 1, detail=detail)) == said
