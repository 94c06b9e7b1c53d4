"""The gripper of a ROS 2 robot: whose orders it obeys, and what its goals are timed by."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest
from camera_rig import until
from ros2_peer import Ros2Peer
from ros2_rig import write_profile
from vla_zenoh_ros2.gripper import Gripper
from vla_zenoh_ros2.messages import Messages
from vla_zenoh_ros2.readers import SUCCEEDED
from vla_zenoh_ros2.ros_graph import RosGraph

from vla_zenoh.bus.clock import Clock
from vla_zenoh.bus.node import Node, Publisher
from vla_zenoh.bus.session import open_session
from vla_zenoh.guard.arm_guard import OLDEST_NS, ArmGuard
from vla_zenoh.keys import Kind
from vla_zenoh.profile import load_profile
from vla_zenoh.robots.arm import GripperCommands
from vla_zenoh.robots.driver import RobotDriver
from vla_zenoh.types import GripperCommand

HOUR_NS = 3_600_000_000_000
WITH_GRASP = "  gripper: {grasp: /panda_gripper/grasp}\n"
FORGOTTEN_S = 0.35
"""Longer than timing.command_timeout_s."""
MOVE, GRASP = "/panda_gripper/move/_action", "/panda_gripper/grasp/_action"
KNUCKLE = "/robotiq_gripper_controller/gripper_cmd"
SHUT_RAD = 0.7929
ROBOTIQ = f"""\
  gripper: {{topic: {KNUCKLE}, type: control_msgs/action/GripperCommand}}
robot: {{gripper: {{joint_open_rad: 0.0, joint_shut_rad: {SHUT_RAD}}}}}
"""
ENDS = {"GripperCommand": {"stalled": True}}
"""How the robot's actions end."""
ORDER = GripperCommand(0.02, 0.05, 10.0)

pytestmark = pytest.mark.realtime


class Rig:
    """A gripper that is turned by hand, and the robot's side of its action."""

    def __init__(
        self, node: Node, gripper: Gripper, command: Publisher, stranger: Publisher
    ) -> None:
        self.node, self.gripper = node, gripper
        driver = SimpleNamespace(
            profile=node.profile, no_gripper="", lockstep=False, grip=gripper.move
        )
        self.commands = GripperCommands(node, cast("RobotDriver", driver))
        self.command, self.stranger = command, stranger
        self.goals: list[Any] = []
        self.actions: list[str] = []
        self.width_m: float | None = None
        self.over = threading.Event()

    def turn(self, writer: str = "command#1", *, leads: bool = True) -> None:
        self.turn_at(time.time_ns(), writer, leads=leads)

    def turn_at(self, now_ns: int, writer: str, *, leads: bool) -> None:
        self.gripper.poll(writer, writer_active=leads)
        arm = SimpleNamespace(writer=writer, writer_active=leads)
        self.commands.update(now_ns, cast("ArmGuard", arm))

    def turn_until(self, what: str, name: str, count: int, writer: str = "command#1") -> None:
        """Turn until counter `name` stands at `count`."""

        def reached() -> bool:
            self.turn(writer)
            return self.node.counters[name] >= count

        until(what, reached)


@pytest.fixture
def rig(tmp_path: Path, request: pytest.FixtureRequest) -> Iterator[Rig]:
    more = getattr(request, "param", "")
    profile = load_profile(str(write_profile(tmp_path, more=more)))
    assert profile.ros2 is not None
    with (
        open_session(profile.session, mode="router"),
        open_session(profile.session) as ours,
        open_session(profile.session) as theirs,
    ):
        node = Node("ros2", profile, ours)
        messages = Messages(profile.ros2.distribution)
        graph = RosGraph(ours, profile.ros2, messages, "vla_panda")
        gripper = Gripper(node, graph, messages, profile, lambda: rig.width_m)
        streams = [
            Publisher(theirs, profile.keys.command_gripper, Kind.ORDER, source, Clock())
            for source in ("command#1", "stranger#1")
        ]
        peer = Ros2Peer(theirs, "ros2dds")
        rig = Rig(node, gripper, *streams)

        def serve(topic: str, action: str, package: str = "franka_msgs") -> None:
            kind = f"{package}/action/{action}"

            def accept(asked: Any) -> Any:
                rig.goals.append(asked.goal)
                rig.actions.append(action)
                return peer.message(f"{kind}_SendGoal_Response", accepted=True)

            def finish(_: Any) -> Any:
                rig.over.wait()
                result = peer.message(f"{kind}_Result", **ENDS.get(action, {"success": True}))
                return peer.message(f"{kind}_GetResult_Response", status=SUCCEEDED, result=result)

            peer.serve(f"{topic}/send_goal", f"{kind}_SendGoal", accept)
            peer.serve(f"{topic}/get_result", f"{kind}_GetResult", finish)

        serve(MOVE, "Move")
        serve(GRASP, "Grasp")
        serve(f"{KNUCKLE}/_action", "GripperCommand", "control_msgs")
        until("the gripper listens", lambda: all(stream.has_subscribers for stream in streams))
        yield rig
        rig.over.set()
        peer.close()
        graph.close()
        node.close()


