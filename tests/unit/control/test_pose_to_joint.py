"""Joint commands out of the pose stream: how the elbow sets out and stops, how a stream begins."""

from __future__ import annotations

from copy import copy

import numpy as np
import pinocchio as pin
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from vla_zenoh.control.chunk_planner import ChunkPlanner
from vla_zenoh.control.limits import into_workspace, joint_motion_limits, motion_limits
from vla_zenoh.control.motion_pipeline import MotionPipeline
from vla_zenoh.control.plan_timeline import Goal
from vla_zenoh.control.pose_to_joint import FollowedPath, PoseToJoint
from vla_zenoh.control.reachability import ReachabilityFilter
from vla_zenoh.control.smoothing import Smoother
from vla_zenoh.control.states import MotionMode, State
from vla_zenoh.kinematics.kinematics import make_kinematics
from vla_zenoh.kinematics.so3 import Pose, exp3, quat_from_rotation
from vla_zenoh.profile import load_profile, override
from vla_zenoh.types import FloatArray, JointCommand, JointState, PoseState, Task

PROFILE = override(load_profile("panda_sim"), {"robot": {"command": "joint", "posture": "home"}})
KINEMATICS = make_kinematics(PROFILE)
LIMITS = joint_motion_limits(PROFILE)
HOME_RAD = KINEMATICS.ordered(PROFILE.robot.arm_joints, PROFILE.robot.home_rad)
ELBOW_OUT_RAD = HOME_RAD + np.array([0.3, 0.0, -0.3, 0.0, 0.3, 0.0, 0.0])
TICK_S, TICK_NS = 0.004, 4_000_000
START_NS = 1_700_000_000_000_000_000
RTOL = 1e-6
MOVING_RAD_S = 0.05
BOX_M = 1e-5
LEAST_STOP_M = 0.005  # of part_stop_m


@given(st.lists(st.tuples(st.booleans(), st.integers(1, 60)), min_size=1, max_size=6))
@settings(max_examples=6, deadline=None)
def test_the_elbow_sets_out_and_stops_within_the_jerk_limit(
    phases: list[tuple[bool, int]],
) -> None:
    stage = PoseToJoint(PROFILE, KINEMATICS)
    stage.restart(ELBOW_OUT_RAD)
    standing = Smoother(KINEMATICS.forward(ELBOW_OUT_RAD), TICK_S, motion_limits(PROFILE.limits))
    before = np.zeros(len(HOME_RAD))
    for braking, ticks in [*phases, (True, 250)]:
        for _ in range(ticks):
            stage.tick(standing, braking=braking)
            acceleration = stage.command("active", None).acceleration_rad_s2
            jerk = np.abs(acceleration - before) / TICK_S
            assert (jerk <= LIMITS.jerk_rad_s3 * (1 + RTOL)).all()
            before = acceleration
    assert stage.at_rest


PLACES = st.tuples(*[st.floats(-0.4, 0.4)] * 3)


@given(outside_m=st.floats(0.0005, 0.02), axis=st.integers(0, 2), high=st.booleans(), way_m=PLACES)
@settings(max_examples=60, deadline=None)
def test_no_goal_is_further_outside_the_box_than_the_arm_where_the_path_leaves_it(
    outside_m: float, axis: int, high: bool, way_m: tuple[float, float, float]
) -> None:
    """The box bounds the joints, not the path that they follow."""
    path = FollowedPath(PROFILE, PoseToJoint(PROFILE, KINEMATICS))
    path.joints.restart(HOME_RAD)
    inside = KINEMATICS.forward(HOME_RAD)
    corners = PROFILE.limits.workspace.corners_m
    start_m = inside.position_m.copy()
    start_m[axis] = corners[high][axis] + (outside_m if high else -outside_m)
    path.reset(Pose(start_m, inside.rotation))
    there_m, _ = into_workspace(PROFILE.limits, start_m + way_m)
    asked = Goal(Pose(there_m, inside.rotation), 0.08)
    goals = [path.leash(asked, TICK_S)[0], path.near(asked), path.resting_goal(path.tcp.pose, 0.08)]
    for goal in goals:
        assert into_workspace(PROFILE.limits, goal.pose.position_m)[1] <= BOX_M


