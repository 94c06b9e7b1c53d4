"""Poses and joints for one arm: who is followed owns it, and nobody takes it over in motion."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from vla_zenoh.guard.arm_guard import UNHEEDED_NS, ArmGuard, CommandKind, HeldReference, Measured
from vla_zenoh.kinematics.so3 import Pose
from vla_zenoh.profile import load_profile
from vla_zenoh.types import STANDING, Header, JointCommand, PoseCommand, Stamped
from vla_zenoh.types.records import JointReference, PoseReference

PROFILE = load_profile("panda_sim")
NAMES = PROFILE.robot.arm_joints
HOME_RAD = np.array(PROFILE.robot.home_rad)
START_NS = 1_700_000_000_000_000_000
MS = 1_000_000
SILENT_MS = round(PROFILE.timing.command_timeout_s * 1e3) + 5
UNIT = np.array([0.0, 0.0, 0.0, 1.0])
TURNS = np.zeros(7, bool)


class Side:
    """An arm that stands where it is told, its guard, and a clock."""

    def __init__(self, mode: CommandKind = "pose", most_rad_s: float = np.inf) -> None:
        self.measured = Measured(Pose(np.array([0.43, 0.0, 0.3]), np.eye(3)), HOME_RAD, np.zeros(7))
        ends = HOME_RAD - 1, HOME_RAD + 1
        self.guard = ArmGuard(
            PROFILE, lambda: self.measured, ends, np.full(7, most_rad_s), TURNS, 1e-3
        )
        self.guard.kind = mode
        self.now_ns, self.seq = START_NS, 0

    def stamped(self, record: Any, source: str) -> Stamped[Any]:
        self.seq += 1
        return Stamped(Header(self.now_ns, self.seq, source), record, self.now_ns)

    def pose(
        self, dx_m: float = 0.0, v_m_s: float = 0.0, source: str = "p", state: str = "active"
    ) -> str | None:
        at = self.measured.pose.position_m + [dx_m, 0.0, 0.0]
        twist = np.array([v_m_s, 0, 0, 0, 0, 0])
        record = PoseCommand(at, UNIT, twist, np.zeros(6), at, UNIT, state)
        return self.guard.offer(self.stamped(record, source), self.now_ns)

    def joint(self, by_rad: float = 0.0, v_rad_s: float = 0.0, source: str = "j") -> str | None:
        at = self.measured.position_rad + by_rad
        record = JointCommand(NAMES, at, np.full(7, v_rad_s), np.zeros(7), "active")
        return self.guard.offer(self.stamped(record, source), self.now_ns)

    def tick(self, ticks: int = 1) -> PoseReference | JointReference:
        for _ in range(ticks):
            self.now_ns += MS
            self.guard.tick(self.now_ns)
        return self.guard.reference


@pytest.mark.parametrize(("mode", "kind"), [("pose", PoseReference), ("joint", JointReference)])
def test_it_holds_the_arm_by_what_the_profile_says_until_somebody_commands(
    mode: CommandKind, kind: type
) -> None:
    assert isinstance(Side(mode).tick(), kind)


def test_while_poses_are_followed_joints_are_refused_and_change_nothing() -> None:
    side = Side()
    assert side.pose(0.0004, 0.02) is None
    before = side.tick()
    assert side.joint() == "other_mode"
    assert side.guard.kind == "pose"
    np.testing.assert_array_equal(side.guard.reference[0], before[0])


def test_joints_are_no_faster_than_the_robot_s_description_allows() -> None:
    speeds_rad_s = np.arange(0.0, 0.3, 0.005)
    ways_rad = np.cumsum(speeds_rad_s) * 4e-3
    answers: dict[float, list[str | None]] = {}
    for most_rad_s in (np.inf, 0.1):
        side = Side("joint", most_rad_s)
        answers[most_rad_s] = []
        for way_rad, speed_rad_s in zip(ways_rad, speeds_rad_s, strict=True):
            answers[most_rad_s].append(side.joint(way_rad, speed_rad_s))
            side.tick(4)
    assert not any(answers[np.inf])
    assert not any(answers[0.1][:40])
    assert set(answers[0.1][41:]) == {"too_fast"}


def test_while_joints_are_followed_poses_are_refused() -> None:
    side = Side("joint")
    assert side.joint(0.001, 0.05) is None
    side.tick()
    assert side.pose() == "other_mode"
    assert isinstance(side.tick(), JointReference)


def test_whose_stream_is_followed_is_known_until_it_ends() -> None:
    side = Side()
    assert side.guard.writer == ""
    assert side.pose(source="command#1") is None
    assert side.pose(source="stranger#1") == "foreign"
    assert side.guard.writer == "command#1"
    side.tick(SILENT_MS)
    assert side.guard.writer == ""
    assert side.joint(source="command#2") is None
    assert side.guard.writer == "command#2"


def test_when_a_stream_has_ended_at_rest_the_other_may_begin_and_back_again() -> None:
    side = Side()
    for _ in range(2):
        assert side.pose() is None
        side.tick(SILENT_MS)
        assert side.joint() is None
        assert isinstance(side.tick(), JointReference)
        side.tick(SILENT_MS)
    assert side.guard.silences == 0


def test_while_the_arm_brakes_the_other_stream_may_not_begin() -> None:
    side = Side()
    assert side.pose(v_m_s=0.02) is None
    side.tick(SILENT_MS - 10)
    assert not side.guard.braking
    side.tick(10)
    assert side.guard.braking
    assert side.joint() == "other_mode"
    side.tick(1500)
    assert not side.guard.braking
    assert side.joint() is None
    assert side.guard.silences == 1


def test_an_arm_that_still_swings_is_not_handed_over() -> None:
    side = Side()
    swinging = np.zeros(7)
    swinging[4] = -1.5 * STANDING.turns
    side.measured = side.measured._replace(velocity_rad_s=swinging)
    assert side.joint() == "moving"
    assert side.guard.kind == "pose"
    side.measured = side.measured._replace(velocity_rad_s=0.5 * swinging)
    assert side.joint() is None


def test_a_bad_first_command_does_not_change_who_holds_the_arm() -> None:
    side = Side()
    assert side.joint(by_rad=0.5) == "jump"
    assert side.joint(v_rad_s=9.0) == "too_fast"
    assert isinstance(side.tick(), PoseReference)
    side = Side("joint")
    assert side.pose(dx_m=0.5) == "jump"
    assert isinstance(side.tick(), JointReference)


def test_the_other_stream_begins_where_the_arm_is_and_not_where_it_was() -> None:
    side = Side()
    moved = Pose(np.array([0.5, 0.1, 0.4]), np.eye(3))
    side.measured = side.measured._replace(pose=moved, position_rad=HOME_RAD + 0.4)
    for _ in range(100):
        assert side.joint(0.001) is None
        side.tick(4)
    np.testing.assert_allclose(side.tick()[0], HOME_RAD + 0.401)
    side.tick(SILENT_MS)
    side.measured = side.measured._replace(position_rad=HOME_RAD)
    for _ in range(100):
        assert side.pose(0.0004) is None
        side.tick(4)
    np.testing.assert_allclose(side.tick()[0], [0.5004, 0.1, 0.4])


def test_what_was_heard_before_a_change_is_not_new_after_it() -> None:
    side = Side()
    record = JointCommand(NAMES, HOME_RAD, np.zeros(7), np.zeros(7), "active")
    old = side.stamped(record, "j")
    assert side.guard.offer(old, side.now_ns) is None
    side.tick(SILENT_MS)
    assert side.pose() is None
    side.tick(SILENT_MS)
    assert side.guard.offer(old, side.now_ns) == "replayed"
    assert side.guard.kind == "pose"


@pytest.mark.parametrize("mode", ["pose", "joint"])
def test_an_arm_that_somebody_else_moved_stands_there_and_knows_who_spoke(
    mode: CommandKind,
) -> None:
    side = Side(mode)
    offer = side.guard.offer
    at, still = side.measured.pose.position_m, np.zeros(6)
    record: Any = (
        PoseCommand(at, UNIT, still, still, at, UNIT, "active")
        if mode == "pose"
        else JointCommand(NAMES, HOME_RAD, np.zeros(7), np.zeros(7), "active")
    )
    old = side.stamped(record, "command#1")
    assert offer(old, side.now_ns) is None
    side.guard.anchor()
    assert not side.guard.following
    assert offer(old, side.now_ns) == "replayed"


@pytest.mark.parametrize("mode", ["pose", "joint"])
def test_a_restart_stands_where_the_robot_was_put(mode: CommandKind) -> None:
    side = Side(mode)
    assert (side.pose if mode == "pose" else side.joint)() is None
    elsewhere = Pose(np.array([0.3, 0.0, 0.5]), np.eye(3))
    side.measured = Measured(elsewhere, HOME_RAD + 0.2, np.zeros(7))
    side.guard.reset()
    assert not side.guard.following
    assert side.guard.kind == mode
    where = elsewhere.position_m if mode == "pose" else HOME_RAD + 0.2
    np.testing.assert_array_equal(side.tick()[0], where)


@pytest.mark.parametrize(
    ("mode", "by", "speed", "reason"),
    [
        ("pose", 0.003, 0.0, "jump"),
        ("pose", 0.0, 0.05, "too_fast"),
        ("joint", 0.006, 0.0, "jump"),
        ("joint", 0.0, 0.12, "too_fast"),
    ],
)
def test_a_stream_whose_beginning_was_lost_is_said_to_be_unheeded_until_it_ends(
    mode: CommandKind, by: float, speed: float, reason: str
) -> None:
    side = Side(mode)
    for _ in range(20):
        assert (side.pose if mode == "pose" else side.joint)(by, speed) == reason
        side.tick(50)
        assert side.guard.unheeded
    side.tick(UNHEEDED_NS // MS)
    assert not side.guard.unheeded
    assert (side.pose() if mode == "pose" else side.joint()) is None


def test_an_arm_that_follows_somebody_heeds_no_stranger_and_does_not_say_so() -> None:
    side = Side()
    assert side.pose(source="command#1") is None
    side.tick()
    assert side.pose(0.1, source="stranger#1") == "foreign"
    assert side.joint(source="stranger#1") == "other_mode"
    assert side.pose(0.1, source="command#1") == "jump"
    side.tick()
    assert not side.guard.unheeded


def test_a_stream_of_one_that_brakes_already_need_not_be_told() -> None:
    side = Side()
    assert side.pose(0.1, state="inactive") == "inactive"
    side.tick()
    assert not side.guard.unheeded


def test_a_command_that_comes_again_after_its_stream_ended_need_not_be_told() -> None:
    side = Side()
    assert side.pose() is None
    side.tick(SILENT_MS)
    side.seq = 0
    assert side.pose() == "replayed"
    side.tick()
    assert not side.guard.unheeded


def test_after_a_clock_was_set_back_it_is_not_unheeded_for_ever() -> None:
    side = Side()
    assert side.pose(0.1) == "jump"
    side.now_ns -= 3_600_000 * MS
    side.tick()
    assert not side.guard.unheeded


@pytest.mark.parametrize("state", ["inactive", "stopped", "fault", ""])
def test_no_stream_begins_in_a_state_in_which_its_writer_brakes(state: str) -> None:
    side = Side()
    assert side.pose(0.0004, 0.02, state=state) == "inactive"
    assert not side.guard.following
    assert side.pose(0.0004, 0.02) is None
    assert side.guard.following


def test_a_followed_stream_brakes_the_arm_in_any_state() -> None:
    side = Side()
    assert side.pose(0.0, 0.02) is None
    side.tick(4)
    assert side.pose(0.0001, 0.01, state="stopped") is None
    assert side.guard.following
    assert not side.guard.writer_active


def test_a_robot_that_was_reset_ignores_the_rest_of_the_stream_to_the_one_before() -> None:
    side = Side()
    assert side.pose(0.0, 0.0) is None
    side.tick(4)
    side.guard.reset()
    assert side.pose(0.0, 0.0, state="stopped") == "inactive"
    assert not side.guard.following


def test_a_reference_is_held_until_something_else_moves_a_joint_of_an_arm_that_rests() -> None:
    held, still = HeldReference(np.zeros(2, bool)), np.zeros(2)
    held.on_sent(0)
    here = Measured(Pose(np.zeros(3), np.eye(3)), still, still)
    for at_ms, elbow_rad, is_held in (
        *((100, 0.5, True), (400, 0.1, True), (600, 0.0, True)),
        *((700, 0.015, True), (800, 0.025, False), (900, 0.0, False)),
    ):
        moved = here._replace(position_rad=np.array([0.0, elbow_rad]))
        assert held.update(moved, at_ms * 1_000_000) is is_held
