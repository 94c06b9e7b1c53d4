"""Two arms under one policy: both move as asked, and when one cannot go on both stand.

All figures are of MuJoCo's own TCPs.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable
from dataclasses import replace

import numpy as np
import pytest
from pair_rig import (
    PARTS,
    Pair,
    apart_m,
    joint_steps,
    random_motion,
    reach,
    shipped,
    steady,
    tcp_steps,
    world,
)
from vla_zenoh_benchmarks.lockstep.loop import Lockstep
from vla_zenoh_benchmarks.lockstep.worker import Message
from vla_zenoh_teleop.policy import OperatorInput, TeleopPolicy

from vla_zenoh.codec import records
from vla_zenoh.types import GripperState, JointCommand, JointState, PoseState

pytestmark = pytest.mark.long

UPWARD = np.array([0.0, -0.02, 0.0, 0.02, 0.0, 0.0, 0.0, 0.04])
"""A step of joints in which either TCP moves."""
FAST_M_S = 0.05
BOUND_S = 0.6
"""Within it both arms stand, whatever happens to one; the single arm's rows of docs/design.md."""
STOP_S = 0.35
STILL = 2e-3
LED_BACK_M = 0.08
NEAR_M = 0.12
"""From here the arms would be at their stop within the time that a fault takes to be noticed."""
STOP_TOLERANCE_M = 1e-3
TAMPERED = "left"


def moving() -> Pair:
    pair = Pair(steady(left=UPWARD, right=UPWARD))
    pair.run(1.0)
    assert min(pair.speed_m_s(part)[-1] for part in PARTS) > FAST_M_S
    return pair


def test_columns_move_the_joints_of_their_part_and_no_other() -> None:
    def motion(_: int) -> dict[str, np.ndarray]:
        home = np.array(shipped().robot.home_rad)
        left, right = home.copy(), home.copy()
        left[0] += 0.2
        right[5] -= 0.15
        return {"left": np.array([*left, 0.08]), "right": np.array([*right, 0.02])}

    pair = Pair(motion, joint_steps("absolute"))
    pair.run(3.0)
    home = np.array(shipped().robot.home_rad)
    asked = motion(0)
    for part in PARTS:
        assert pair.joints_rad(part) == pytest.approx(asked[part][:7], abs=0.005)
        moved = np.abs(pair.joints_rad(part) - home) > 0.05
        assert moved.sum() == 1
    assert world().parts["left"].gripper_state().width_m == pytest.approx(0.08, abs=0.003)
    assert world().parts["right"].gripper_state().width_m == pytest.approx(0.02, abs=0.003)


def test_a_policy_sees_both_arms_at_one_time() -> None:
    pair = moving()
    seen = pair.policy.seen
    assert seen is not None
    assert seen.joint is None
    assert set(seen.parts) == set(PARTS)
    assert seen.parts["left"].stamp_wall_ns == seen.parts["right"].stamp_wall_ns
    for part in PARTS:
        joint = seen.parts[part].joint
        assert joint is not None
        assert np.abs(joint.position_rad - pair.joints_rad(part)).max() < 0.1


def test_poses_of_both_tcps_are_followed_each_in_its_own_base_frame() -> None:
    step = np.array([0.0, 0.0, -0.01, 0.0, 0.0, 0.0, 0.04])
    aside = np.array([0.0, 0.01, 0.0, 0.0, 0.0, 0.0, 0.04])
    pair = Pair(steady(left=step, right=aside), tcp_steps())
    pair.run(1.5)
    way = {part: np.array(pair.path_m[part])[-1] - pair.path_m[part][0] for part in PARTS}
    assert way["left"][2] < -0.05
    assert np.abs(way["left"][:2]).max() < 0.005
    assert way["right"][1] > 0.05
    assert np.abs(way["right"][[0, 2]]).max() < 0.005


def test_one_stop_stops_both() -> None:
    pair = moving()
    since = pair.mark()
    pair.loop.put("stop")
    pair.run(1.0)
    assert pair.state == "stopped"
    for part in PARTS:
        assert pair.stop_time_s(part, since) < STOP_S


def test_both_brake_in_the_tick_in_which_one_has_to() -> None:
    pair = moving()
    pair.loop.tamper = dropped(PoseState)
    while pair.state == "active":
        pair.run(0.004)
    braking = [part.motion._mover.braking for part in pair.commander.parts]  # pyright: ignore
    assert braking == [True, True]


