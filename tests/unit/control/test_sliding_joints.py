"""Whatever bounds a joint that turns in radians bounds one that slides in metres, as a pose."""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import cache
from pathlib import Path
from tempfile import mkdtemp
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
import zenoh
from made_arm import made_arm
from vla_zenoh_inspect.targets import SETTLED, Targets
from vla_zenoh_primitives.endings import NEAR_JOINT, SETTLED_S, Arrival, Sight
from vla_zenoh_primitives.target_check import NEAR_JOINT as AT_END
from vla_zenoh_primitives.target_check import TargetCheck

from vla_zenoh.client.client import Standstill
from vla_zenoh.codec import records
from vla_zenoh.control.joint_space import PROBE, first_bit
from vla_zenoh.control.limits import BEGIN_JOINT, JointMotionLimits
from vla_zenoh.control.policy_check import NEAR, beyond_joint_units, joints_as_pose
from vla_zenoh.control.pose_to_joint import REST, PoseToJoint
from vla_zenoh.control.preflight import HELD, Settling, joint_state_faults
from vla_zenoh.control.reachability import ReachabilityFilter
from vla_zenoh.guard.arm_guard import ARM_SETTLES_NS, MOVED_JOINT, ArmGuard, HeldReference, Measured
from vla_zenoh.guard.stream_guard import BEGIN_M_S, BEGIN_RAD_S, JUMP_JOINT, JointGuard
from vla_zenoh.kinematics.kinematics import Kinematics, make_kinematics
from vla_zenoh.kinematics.so3 import quat_from_rotation
from vla_zenoh.lab.check.fit import check_chunk
from vla_zenoh.policy import ActionSpec, Observation
from vla_zenoh.policy.frozen import MOVED_JOINT as SEEN_MOVED
from vla_zenoh.policy.frozen import FrozenImages
from vla_zenoh.profile import REJECT_FACTOR, Profile
from vla_zenoh.types import (
    STANDING,
    FloatArray,
    GripperState,
    Header,
    Image,
    JointBound,
    JointCommand,
    JointState,
    PoseCommand,
    PoseState,
    Stamped,
)

NOW_NS, S_NS = 1_700_000_000_000_000_000, 1_000_000_000
SLIDES, TURNS = 0, 1
"""Joints of the arm."""
ZERO = np.zeros(4)
SHUT = GripperState(0.0, moving=False, holding=False)


@cache
def profile() -> Profile:
    """A lift, two joints that turn, and a slide at the end."""
    return made_arm(Path(mkdtemp()), "sztytzsx")


@cache
def arm() -> Kinematics:
    return make_kinematics(profile())


HOME = np.array([0.25, 0.1, 0.1, 0.25])
LIMITS = profile().limits


def state(way: FloatArray = ZERO, rates: FloatArray = ZERO, held: FloatArray = ZERO) -> JointState:
    sliding = ("joint1", "joint4")
    return JointState(arm().arm_joints, HOME + way, rates, None, HOME + held, sliding=sliding)


def pose(way: FloatArray = ZERO) -> PoseState:
    here = arm().forward(HOME + way)
    return PoseState(here.position_m, quat_from_rotation(here.rotation), np.zeros(6))


def stamped(record: Any, seq: int = 0) -> Stamped[Any]:
    return Stamped(Header(NOW_NS + seq * 10**6, seq, "a#1"), record, NOW_NS + seq * 10**6)


def joint_command(way: FloatArray = ZERO, rates: FloatArray = ZERO) -> JointCommand:
    return JointCommand(arm().arm_joints, HOME + way, rates, ZERO, "active")


def guard() -> JointGuard:
    brake = JointMotionLimits(np.full(4, 9.0), np.full(4, 99.0), np.full(4, 999.0))
    ends = HOME - 9, HOME + 9
    return JointGuard(arm().arm_joints, HOME, 1e-3, 0.1, brake, ends, arm().slides)


def begins(way: FloatArray, rates: FloatArray = ZERO) -> bool:
    return guard().offer(stamped(joint_command(way, rates)), NOW_NS) is None


def goes_on(way: FloatArray) -> bool:
    follows = guard()
    assert follows.offer(stamped(joint_command()), NOW_NS) is None
    return follows.offer(stamped(joint_command(way), 1), NOW_NS) is None


def exchanges_its_law(rates: FloatArray) -> bool:
    here = Measured(arm().forward(HOME), HOME, rates)
    ends, most = (HOME - 9, HOME + 9), np.full(4, 9.0)
    watched = ArmGuard(profile(), lambda: here, ends, most, arm().slides, 1e-3)
    at = pose()
    command = PoseCommand(
        at.position_m, at.quat_xyzw, np.zeros(6), np.zeros(6), at.position_m, at.quat_xyzw, "active"
    )
    return watched.offer(stamped(command), NOW_NS) is None


def is_held(way: FloatArray) -> bool:
    hold = HeldReference(arm().slides)
    hold.on_sent(0)
    for number, at in enumerate((HOME, HOME + way), 1):
        here = Measured(arm().forward(HOME), at, ZERO)
        held = hold.update(here, number * ARM_SETTLES_NS)
    return held


def looks_the_same(way: FloatArray) -> bool:
    frozen = FrozenImages({"front": 0.1}, frozenset())
    image = Image(np.zeros((2, 2, 3), np.uint8))
    seen = [
        cast(
            "Observation",
            SimpleNamespace(
                images={"front": image.rgb},
                depth={},
                parts={},
                pose=None,
                joint=state(moved),
                stamp_wall_ns=number * S_NS,
            ),
        )
        for number, moved in enumerate((ZERO, way))
    ]
    return [frozen.judge(each) for each in seen][-1] == ""


