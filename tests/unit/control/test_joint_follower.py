"""Joints that follow a pose stream: near to it, within their limits, and standing in time."""

from __future__ import annotations

import daqp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from vla_zenoh.control.joint_follower import (
    ELBOW_COST,
    EXCESS_COST,
    DistanceConstraints,
    JointFollower,
    JointMotion,
    nearest_velocities,
)
from vla_zenoh.control.limits import into_workspace, joint_motion_limits, motion_limits
from vla_zenoh.control.pose_to_joint import FAR, LAG_M, LAG_RAD, PoseToJoint
from vla_zenoh.control.reachability import ReachabilityFilter
from vla_zenoh.control.smoothing import Smoother
from vla_zenoh.kinematics.kinematics import make_kinematics, smallest_singular_value
from vla_zenoh.kinematics.so3 import Pose, exp3, pose_distance
from vla_zenoh.profile import Profile, load_profile, override
from vla_zenoh.types import FloatArray

BASE = load_profile("panda_sim")
KINEMATICS = make_kinematics(BASE)
HOME_RAD = KINEMATICS.ordered(BASE.robot.arm_joints, BASE.robot.home_rad)
TICK_S = 1 / BASE.timing.command_hz
STEP_TICKS = 25
MOST_LAG_M, MOST_LAG_RAD = 1.25 * FAR * LAG_M, 1.25 * FAR * LAG_RAD
STRAIGHT_M = 0.001
RTOL = 1e-6
# Straight on, and not quite as fast as each joint could by itself.
LONGER, SETTLING_S = 1.5, 0.12
STANDING_M_S = 0.002
OVERSHOOT_M = 0.06  # of 0.2 m/s, with what the joints can


def profile(**joint: float) -> Profile:
    limits = {"limits": {"joint": joint}} if joint else {}
    return override(BASE, {"robot": {"command": "joint"}, **limits})


class Arm:
    """A pose stream, and joints that follow it perfectly timed."""

    def __init__(self, of: Profile) -> None:
        self.limits = joint_motion_limits(of)
        self.stage = PoseToJoint(of, KINEMATICS)
        self.stage.restart(HOME_RAD)
        self.goal = KINEMATICS.forward(HOME_RAD)
        self.smoother = Smoother(self.goal, TICK_S, motion_limits(of.limits))
        self.joints_rad, self.rate_rad_s = HOME_RAD, np.zeros(len(HOME_RAD))
        self.acceleration = np.zeros(len(HOME_RAD))
        self.jerk = 0.0

    def step(self, way_m: FloatArray, turn_rad: FloatArray, ticks: int = STEP_TICKS) -> None:
        """One step of a chunk, and the time it has."""
        here = self.smoother.motion
        goal = Pose(self.goal.position_m + way_m, exp3(turn_rad) @ self.goal.rotation)
        if pose_distance(here.pose, goal)[0] < BASE.limits.lead_m:
            self.goal = goal
        self.smoother.target(self.goal, self.stage.shares(here, self.goal, self.smoother.box))
        for _ in range(ticks):
            self.tick()

    def tick(self, *, braking: bool = False) -> None:
        if braking:
            self.stage.brake(self.smoother)
        self.stage.tick(self.smoother, braking=braking)
        told = self.stage.command("active", None)
        assert (np.abs(told.velocity_rad_s) <= self.limits.velocity_rad_s * (1 + RTOL)).all()
        most = self.limits.acceleration_rad_s2 * (1 + RTOL)
        assert (np.abs(told.acceleration_rad_s2) <= most).all()
        change = np.abs(told.acceleration_rad_s2 - self.acceleration) / TICK_S
        self.jerk = max(self.jerk, float((change / self.limits.jerk_rad_s3).max()))
        self.joints_rad, self.rate_rad_s = told.position_rad, told.velocity_rad_s
        self.acceleration = told.acceleration_rad_s2

    def lag(self) -> tuple[float, float]:
        return pose_distance(KINEMATICS.forward(self.joints_rad), self.smoother.motion.pose)

    def speed_m_s(self) -> float:
        return float(np.linalg.norm((KINEMATICS.jacobian(self.joints_rad) @ self.rate_rad_s)[:3]))

    def stop_s(self) -> float:
        """How long it takes until the TCP stands."""
        last = 0
        for n in range(1, 400):
            self.tick(braking=True)
            if self.speed_m_s() > STANDING_M_S:
                last = n
            if self.stage.at_rest and self.smoother.at_rest:
                break
        return last * TICK_S

    def shortest_stop_s(self) -> float:
        """What the slowest joint needs for it."""
        _, most, jerk = self.limits
        return float((np.abs(self.rate_rad_s) / most + most / jerk).max())