def test_a_person_moves_one_arm_after_the_other() -> None:
    wish = OperatorInput()
    world().reset()
    policy = TeleopPolicy(shipped(), shipped().task.worker, lambda: wish, lambda: 2)
    loop = Lockstep(shipped(), world(), policy, reach=reach(), steps=2)
    loop.put("rate", 10.0)
    loop.run(0.5)
    loop.put("active", True)
    loop.run(0.3)
    assert loop.commander.state.value == "active", loop.commander.why
    for count, (moved, stands) in enumerate([PARTS, PARTS[::-1]]):
        before = {part: world().parts[part].tcp()[0].copy() for part in PARTS}
        wish = OperatorInput((0, 0, 1, 0, 0, 0), toggles=count, part=count)
        loop.run(1.5)
        after = {part: world().parts[part].tcp()[0] for part in PARTS}
        assert after[moved][2] > before[moved][2] + 0.05
        wish = wish._replace(twist=(0.0,) * 6)
        loop.run(0.6)
        assert np.linalg.norm(world().parts[stands].tcp()[0] - before[stands]) < 0.01
    widths = {part: world().parts[part].gripper_state().width_m for part in PARTS}
    assert widths["left"] > 0.03
    assert widths["right"] < 0.01
    assert policy.describe().endswith("right still")


def test_measured_arms_that_come_too_near_brake() -> None:
    """Commanded ones stay apart; here one is pushed, or its commands are not what it follows."""
    towards = np.array([0.02, 0.0, 0.0, 0.0, 0.0, 0.0, 0.04])
    pair = Pair(steady(left=towards, right=towards), tcp_steps())
    pair.run(6.0)
    assert pair.state == "active"
    stop_m = shipped().limits.reach.part_stop_m
    assert pair.measured_m() < stop_m + 0.02
    here, turn = pair.joints_rad("right"), 0.0
    while apart_m(near(pair, turn), here) > 0.02:
        turn += 0.005
    pair.loop.tamper = changed(JointState, position_rad=near(pair, turn))
    pair.run(0.2)
    assert pair.state == "inactive"
    assert re.search(r"too near to a bound: part_distance at left .+ and right .+", why(pair))


def near(pair: Pair, turn_rad: float) -> np.ndarray:
    """Joints of the left arm, with its shoulder turned forward."""
    return pair.joints_rad("left") + turn_rad * np.array([0, 1, 0, 0, 0, 0, 0])


def why(pair: Pair) -> str:
    return pair.commander.why


# -- the fault table of a pair ----------------------------------------------------------------
Tamper = Callable[[Message], Iterable[Message]]


def of_part(kind: type, change: Callable[[Message], Iterable[Message]]) -> Tamper:
    def tamper(message: Message) -> Iterable[Message]:
        hit = message.part == TAMPERED and message.kind is kind
        return change(message) if hit else [message]

    return tamper


def dropped(kind: type) -> Tamper:
    return of_part(kind, lambda _: [])


def changed(kind: type, **fields: object) -> Tamper:
    def change(message: Message) -> Iterable[Message]:
        record = replace(records.decode(kind, message.payload), **fields)
        return [replace(message, payload=records.encode(record))]

    return of_part(kind, change)