def stands_for_a_client(rates: FloatArray) -> bool:
    still = Standstill()
    payload = zenoh.ZBytes(records.encode(state(rates=rates)))
    still.take(cast("Any", SimpleNamespace(payload=payload)))
    return still._moved_s < time.monotonic() - 1.0


def is_near_where_it_is_held(held: FloatArray) -> bool:
    return not joint_state_faults(
        profile(), arm(), stamped(state(held=held)), stamped(pose()), NOW_NS
    )


def has_settled(way: FloatArray) -> bool:
    settling = Settling(arm())
    settling.measure(pose(), state(held=way), NOW_NS)
    return settling.unsettled(arm().forward(HOME), HOME) == []


def test_the_joint_that_is_furthest_for_its_kind_is_told_where_an_arm_has_not_settled() -> None:
    """0.0035 rad of a joint that turns is near, 0.003 m of one that slides is not."""
    settling = Settling(arm())
    slides = arm().slides
    way = np.where(slides, 0.0, 0.0035)
    way[int(np.flatnonzero(slides)[0])] = 0.003
    settling.measure(pose(), state(held=way), NOW_NS)
    (why,) = settling.unsettled(arm().forward(HOME), HOME)
    assert "its joints 0.003 m" in why


def stands_in_commands(rates: FloatArray) -> bool:
    stage = PoseToJoint(profile(), arm())
    stage._now = stage._now._replace(velocity_rad_s=rates)
    return stage.at_rest


def is_all_of_the_first_bit(way: FloatArray) -> bool:
    return bool((first_bit(way, arm()) == way).all())


def has_arrived(way: FloatArray) -> bool:
    arrival = Arrival(arm().forward(HOME), HOME, arm())
    seen = [Sight(at_s, pose(), HOME + way, SHUT) for at_s in (0.0, 1.1 * SETTLED_S)]
    return "reached" in [arrival.check(each) for each in seen]


def may_end_there(way: FloatArray) -> bool:
    check = TargetCheck(profile(), ReachabilityFilter(profile()))
    ends = check.bounds.upper_rad
    at = np.where(way > 0, ends, HOME)
    return "joint_limit" not in check.joints_fault(at - np.sign(way) * 0.001, at + way)


def is_home(way: FloatArray) -> bool:
    return Targets(profile(), 10.0).settled(np.append(HOME + way, 0.0), np.append(HOME, 1.0))


def deltas() -> ActionSpec:
    return ActionSpec(
        space="joint", joints=arm().arm_joints, kind="delta", horizon=1, dt_s=1.0, gripper="none"
    )


def is_a_step_of_its_unit(way: FloatArray) -> bool:
    return beyond_joint_units(deltas(), way[None], LIMITS, arm().slides) is None


def is_a_step_within_its_limit(way: FloatArray) -> bool:
    found = check_chunk(deltas(), way[None], LIMITS, 0.1, profile().robot)
    return "step_limit" not in [each.name for each in found]


def is_no_pose_but_joints(way: FloatArray) -> bool:
    six = np.concatenate([HOME, [0.1, 0.1]])
    action = ActionSpec(kind="absolute", rotation="rotvec", gripper="none", horizon=1, dt_s=0.1)
    steps = (six + np.concatenate([way, [0.0, 0.0]]))[None]
    slides = np.concatenate([arm().slides, [False, False]])
    return bool(joints_as_pose(action, steps, six, slides, LIMITS))


STEP = JointBound(LIMITS.step_rad, LIMITS.step_m)
ADMITS: dict[str, tuple[Callable[[FloatArray], bool], JointBound]] = {
    "a command stream begins": (begins, BEGIN_JOINT),
    "a command stream begins as fast": (
        lambda rates: begins(ZERO, rates),
        JointBound(BEGIN_RAD_S, BEGIN_M_S),
    ),
    "a command stream goes on": (goes_on, JUMP_JOINT),
    "a control law is exchanged": (exchanges_its_law, STANDING),
    "an arm is held by its controller": (is_held, MOVED_JOINT),
    "an image may repeat": (looks_the_same, SEEN_MOVED),
    "an arm stands for a client": (stands_for_a_client, STANDING),
    "an arm is activated where it is held": (is_near_where_it_is_held, HELD),
    "an arm is activated where its stream ended": (has_settled, BEGIN_JOINT),
    "commanded joints stand": (stands_in_commands, REST),
    "the first bit of a way": (is_all_of_the_first_bit, PROBE),
    "a primitive has arrived": (has_arrived, NEAR_JOINT),
    "a primitive may end beside a range": (may_end_there, AT_END),
    "an arm is at home": (is_home, SETTLED),
    "a step is of its unit": (is_a_step_of_its_unit, JointBound(*REJECT_FACTOR * np.array(STEP))),
    "a step is within its limit": (is_a_step_within_its_limit, STEP),
    "numbers of a pose are joints": (is_no_pose_but_joints, NEAR),
}


@pytest.mark.parametrize("what", ADMITS)
@pytest.mark.parametrize("joint", [SLIDES, TURNS], ids=["slides", "turns"])
def test_a_joint_is_bounded_in_its_own_unit(what: str, joint: int) -> None:
    admits, bound = ADMITS[what]
    most = bound.slides if joint == SLIDES else bound.turns
    way = np.eye(4)[joint] * most
    assert admits(0.9 * way)
    assert not admits(1.1 * way)


def test_of_joints_that_turn_and_slide_the_one_furthest_beyond_its_own_bound_has_not_settled() -> (
    None
):
    most = BEGIN_JOINT.of(arm().slides)
    way = ZERO.copy()
    way[SLIDES], way[TURNS] = 1.5 * most[SLIDES], 0.9 * most[TURNS]
    assert way[TURNS] > way[SLIDES]
    assert not has_settled(way)