ways = st.tuples(*[st.floats(-0.03, 0.03)] * 3, *[st.floats(-0.1, 0.1)] * 3).map(np.array)


@given(
    st.lists(st.tuples(ways, st.integers(1, 8)), min_size=1, max_size=4),
    st.sampled_from([{}, {"velocity_rad_s": 0.3}, {"acceleration_rad_s2": 0.7}]),
)
@settings(max_examples=5, deadline=None)
def test_joints_are_never_far_from_the_pose_and_stop_when_told_whatever_they_can(
    orders: list[tuple[FloatArray, int]], joint: dict[str, float]
) -> None:
    arm = Arm(profile(**joint))
    for way, times in orders:
        for _ in range(times):
            arm.step(way[:3], way[3:])
            apart_m, apart_rad = arm.lag()
            assert apart_m <= MOST_LAG_M
            assert apart_rad <= MOST_LAG_RAD
    allowed_s = LONGER * arm.shortest_stop_s() + SETTLING_S
    assert arm.stop_s() <= allowed_s
    assert arm.stage.at_rest
    assert arm.smoother.at_rest
    assert arm.lag()[0] <= LAG_M


@pytest.mark.parametrize("speed_m_s", [0.1, 0.2, 0.3, 0.4])
@pytest.mark.parametrize("axis", ["down", "aside"])
def test_a_straight_motion_is_straight_smooth_and_stopped_as_fast_as_the_joints_can(
    axis: str, speed_m_s: float
) -> None:
    arm = Arm(profile())
    way_m = np.array([0.0, 0.0, -0.1] if axis == "down" else [0.0, 0.1, 0.0]) * speed_m_s
    for _ in range(5):
        arm.step(way_m, np.zeros(3))
        assert arm.lag()[0] < STRAIGHT_M
    allowed_s = LONGER * arm.shortest_stop_s() + SETTLING_S
    assert arm.stop_s() <= allowed_s
    assert arm.jerk <= 1.0


def test_an_arm_that_was_held_back_is_stopped_where_it_is_and_not_where_it_was_to_be() -> None:
    arm = Arm(profile())
    for _ in range(4):
        arm.step(np.array([0.0, 0.0, -0.02]), np.zeros(3))
    # As a pose stream that was planned without the joints: far ahead of them at once.
    arm.smoother.reset(Pose(arm.smoother.motion.pose.position_m - [0, 0, 0.04], arm.goal.rotation))
    before_m, allowed_s = KINEMATICS.forward(arm.joints_rad).position_m, arm.shortest_stop_s()
    rate = arm.speed_m_s()
    assert arm.stop_s() <= allowed_s + SETTLING_S
    way_m = float(np.linalg.norm(KINEMATICS.forward(arm.joints_rad).position_m - before_m))
    assert way_m <= rate * allowed_s
    assert arm.smoother.at_rest


@pytest.mark.parametrize("ticks", [1, 10])
def test_a_stop_of_the_joints_that_is_called_off_goes_on_from_where_they_are(ticks: int) -> None:
    arm = Arm(profile())
    for _ in range(4):
        arm.step(np.array([0.0, 0.0, -0.02]), np.zeros(3))
    arm.smoother.reset(Pose(arm.smoother.motion.pose.position_m - [0, 0, 0.04], arm.goal.rotation))
    for _ in range(ticks):
        arm.tick(braking=True)
    arm.goal = arm.smoother.motion.pose
    arm.step(np.zeros(3), np.zeros(3), 0)
    furthest_m = 0.0
    for _ in range(500):
        arm.tick()
        furthest_m = max(furthest_m, pose_distance(arm.smoother.motion.pose, arm.goal)[0])
    assert furthest_m < OVERSHOOT_M
    assert arm.smoother.at_rest