def test_strangers_and_orders_that_come_again_move_nothing_and_none_goes_beyond_the_profile(
    rig: Rig,
) -> None:
    most = rig.node.profile.robot.gripper
    rig.command.publish(GripperCommand(1.0, 10.0, 1000.0))
    rig.turn_until("the first goal", "ros2.gripper_goals", 1)
    until("the robot hears it", lambda: rig.goals)
    assert (rig.goals[0].width, rig.goals[0].speed) == (most.max_width_m, most.speed_m_s)
    assert rig.node.counters["gripper_bounded"] == 1
    time.sleep(FORGOTTEN_S)
    rig.command.publish(ORDER, seq=0)
    rig.turn_until("it came again", "refused.replayed", 1)
    rig.stranger.publish(ORDER)
    rig.turn_until("it is a stranger's", "refused.foreign", 1)
    assert rig.gripper.wanted_m == most.max_width_m


def test_a_wall_clock_that_is_set_does_not_give_up_a_goal(rig: Rig) -> None:
    rig.command.publish(ORDER)
    rig.turn_until("the goal", "ros2.gripper_goals", 1)
    for now_ns in (time.time_ns() + HOUR_NS, time.time_ns() - HOUR_NS):
        rig.turn_at(now_ns, "command#1", leads=True)
        assert rig.gripper.busy
    assert rig.node.counters["ros2.gripper_timeouts"] == 0


@pytest.mark.parametrize("rig", [WITH_GRASP], indirect=True)
def test_what_closes_the_fingers_from_where_they_are_is_a_grasp_and_nothing_else(rig: Rig) -> None:
    rig.over.set()
    expected: list[str] = []
    for at_m, to_m, action in (
        (None, 0.08, "Move"),  # the first order of all: nothing is known
        (0.0, 0.08, "Move"),
        (0.08, 0.08, "Move"),
        (0.04, 0.0, "Grasp"),
        (0.04, 0.02, "Grasp"),  # something is between them; the last order was 0
        (None, 0.08, "Move"),  # from where they were sent last
        (None, 0.02, "Grasp"),
    ):
        rig.width_m = at_m
        rig.command.publish(GripperCommand(to_m, 0.05, 10.0))
        expected.append(action)
        rig.turn_until("the goal", "ros2.gripper_goals", len(expected))
        until("the robot hears it", lambda: len(rig.actions) == len(expected))
        assert rig.actions == expected


def test_a_wish_that_waits_for_the_gripper_is_not_sent_after_a_stop(rig: Rig) -> None:
    rig.command.publish(GripperCommand(0.0, 0.05, 10.0))
    rig.turn_until("the goal, which hangs", "ros2.gripper_goals", 1)
    rig.command.publish(GripperCommand(0.08, 0.05, 10.0))
    rig.turn_until("the wish waits", "ros2.gripper_cancelled", 1)
    rig.turn(leads=False)  # the command node brakes
    rig.turn(writer="", leads=False)
    assert rig.node.counters["refused.outlived"] == 1
    rig.over.set()

    def ended() -> bool:
        rig.turn(writer="", leads=False)
        return not rig.gripper.busy

    until("the goal ends", ended)
    rig.turn(writer="", leads=False)
    assert rig.node.counters["ros2.gripper_goals"] == 1
    assert rig.gripper.wanted_m == 0.0


def test_an_order_that_waited_while_this_side_stood_still_moves_nothing(rig: Rig) -> None:
    rig.command.publish(ORDER, stamp_wall_ns=time.time_ns() - 2 * OLDEST_NS)
    rig.turn_until("it is refused", "refused.stale", 1)
    assert not rig.gripper.busy


@pytest.mark.parametrize("rig", [WITH_GRASP], indirect=True)
def test_who_holds_something_is_told_by_the_fingers_and_not_by_the_grasp(rig: Rig) -> None:
    rig.over.set()
    rig.width_m = 0.08
    rig.command.publish(GripperCommand(0.0, 0.05, 10.0))
    rig.turn_until("the goal", "ros2.gripper_goals", 1)
    assert not rig.gripper.holding

    def ended() -> bool:
        rig.turn()
        return not rig.gripper.busy

    until("the grasp succeeds", ended)
    assert rig.actions == ["Grasp"]
    for at_m, holds in ((0.03, True), (0.0005, False), (None, False), (0.03, True)):
        rig.width_m = at_m
        assert rig.gripper.holding is holds


@pytest.mark.parametrize("rig", [ROBOTIQ], indirect=True)
def test_a_gripper_that_turns_is_sent_the_angle_of_its_opening(rig: Rig) -> None:
    rig.over.set()
    rig.width_m = 0.08
    for number, (width_m, angle_rad) in enumerate(
        ((0.08, 0.0), (0.02, 0.75 * SHUT_RAD), (0.0, SHUT_RAD)), 1
    ):
        rig.command.publish(GripperCommand(width_m, 0.05, 10.0))
        rig.turn_until("the goal", "ros2.gripper_goals", number)
        until("the robot hears it", lambda count=number: len(rig.goals) == count)
        assert rig.goals[-1].command.position == pytest.approx(angle_rad)

        def ended() -> bool:
            rig.turn()
            return not rig.gripper.busy

        until("it ends", ended)
    assert rig.gripper.holding, "it stalled"
