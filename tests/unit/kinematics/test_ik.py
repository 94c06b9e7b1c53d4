"""Joints for a pose, and joints that follow a stream of poses."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from panda_arm import HOME_RAD, moved, panda, tool_down_at

from vla_zenoh.control.joint_follower import JointFollower, JointMotion
from vla_zenoh.control.limits import MotionLimits
from vla_zenoh.control.smoothing import Smoother
from vla_zenoh.errors import RecordError
from vla_zenoh.kinematics.kinematics import InverseKinematics, pose_error, smallest_singular_value
from vla_zenoh.kinematics.so3 import Pose, angle_between
from vla_zenoh.types import FloatArray

SOLVED_M = 1e-6
SOLVED_RAD = 1e-6
WARM_START_RAD = 0.3
BOUND_NOISE_RAD = 1e-12
FOLLOWED_M = 0.05e-3
FOLLOWED_RAD = 0.05e-3
RECOVERED_M = 1e-6
OVERSHOOT_M = 0.5e-3  # of 0.32 m
STREAM_HZ = 250
OVER_LIMIT = 1 + 1e-9  # rounding

KINEMATICS = panda()
SOLVER = InverseKinematics(KINEMATICS, HOME_RAD)
INNER_SHARES = st.lists(st.floats(0.03, 0.97), min_size=7, max_size=7)
OFFSETS = st.lists(st.floats(-WARM_START_RAD, WARM_START_RAD), min_size=7, max_size=7)


def solve(pose: Pose, start_rad: FloatArray) -> FloatArray | None:
    """Joints that put the TCP there; None where there are none."""
    found = SOLVER.approach(pose, start_rad)
    return found.joints_rad if found.solved else None


def several_near_an_end(found_rad: FloatArray, joints_rad: FloatArray) -> bool:
    """Joints on an end of their ranges, which the goal has near that end, too."""
    low = (found_rad <= SOLVER.lower_rad) & (joints_rad < SOLVER.lower_rad + WARM_START_RAD)
    high = (found_rad >= SOLVER.upper_rad) & (joints_rad > SOLVER.upper_rad - WARM_START_RAD)
    return int((low | high).sum()) >= 2


def test_a_pose_that_is_further_away_takes_more_effort() -> None:
    here = KINEMATICS.forward(HOME_RAD)
    near, far = (moved(here, np.array([0.0, way_m, 0.0]), np.zeros(3)) for way_m in (0.001, 0.2))
    efforts = [SOLVER.approach(pose, HOME_RAD, bounded=False).effort for pose in (here, near, far)]
    assert 0 <= efforts[0] < efforts[1] < efforts[2]


# -- one pose ---------------------------------------------------------------------------------
@given(INNER_SHARES, OFFSETS)
@example([0.5, 0.03125, 0.3125, 0.125, 0.25, 0.03125, 0.5], [0.0, 0.0, 0.0, 0.0, 0.25, 0.0, 0.25])
def test_a_reachable_pose_is_solved_from_nearby(shares: list[float], offsets: list[float]) -> None:
    span = SOLVER.upper_rad - SOLVER.lower_rad
    joints = SOLVER.lower_rad + np.array(shares) * span
    if smallest_singular_value(KINEMATICS.jacobian(joints)) < 0.02:
        return  # there an error of the pose says nothing of the joints
    start = np.clip(joints + np.array(offsets), SOLVER.lower_rad, SOLVER.upper_rad)
    goal = KINEMATICS.forward(joints)
    found = SOLVER.approach(goal, start)
    if not found.solved and several_near_an_end(found.joints_rad, joints):
        return  # the documented limit of a local search
    assert found.solved
    solved = found.joints_rad
    reached = KINEMATICS.forward(solved)
    assert np.linalg.norm(reached.position_m - goal.position_m) <= SOLVED_M
    assert angle_between(reached.rotation, goal.rotation) <= SOLVED_RAD
    assert (solved >= SOLVER.lower_rad - BOUND_NOISE_RAD).all()
    assert (solved <= SOLVER.upper_rad + BOUND_NOISE_RAD).all()


def test_every_one_of_500_random_poses_is_solved_from_nearby() -> None:
    generator = np.random.default_rng(0)
    span = SOLVER.upper_rad - SOLVER.lower_rad
    for shares in generator.uniform(0.03, 0.97, (500, 7)):
        joints = SOLVER.lower_rad + shares * span
        if smallest_singular_value(KINEMATICS.jacobian(joints)) < 0.02:
            continue
        offset = generator.uniform(-WARM_START_RAD, WARM_START_RAD, 7)
        start = np.clip(joints + offset, SOLVER.lower_rad, SOLVER.upper_rad)
        assert solve(KINEMATICS.forward(joints), start) is not None


def test_a_pose_out_of_reach_has_no_solution_and_the_arm_stretches_for_it() -> None:
    home = KINEMATICS.forward(HOME_RAD)
    far = moved(home, [0.8, 0, 0], [0, 0, 0])
    assert solve(far, HOME_RAD) is None
    found = SOLVER.approach(far, HOME_RAD)
    assert not found.solved
    assert found.error_m < 0.8
    assert np.isfinite(found.joints_rad).all()


def test_the_warm_start_is_returned_where_it_already_solves() -> None:
    solved = solve(KINEMATICS.forward(HOME_RAD), HOME_RAD)
    assert solved is not None
    assert np.array_equal(solved, HOME_RAD)


def test_a_small_step_of_the_pose_is_a_small_step_of_the_joints() -> None:
    joints = HOME_RAD
    goal = KINEMATICS.forward(joints)
    for _ in range(30):
        goal = moved(goal, [0.005, 0.003, 0.004], [0.01, -0.01, 0.02])
        solved = solve(goal, joints)
        assert solved is not None
        assert np.abs(solved - joints).max() < 0.06
        joints = solved


def test_a_redundant_arm_goes_back_to_its_posture() -> None:
    goal = KINEMATICS.forward(HOME_RAD)
    apart = HOME_RAD + (0.4, 0, 0, 0, 0, 0, 0)
    joints = solve(goal, apart)
    assert joints is not None
    at_first = float(np.linalg.norm(joints - HOME_RAD))
    for _ in range(200):
        joints = solve(moved(goal, [0, 0, 1e-5], [0, 0, 0]), joints)
        assert joints is not None
        joints = solve(goal, joints)
        assert joints is not None
    assert float(np.linalg.norm(joints - HOME_RAD)) < 0.05 * at_first


def test_a_start_outside_the_margin_goes_no_further_out() -> None:
    joints = HOME_RAD.copy()
    joints[6] = KINEMATICS.upper_rad[6] - 0.01
    pose = KINEMATICS.forward(joints)
    outwards = solve(moved(pose, [0, 0, 0], [0, 0, -0.03]), joints)
    assert outwards is None or outwards[6] <= joints[6] + BOUND_NOISE_RAD
    inwards = solve(moved(pose, [0, 0, 0], [0, 0, 0.03]), joints)
    assert inwards is not None
    assert inwards[6] < joints[6]


def test_where_a_joint_ends_the_others_take_over() -> None:
    joints = HOME_RAD
    goal = KINEMATICS.forward(joints)
    for _ in range(46):  # further than joint 7 can turn alone
        goal = moved(goal, [0, 0, 0], [0, 0, -0.05])
        solved = solve(goal, joints)
        assert solved is not None
        joints = solved
    assert joints[6] <= SOLVER.upper_rad[6] + BOUND_NOISE_RAD
    alone = SOLVER.approach(goal, joints, bounded=False)
    assert alone.solved


@pytest.mark.parametrize("margin_rad", [1.6, 3.0])
def test_a_margin_that_leaves_no_range_is_refused(margin_rad: float) -> None:
    with pytest.raises(RecordError, match="leaves 'panda_joint"):
        InverseKinematics(KINEMATICS, HOME_RAD, joint_margin_rad=margin_rad)


# -- a stream of poses ------------------------------------------------------------------------
class Run(NamedTuple):
    """What following a stream came to; one row per tick."""

    error: FloatArray  # m, rad
    position_rad: FloatArray
    velocity_rad_s: FloatArray
    hits: set[str]


def follow(goals: list[Pose], ticks_per_goal: int, follower: JointFollower | None = None) -> Run:
    follower = follower or JointFollower(KINEMATICS, HOME_RAD)
    dt_s = 1 / STREAM_HZ
    limits = MotionLimits((0.5, 2.0, 20.0), (1.5, 6.0, 60.0))
    smoother = Smoother(KINEMATICS.forward(HOME_RAD), dt_s, limits)
    joints = JointMotion.standing(HOME_RAD)
    errors, positions, velocities, names = [], [HOME_RAD], [np.zeros(7)], set()
    for tick in range(len(goals) * ticks_per_goal + STREAM_HZ):
        if tick % ticks_per_goal == 0 and tick // ticks_per_goal < len(goals):
            smoother.target(goals[tick // ticks_per_goal])
        motion = smoother.tick()
        joints, hits = follower.step(joints, motion.pose, motion.twist, dt_s)
        error = pose_error(motion.pose, KINEMATICS.forward(joints.position_rad))
        errors.append((np.linalg.norm(error[:3]), np.linalg.norm(error[3:])))
        positions.append(joints.position_rad)
        velocities.append(joints.velocity_rad_s)
        names |= {hit.name for hit in hits}
    return Run(np.array(errors), np.array(positions), np.array(velocities), names)


def assert_joints_keep_their_limits(run: Run, follower: JointFollower) -> None:
    change = np.diff(run.velocity_rad_s, axis=0) * STREAM_HZ
    moved_rad = np.diff(run.position_rad, axis=0) * STREAM_HZ
    assert (np.abs(run.velocity_rad_s) <= follower.velocity_rad_s * OVER_LIMIT).all()
    assert (np.abs(change) <= follower.acceleration_rad_s2 * OVER_LIMIT).all()
    assert np.abs(moved_rad - run.velocity_rad_s[1:]).max() < 1e-9
    assert (run.position_rad >= follower.lower_rad - BOUND_NOISE_RAD).all()
    assert (run.position_rad <= follower.upper_rad + BOUND_NOISE_RAD).all()


@pytest.mark.parametrize(
    ("translation_m", "rotvec_rad", "steps", "ticks_per_goal"),
    [
        ((0, 0.01, 0), (0, 0, 0), 40, 25),
        ((0, 0, 0), (0, 0.05, 0), 20, 25),
        ((0.003, -0.004, 0.005), (0.02, 0.01, -0.03), 20, 60),
    ],
)
def test_a_smooth_stream_is_followed_exactly(
    translation_m: tuple[float, ...],
    rotvec_rad: tuple[float, ...],
    steps: int,
    ticks_per_goal: int,
) -> None:
    goals = [KINEMATICS.forward(HOME_RAD)]
    for _ in range(steps):
        goals.append(moved(goals[-1], translation_m, rotvec_rad))
    run = follow(goals, ticks_per_goal)
    assert run.error[:, 0].max() < FOLLOWED_M
    assert run.error[:, 1].max() < FOLLOWED_RAD
    assert run.hits == set()
    assert_joints_keep_their_limits(run, JointFollower(KINEMATICS, HOME_RAD))
    end = KINEMATICS.forward(run.position_rad[-1])
    assert np.linalg.norm(end.position_m - goals[-1].position_m) < RECOVERED_M


@pytest.mark.parametrize(
    ("translation_m", "rotvec_rad", "steps", "told"),
    [
        ((0.02, 0, 0), (0, 0, 0), 28, "singularity"),  # 0.15 m beyond the reach
        ((0, 0, 0), (0, 0, -0.05), 48, "joint_limit"),
    ],
)
def test_the_arm_comes_back_from_beyond_its_reach(
    translation_m: tuple[float, ...], rotvec_rad: tuple[float, ...], steps: int, told: str
) -> None:
    out = [KINEMATICS.forward(HOME_RAD)]
    for _ in range(steps):
        out.append(moved(out[-1], translation_m, rotvec_rad))
    follower = JointFollower(KINEMATICS, HOME_RAD)
    run = follow(out + out[::-1], 20, follower)
    assert told in run.hits
    assert_joints_keep_their_limits(run, follower)
    end = KINEMATICS.forward(run.position_rad[-1])
    assert np.linalg.norm(end.position_m - out[0].position_m) < RECOVERED_M
    assert np.abs(run.velocity_rad_s[-1]).max() < 0.2
    assert np.linalg.norm(run.position_rad[-1] - HOME_RAD) < 0.8  # the same branch


@settings(max_examples=5)
@given(
    st.lists(
        st.tuples(*[st.floats(-0.6, 0.6)] * 3, *[st.floats(-1.5, 1.5)] * 3), min_size=3, max_size=8
    )
)
def test_joints_keep_their_limits_whatever_is_asked(deltas: list[tuple[float, ...]]) -> None:
    home = KINEMATICS.forward(HOME_RAD)
    goals = [moved(home, delta[:3], delta[3:]) for delta in deltas]
    follower = JointFollower(KINEMATICS, HOME_RAD)
    assert_joints_keep_their_limits(follow(goals, 40, follower), follower)


def test_a_far_target_at_rest_is_reached_without_overshoot() -> None:
    follower = JointFollower(KINEMATICS, HOME_RAD)
    goal = KINEMATICS.forward(tool_down_at(KINEMATICS, 0.5, 0.2, 0.4))
    joints = JointMotion.standing(HOME_RAD)
    left = []
    for _ in range(2 * STREAM_HZ):
        joints, _ = follower.step(joints, goal, np.zeros(6), 1 / STREAM_HZ)
        left.append(np.linalg.norm(goal.position_m - KINEMATICS.forward(joints[0]).position_m))
    assert left[-1] < RECOVERED_M
    arrived = next(tick for tick, distance_m in enumerate(left) if distance_m < OVERSHOOT_M)
    assert max(left[arrived:]) < OVERSHOOT_M


def test_a_share_of_the_velocity_limits_is_kept() -> None:
    follower = JointFollower(KINEMATICS, HOME_RAD, velocity_rad_s=0.1 * KINEMATICS.velocity_rad_s)
    run = follow([moved(KINEMATICS.forward(HOME_RAD), [0, 0, 0.4], [0, 0, 0])], 500, follower)
    assert np.abs(run.velocity_rad_s).max() <= 0.261 * OVER_LIMIT
    assert "joint_velocity" in run.hits


def test_a_brake_stops_the_joints_within_their_acceleration() -> None:
    follower = JointFollower(KINEMATICS, HOME_RAD)
    velocity = np.array([1.0, -0.5, 0.2, 0.0, 0.01, -1.0, 2.0])
    joints = JointMotion(HOME_RAD, velocity, np.zeros(7), velocity)
    ticks = 0
    while np.abs(joints.velocity_rad_s).max() > 0:
        slower = follower.brake(joints, 1 / STREAM_HZ)
        change = np.abs(slower.velocity_rad_s - joints.velocity_rad_s) * STREAM_HZ
        assert (change <= follower.acceleration_rad_s2 * OVER_LIMIT).all()
        joints, ticks = slower, ticks + 1
    assert ticks == 50  # 2 rad/s at 10 rad/s^2