# -- what is held whatever is asked for ------------------------------------------------------------
BOX = BASE.limits.workspace
BEYOND_BOX_M = 1e-4
BEYOND_STOP_M = 1e-3
LEAST_JERK_RTOL = 1e-6


def beyond_box_m(position_m: FloatArray) -> float:
    low, high = np.array([BOX.x_m, BOX.y_m, BOX.z_m]).T
    return float(np.maximum(low - position_m, position_m - high).max())


@given(st.lists(st.tuples(ways, st.integers(1, 10), st.booleans()), min_size=2, max_size=5))
@settings(max_examples=5)
def test_every_joint_keeps_its_jerk_and_the_tcp_its_box_whatever_is_asked_for(
    orders: list[tuple[FloatArray, int, bool]],
) -> None:
    arm = Arm(profile())
    for way, times, stops in orders:
        for _ in range(times):
            goal_m, _ = into_workspace(BASE.limits, arm.goal.position_m + 3 * way[:3])
            arm.step(goal_m - arm.goal.position_m, 3 * way[3:])
            assert beyond_box_m(KINEMATICS.forward(arm.joints_rad).position_m) <= BEYOND_BOX_M
        if stops:
            arm.stop_s()
            arm.goal = arm.smoother.motion.pose
    assert arm.jerk <= 1.0 + LEAST_JERK_RTOL


@pytest.mark.parametrize("way_m", [[0, 0.04, 0], [-0.02, 0, 0.02], [0, 0, -0.03]])
def test_a_pose_that_leaves_the_box_is_not_followed_out_of_it(way_m: list[float]) -> None:
    arm = Arm(profile())
    furthest_m = -1.0
    for _ in range(28):
        arm.step(np.array(way_m), np.zeros(3))
        furthest_m = max(furthest_m, beyond_box_m(KINEMATICS.forward(arm.joints_rad).position_m))
    assert beyond_box_m(arm.smoother.motion.pose.position_m) > 0.01
    assert -0.001 < furthest_m <= BEYOND_BOX_M


@pytest.mark.parametrize(
    ("seed", "joint", "ticks"),
    [
        (17, {"acceleration_rad_s2": 2.25, "jerk_rad_s3": 187.5}, (10, 150)),
        (5, {}, (20, 200)),  # 0.4 mm if joints may brake for each face as if for it alone
    ],
)
def test_the_tcp_stays_in_a_corner_of_its_box_whose_faces_need_the_same_joints(
    seed: int, joint: dict[str, float], ticks: tuple[int, int]
) -> None:
    """Goals at corners and on the leash; a new one bends the way while the arm is fast."""
    here = KINEMATICS.forward(HOME_RAD)
    low, high = here.position_m - 0.1, here.position_m + 0.1
    faces = np.stack([low, high], axis=1).tolist()
    box = dict(zip(("x_m", "y_m", "z_m"), faces, strict=True))
    arm = Arm(override(profile(**joint), {"limits": {"workspace": box}}))
    rng, beyond_m = np.random.default_rng(seed), -1.0
    for _ in range(10):
        at_m = arm.smoother.motion.pose.position_m
        way_m = here.position_m + rng.choice([-0.1, 0.1], 3) - at_m
        way_m *= min(1.0, 0.14 / float(np.linalg.norm(way_m)))
        turn = exp3(rng.uniform(-0.2, 0.2, 3))
        arm.goal = Pose(np.clip(at_m + way_m, low, high), turn @ here.rotation)
        shares = arm.stage.shares(arm.smoother.motion, arm.goal, arm.smoother.box)
        arm.smoother.target(arm.goal, shares)
        for _ in range(int(rng.integers(*ticks))):
            arm.tick()
            tcp_m = KINEMATICS.forward(arm.joints_rad).position_m
            beyond_m = max(beyond_m, float(np.maximum(low - tcp_m, tcp_m - high).max()))
    assert -BEYOND_BOX_M <= beyond_m <= BEYOND_BOX_M