class Moved:
    """A mover of joints, and what the robot last said of itself."""

    def __init__(self) -> None:
        self.shadow = ReachabilityFilter(PROFILE)
        self.mover = MotionPipeline(PROFILE, self.shadow, ChunkPlanner(PROFILE, self.shadow))
        self.now_ns = START_NS

    def activate(self, joints_rad: FloatArray) -> None:
        pose, zero = KINEMATICS.forward(joints_rad), np.zeros(len(joints_rad))
        self.mover.anchor(
            PoseState(pose.position_m, quat_from_rotation(pose.rotation), np.zeros(6)),
            0.08,
            JointState(KINEMATICS.arm_joints, joints_rad, zero, zero, joints_rad),
            self.now_ns,
            blocked=False,
        )

    def tick(self, ticks: int = 1) -> JointCommand:
        self.now_ns += ticks * TICK_NS
        task = Task(0, True, "hold", "scripted", 5.0)
        overdue_ns = self.now_ns + 10**9
        self.mover.advance(State.ACTIVE, task, overdue_ns, self.now_ns, ticks)
        joint = self.mover.command(State.ACTIVE)
        assert isinstance(joint, JointCommand)
        return joint


def test_an_arm_of_which_the_elbow_alone_moves_is_activated_without_a_step() -> None:
    robot = Moved()
    robot.activate(ELBOW_OUT_RAD)
    sent = [robot.tick() for _ in range(100)]
    assert np.abs(sent[-1].velocity_rad_s).max() > MOVING_RAD_S
    robot.activate(sent[-4].position_rad)  # the state heard is some milliseconds old
    change = np.abs(robot.tick().velocity_rad_s - sent[-1].velocity_rad_s)
    assert (change <= LIMITS.acceleration_rad_s2 * TICK_S * (1 + RTOL)).all()


def test_a_stream_begins_at_rest_however_late_its_first_tick_is() -> None:
    robot = Moved()
    robot.activate(ELBOW_OUT_RAD)
    first = robot.tick(ticks=20)
    assert (np.abs(first.velocity_rad_s) <= LIMITS.jerk_rad_s3 * TICK_S**2).all()


def test_an_arm_that_is_asked_for_nothing_keeps_its_elbow_unless_the_profile_says_home() -> None:
    for posture, moves in (("start", False), ("home", True)):
        of = override(PROFILE, {"robot": {"posture": posture}})
        stage = PoseToJoint(of, KINEMATICS)
        stage.restart(ELBOW_OUT_RAD)
        pose = KINEMATICS.forward(ELBOW_OUT_RAD)
        standing = Smoother(pose, TICK_S, motion_limits(of.limits))
        for _ in range(250):
            stage.tick(standing)
        moved_rad = np.abs(stage.position_rad - ELBOW_OUT_RAD).max()
        assert (moved_rad > 0.05) == moves
        assert moves or (moved_rad < 1e-6 and stage.at_rest)


def test_a_pose_that_the_joints_cannot_have_is_said_and_not_waited_for_for_ever() -> None:
    stage = PoseToJoint(PROFILE, KINEMATICS)
    stage.restart(HOME_RAD)
    pose = KINEMATICS.forward(HOME_RAD)
    stream = Smoother(pose, TICK_S, motion_limits(PROFILE.limits))
    ahead = Pose(pose.position_m, exp3(np.array([0.0, 0.0, 1.2])) @ pose.rotation)
    out_m = Pose(pose.position_m + [0.0, 0.0, 1.0], ahead.rotation)  # further than it reaches
    stream.target(out_m)
    assert stage.stuck == ""
    for _ in range(2500):
        stage.tick(stream)
        if stage.stuck:
            break
    assert stage.stuck.startswith("the joints cannot follow the pose: it has waited for them")
    for _ in range(500):
        stage.brake(stream)
        stage.tick(stream, braking=True)
    assert stage.at_rest
    assert stream.at_rest
    stage.keep_elbow()
    assert stage.stuck == ""