FAULTS: dict[str, tuple[Tamper, str]] = {
    "pose of one part missing": (dropped(PoseState), "left: robot state lost: pose"),
    "gripper of one part missing": (dropped(GripperState), "left: robot state lost: gripper"),
    "joints of one part missing": (dropped(JointState), "left: robot state lost: joints"),
    "command stream of one part missing": (
        dropped(JointCommand),
        "left: the robot is not ready but 'braking'",
    ),
    "one part in another mode": (
        changed(GripperState, mode="guiding"),
        "left: the robot is not ready but 'guiding'",
    ),
    "one part reports a fault": (
        changed(GripperState, faults=("reflex",)),
        "left: the robot reports: reflex",
    ),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_a_fault_of_one_part_brings_both_to_rest_and_is_told(fault: str) -> None:
    tamper, why = FAULTS[fault]
    pair = moving()
    since = pair.mark()
    pair.loop.tamper = tamper
    pair.run(1.5)
    assert pair.state in ("inactive", "fault")
    assert pair.commander.why.startswith(why)
    for part in PARTS:
        assert pair.stop_time_s(part, since) < BOUND_S
    assert not pair.loop.commander.task.active


def test_of_two_arms_the_one_that_something_presses_against_retreats_and_the_other_stands() -> None:
    pair = moving()
    since = pair.mark()
    pair.loop.tamper = changed(PoseState, wrench=np.array([60.0, 0, 0, 0, 0, 0]))
    pair.run(4.0)
    assert pair.commander.why.startswith("left: something presses against the arm")
    assert pair.stop_time_s("right", since) < STOP_S
    led_m = np.array(pair.path_m["left"])[since + round(STOP_S / 0.004) :]
    assert np.linalg.norm(led_m - led_m[0], axis=1).max() < LED_BACK_M
    assert pair.speed_m_s("left")[-1] < STILL


def test_the_worker_of_both_gone_brings_both_to_rest() -> None:
    pair = moving()
    since = pair.mark()
    pair.loop.alive.discard("worker-scripted_pair")
    pair.run(1.0)
    assert pair.commander.why == "node 'worker-scripted_pair' is gone"
    for part in PARTS:
        assert pair.stop_time_s(part, since) < STOP_S


def test_what_is_rejected_for_one_part_is_rejected_for_both() -> None:
    def motion(number: int) -> dict[str, np.ndarray]:
        left = UPWARD.copy()
        if number > 12:
            left[:7] = 5.0  # degrees
        return {"left": left, "right": UPWARD}

    pair = Pair(motion)
    pair.run(1.5)
    assert pair.loop.refused == {}
    since = pair.mark()
    pair.run(3.5)
    assert set(pair.loop.refused) == {"step_rad"}
    assert any(event.why.startswith("scripted_pair: left: ") for event in pair.loop.events)
    assert pair.state == "holding"
    for part in PARTS:
        assert pair.speed_m_s(part)[since + 500 :].max() < STILL


# -- distance between the arms -----------------------------------------------------------------
def towards_each_other(number: int) -> dict[str, np.ndarray]:
    way = np.array([0.04, 0.0, -0.01]) * (1 if number < 28 else -1)
    return dict.fromkeys(PARTS, np.array([*way, 0.0, 0.0, 0.0, 0.04]))


@pytest.mark.parametrize(
    "fault",
    [
        pytest.param(fault, marks=[] if fault.startswith("command") else pytest.mark.slow)
        for fault in FAULTS
    ],
)
def test_arms_on_their_way_to_each_other_stand_apart_when_one_of_them_fails(fault: str) -> None:
    pair = Pair(towards_each_other, tcp_steps())
    while pair.distance_m() > NEAR_M:
        pair.run(0.02)
    assert min(pair.speed_m_s(part)[-1] for part in PARTS) > FAST_M_S
    since = pair.mark()
    pair.loop.tamper = FAULTS[fault][0]
    pair.run(BOUND_S, distances=True)
    for part in PARTS:
        assert pair.stop_time_s(part, since) < BOUND_S
    stop_m = shipped().limits.reach.part_stop_m
    assert min(pair.least_m, pair.least_measured_m) >= stop_m - STOP_TOLERANCE_M
    assert pair.state != "active"


def test_arms_that_are_sent_towards_each_other_stand_and_may_go_back() -> None:
    pair = Pair(towards_each_other, tcp_steps())
    pair.run(3.5, distances=True)
    stop_m = shipped().limits.reach.part_stop_m
    assert pair.least_m >= stop_m - STOP_TOLERANCE_M
    assert pair.least_measured_m >= stop_m - 2 * STOP_TOLERANCE_M
    assert pair.least_m < stop_m + 0.02
    assert pair.state == "active"
    assert [event.what for event in pair.loop.events].count("part_distance") == 1
    assert pair.policy.asked < 28
    near_m = pair.distance_m()
    pair.run(2.5)
    assert pair.distance_m() > near_m + 0.1


@pytest.mark.parametrize(
    ("action", "seed"),
    [
        pytest.param(action, seed, marks=[pytest.mark.slow] if seed > 1 else [])
        for action in ("tcp", "joint")
        for seed in (1, 2, 3, 4)
    ],
)
def test_no_random_chunks_bring_the_arms_nearer_than_the_stop(action: str, seed: int) -> None:
    spec = tcp_steps() if action == "tcp" else joint_steps("absolute")
    pair = Pair(random_motion(seed, action), spec, seed)
    pair.run(12.0, distances=True)
    assert pair.least_m >= shipped().limits.reach.part_stop_m - STOP_TOLERANCE_M