def test_a_motion_that_slow_joints_bound_is_planned_so_that_no_pose_waits_for_them() -> None:
    arm = Arm(profile(velocity_rad_s=0.3))
    arm.goal = Pose(arm.goal.position_m + [0.0, 0.2, -0.1], arm.goal.rotation)
    while not arm.smoother.at_rest or not arm.speed_m_s():
        here = arm.smoother.motion
        arm.smoother.target(arm.goal, arm.stage.shares(here, arm.goal, arm.smoother.box))
        for _ in range(STEP_TICKS):
            arm.tick()
            assert arm.stage.time_rate == 1.0
            assert arm.lag()[0] < STRAIGHT_M


@pytest.mark.parametrize("joint", range(7))
def test_a_joint_at_its_velocity_slows_the_others_alike(joint: int) -> None:
    most = np.full(7, 100.0)
    free, slow = (
        JointFollower(KINEMATICS, HOME_RAD, velocity_rad_s=limits)
        for limits in (most, np.where(np.arange(7) == joint, 0.05, most))
    )
    rest = JointMotion(HOME_RAD, np.zeros(7), np.zeros(7), np.zeros(7))
    target = KINEMATICS.forward(HOME_RAD + 0.1)
    wanted, kept = (
        of.step(rest, target, np.zeros(6), TICK_S)[0].wanted_rad_s for of in (free, slow)
    )
    assert abs(wanted[joint]) > 0.1
    assert abs(kept[joint]) == pytest.approx(0.05)
    np.testing.assert_allclose(kept, wanted * 0.05 / abs(wanted[joint]), rtol=1e-6)


@st.composite
def constrained_velocities(draw: st.DrawFn) -> tuple[FloatArray, ...]:
    """What `nearest_velocities` takes, of three joints and two constraints."""
    numbers = st.floats(-1.0, 1.0)
    three = st.tuples(numbers, numbers, numbers).map(np.array)
    jacobian, wanted, middle = np.array([draw(three) for _ in range(3)]), draw(three), draw(three)
    room = np.array([draw(st.floats(0.01, 1.0)) for _ in range(3)])
    allowed = np.array([draw(numbers), draw(numbers)])
    metric = jacobian.T @ jacobian + ELBOW_COST * np.eye(3)
    return wanted, metric, jacobian[:2], allowed, middle - room, middle + room


@given(constrained_velocities(), st.integers(0, 2**32 - 1))
@settings(max_examples=100)
def test_no_velocities_within_the_limits_of_the_joints_are_nearer_or_exceed_constraints_less(
    given: tuple[FloatArray, ...], seed: int
) -> None:
    wanted, metric, rows, allowed, low, high = given
    found = nearest_velocities(*given)
    assert (found >= low).all()
    assert (found <= high).all()

    def cost(velocities: FloatArray) -> FloatArray:
        change = velocities - wanted
        excess = np.maximum(velocities @ rows.T - allowed, 0.0)
        return ((change @ metric) * change).sum(-1) + EXCESS_COST * (excess**2).sum(-1)

    rng = np.random.default_rng(seed)
    anywhere = rng.uniform(low, high, (200, 3))
    nearby = np.clip(found + rng.normal(0.0, 1e-3, (200, 3)), low, high)
    assert cost(found) <= cost(np.concatenate([anywhere, nearby])).min() * (1 + 1e-9) + 1e-9


def test_a_constraint_holds_where_the_joint_that_costs_least_brakes_as_hard_as_it_can() -> None:
    row, metric = np.array([[0.3, 0.2, -0.1]]), np.diag([0.01, 1.0, 1.0])
    wanted, low, high = np.array([0.1, 0.2, -0.1]), np.array([0.1, 0.0, -0.3]), np.full(3, 0.4)
    found = nearest_velocities(wanted, metric, row, np.array([0.04]), low, high)
    assert float(row[0] @ found) == pytest.approx(0.04, abs=1e-6)
    assert found[0] == pytest.approx(0.1)