def test_joints_that_are_held_stop_with_a_pose_that_stands() -> None:
    stage = PoseToJoint(PROFILE, KINEMATICS)
    at_end, margin_rad = ELBOW_OUT_RAD.copy(), PROFILE.limits.reach.joint_margin_rad
    at_end[3] = KINEMATICS.lower_rad[3] + margin_rad + 1e-3
    stage.restart(at_end)
    pose = KINEMATICS.forward(at_end)
    stream = Smoother(pose, TICK_S, motion_limits(PROFILE.limits))
    stream.target(Pose(pose.position_m, pose.rotation @ exp3(np.array([0.0, 0.01, 0.0]))))
    for _ in range(150):
        stage.tick(stream)
    stage.brake(stream)
    for _ in range(125):
        stage.tick(stream, braking=True, elbow=False)
    assert stage.at_rest


def braked_from(path: FollowedPath) -> FloatArray:
    """The joints after one more tick and a brake, of a copy."""
    ahead = copy(path)
    ahead.joints = copy(path.joints)
    ahead.joints._follower = copy(path.joints._follower)
    ahead.step(MotionMode.FOLLOW)
    while not ahead.stands:
        ahead.pause()
        ahead.step(MotionMode.PAUSE)
    return ahead.joints_rad


def links_m(joints_rad: FloatArray) -> FloatArray:
    """(n, 3) where the links are."""
    data = KINEMATICS.model.createData()
    pin.forwardKinematics(KINEMATICS.model, data, joints_rad)
    return np.array([frame.translation for frame in data.oMi])


@pytest.mark.parametrize(
    ("seed", "ticks"),
    [
        *((3, 200), (1, 140)),
        *(pytest.param(seed, 1200, marks=pytest.mark.slow) for seed in range(10)),
    ],
)
def test_an_arm_that_brakes_ends_near_a_place_that_was_said_before(seed: int, ticks: int) -> None:
    """Two arms that are as wrong, towards each other, do not touch at the least stop."""
    of, random = load_profile("two_pandas_sim").of_part("left"), np.random.default_rng(seed)
    path, home_rad = FollowedPath(of, PoseToJoint(of, KINEMATICS)), np.array(of.robot.home_rad)
    start_rad = home_rad + random.uniform(-0.3, 0.3, len(home_rad))
    path.joints.restart(start_rad)
    path.reset(KINEMATICS.forward(start_rad))
    asked, changes, worst_m = Goal(path.motion.pose, 0.04), 0, 0.0
    for tick in range(ticks):
        if tick >= changes:
            changes = tick + int(random.integers(5, 120))
            there_m = random.uniform(*of.limits.tcp_box.corners_m)
            turn = exp3(0.6 * random.normal(size=3)) @ KINEMATICS.forward(home_rad).rotation
            asked = Goal(Pose(there_m, turn), 0.04)
        goal, _ = path.leash(asked, TICK_S)
        if tick % 5 == 0:
            path.go_to(goal, path.shares(goal))
        path.step(MotionMode.FOLLOW)
        if tick % 8 == 0 and not path.stands:
            said = [links_m(place_rad) for place_rad in path.stopping_rad(TICK_S)]
            ended = links_m(braked_from(path))
            off_m = [np.linalg.norm(place - ended, axis=1).max() for place in said]
            worst_m = max(worst_m, min(off_m))
    assert 2 * worst_m < LEAST_STOP_M + 2 * path.strays_m