def test_every_joint_brakes_where_the_program_has_no_solution(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Which no input is known to cause."""
    monkeypatch.setattr(daqp, "solve", lambda *_: (np.full(4, np.nan), 0.0, -2, {}))
    low, high = np.array([-0.3, 0.1, -0.5]), np.array([0.3, 0.4, -0.2])
    found = nearest_velocities(high, np.eye(3), np.eye(3)[:1], np.zeros(1), low, high)
    assert found.tolist() == [0.0, 0.1, -0.2]


def test_a_goal_beyond_the_leash_is_followed_as_one_on_it_and_told() -> None:
    """Such goals do not come from the pipeline."""
    follower, here = PoseToJoint(profile(), KINEMATICS)._follower, KINEMATICS.forward(HOME_RAD)
    standing, along, turn = JointMotion.standing(HOME_RAD), np.array([0.6, -0.8, 0.0]), np.eye(3)[2]
    lead_m, lead_rad = BASE.limits.lead_m, BASE.limits.lead_rad
    reached, told = [], []
    for far in (1.0, 3.0):
        there_m = here.position_m + far * lead_m * along
        target = Pose(there_m, exp3(far * lead_rad * turn) @ here.rotation)
        moved, hits = follower.step(standing, target, np.zeros(6), TICK_S)
        reached.append(moved.velocity_rad_s)
        told.append({hit.name for hit in hits if "lead" in hit.name})
    assert reached[1] == pytest.approx(reached[0], rel=RTOL)
    assert told == [set(), {"lead_m", "lead_rad"}]


@pytest.mark.parametrize("way_m", [[0.0, 0.1, 0.0], [0.0, 0.0, -0.1]])
def test_a_pose_is_no_faster_than_slow_joints_can_follow(way_m: list[float]) -> None:
    slow_rad_s, fastest_rad_s = 0.3, 0.0
    arm = Arm(profile(velocity_rad_s=slow_rad_s))
    arm.step(np.array(way_m), np.zeros(3), 0)
    for _ in range(150):
        arm.tick()
        assert arm.stage.time_rate == 1.0, "it does not wait for them"
        fastest_rad_s = max(fastest_rad_s, float(np.abs(arm.rate_rad_s).max()))
    assert fastest_rad_s > 0.7 * slow_rad_s


def test_joints_too_slow_for_a_pose_slow_down_together_and_keep_its_direction() -> None:
    follower = JointFollower(KINEMATICS, HOME_RAD, acceleration_rad_s2=200.0)
    motion, aside = JointMotion.standing(HOME_RAD), np.array([0.0, 5.0, 0.0, 0.0, 0.0, 0.0])
    for _ in range(10):
        here = KINEMATICS.forward(motion.position_rad)
        motion, hits = follower.step(motion, here, aside, TICK_S)
        assert {hit.name for hit in hits} == {"joint_velocity"}
    fastest = float((np.abs(motion.velocity_rad_s) / follower.velocity_rad_s).max())
    assert fastest == pytest.approx(1.0, rel=RTOL)
    twist = KINEMATICS.jacobian(motion.position_rad) @ motion.velocity_rad_s
    assert np.linalg.norm(twist - aside * twist[1] / aside[1]) < 0.1 * twist[1]


def test_an_arm_that_begins_outside_of_the_box_is_led_in() -> None:
    arm = Arm(profile())
    inside = KINEMATICS.forward(HOME_RAD)
    arm.stage = PoseToJoint(
        override(profile(), {"limits": {"workspace": {"x_m": [0.2, 0.4]}}}), KINEMATICS
    )
    arm.stage.restart(HOME_RAD)
    assert inside.position_m[0] > 0.42
    for _ in range(8):
        arm.step(np.array([-0.01, 0, 0]), np.zeros(3))
    for _ in range(100):
        arm.tick()
    assert KINEMATICS.forward(arm.joints_rad).position_m[0] < 0.4
    assert arm.jerk <= 1.0 + LEAST_JERK_RTOL


@pytest.mark.parametrize(
    ("way_m", "turn_rad", "name"),
    [
        ([0.01, 0, -0.03], [0, 0, 0], "table_distance"),
        ([-0.02, 0, 0.01], [0, 0.1, 0], "self_collision"),
    ],
)
def test_commanded_joints_stop_before_the_arm_touches_itself_or_the_table(
    way_m: list[float], turn_rad: list[float], name: str
) -> None:
    """Whoever bounds the goals: here nobody does."""
    low = override(BASE, {"limits": {"workspace": {"z_m": [-0.3, 0.9], "x_m": [-0.3, 0.75]}}})
    of = override(low, {"robot": {"command": "joint"}})
    barriers = ReachabilityFilter(of, KINEMATICS).barriers
    arm = Arm(of)
    arm.stage = PoseToJoint(of, KINEMATICS, barriers)
    arm.stage.restart(HOME_RAD)
    nearest_m = 1.0
    for _ in range(30):
        arm.step(np.array(way_m), np.array(turn_rad))
        left_m = barriers.collisions.distances(arm.joints_rad) - barriers.stop[1:]
        nearest_m = min(nearest_m, float(left_m.min()))
    assert -BEYOND_STOP_M < nearest_m < 0.005
    assert name in arm.stage.stuck
    assert arm.jerk <= 1.0 + LEAST_JERK_RTOL


def test_a_face_of_the_box_is_told_as_the_workspace_whatever_else_is_near() -> None:
    constraints = DistanceConstraints(BASE.limits, ReachabilityFilter(BASE, KINEMATICS).barriers)
    constraints.update(HOME_RAD)
    assert [constraints.hit(face, 0.001).name for face in range(6)] == ["workspace"] * 6


def test_a_joint_that_brakes_gently_stops_before_its_end() -> None:
    """Which takes it more than a second and half of its range."""
    follower = JointFollower(KINEMATICS, HOME_RAD, acceleration_rad_s2=0.5, jerk_rad_s3=5.0)
    still, ahead_rad = np.zeros(7), np.eye(7)[6]
    start_rad = np.where(ahead_rad, follower.lower_rad, HOME_RAD)
    motion, fastest_rad_s = JointMotion(start_rad, still, still, still), 0.0
    for _ in range(400):
        here, jacobian = KINEMATICS.pose_and_jacobian(motion.position_rad)
        motion, _ = follower.step(motion, here, jacobian @ (2.0 * ahead_rad), 0.02)
        fastest_rad_s = max(fastest_rad_s, motion.velocity_rad_s[6])
    assert fastest_rad_s > 1.2
    assert follower.upper_rad[6] - 0.05 < motion.position_rad[6] <= follower.upper_rad[6] + RTOL


def test_an_arm_that_brakes_gently_does_not_slip_through_a_singularity() -> None:
    """A pose goes on beyond the reach at 0.4 m/s; the arm is slow enough before it is stretched."""
    follower = JointFollower(KINEMATICS, HOME_RAD, acceleration_rad_s2=1.0, jerk_rad_s3=50.0)
    motion, here = JointMotion.standing(HOME_RAD), KINEMATICS.forward(HOME_RAD)
    twist, least = np.array([0.343, 0.0, 0.206, 0.0, 0.0, 0.0]), 1.0
    for number in range(900):
        pose = Pose(here.position_m + number * TICK_S * twist[:3], here.rotation)
        motion, _ = follower.step(motion, pose, twist, TICK_S)
        least = min(least, smallest_singular_value(KINEMATICS.jacobian(motion.position_rad)))
    assert least == pytest.approx(BASE.limits.reach.singularity_stop, rel=0.01)


def test_slopes_of_distances_are_those_of_small_steps() -> None:
    collisions = ReachabilityFilter(BASE, KINEMATICS).barriers.collisions
    random, compared = np.random.default_rng(0), 0
    for _ in range(40):
        joints_rad = np.clip(
            HOME_RAD + 0.4 * random.normal(size=7), KINEMATICS.lower_rad, KINEMATICS.upper_rad
        )
        near = np.flatnonzero(np.abs(collisions.distances(joints_rad) - 0.05) < 0.04)
        slopes = collisions.gradients(joints_rad, near.tolist())
        for joint, unit in enumerate(np.eye(7) * 1e-5):
            apart = collisions.distances(joints_rad + unit) - collisions.distances(
                joints_rad - unit
            )
            error = np.abs(slopes[:, joint] - apart[near] / 2e-5)
            assert (error < 0.1).all()  # m/rad; the nearest corner changes
            compared += len(near)
            assert not len(near) or np.median(error) < 0.01
    assert compared > 100
