"""The workspace box of an arm that moves in joints: goals and commands stay inside it."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from command_rig import OFTEN
from joint_rig import Joints, panda
from panda_arm import HOME_RAD

from vla_zenoh.control.axis_smoothing import AxisState
from vla_zenoh.control.commander_io import Setting, StateHistory
from vla_zenoh.control.joint_space import STEP_HALVINGS, JointBounds, JointPath
from vla_zenoh.control.limits import (
    PAUSE_LEAD_RAD,
    BoundedStep,
    Shares,
    Slowdown,
    workspace_corners,
)
from vla_zenoh.control.plan_timeline import JointGoal, joint_goal
from vla_zenoh.control.reachability import ReachabilityFilter
from vla_zenoh.control.step_space import JointSteps
from vla_zenoh.kinematics.so3 import angle_between
from vla_zenoh.types import FloatArray, Header, JointState, Stamped

BOX = workspace_corners(panda().limits)
OUTSIDE_M = 1e-4
LEAD_RAD = 0.6
PASSED_RAD = 1e-6


def made_path(command_hz: float = OFTEN["command_hz"]) -> JointPath:
    profile = panda(timing={"command_hz": command_hz})
    reach = ReachabilityFilter(profile)
    path = JointPath(profile, JointBounds(profile, reach.kinematics, reach.barriers))
    path.stand(HOME_RAD)
    return path


def outside_m(position_m: FloatArray) -> float:
    low, high = BOX
    return float(np.linalg.norm(position_m - np.clip(position_m, low, high)))


def test_a_goal_near_an_arm_that_is_held_keeps_its_slowdown() -> None:
    path = made_path()
    slow = Slowdown("table_distance", 0.1, 0.01, 0.05, "")
    asked = joint_goal(path.kinematics, HOME_RAD + 0.2, 0.0, slow)
    assert path.near(asked).slowdown == slow


@pytest.mark.parametrize("turn_rad", [0.0, 0.5 * PAUSE_LEAD_RAD, PAUSE_LEAD_RAD, 0.3, -0.3])
def test_the_goal_of_an_arm_that_is_held_is_on_its_way_and_no_further_than_it_can_retreat(
    turn_rad: float,
) -> None:
    path = made_path()
    way_rad = turn_rad * np.array([1.0, -0.5, 0.2, 0.0, 0.1, 0.0, 0.7])
    near = path.near(joint_goal(path.kinematics, HOME_RAD + way_rad, 0.0))
    share = min(1.0, PAUSE_LEAD_RAD / max(abs(turn_rad), 1e-9))
    np.testing.assert_allclose(near.known_rad, HOME_RAD + share * way_rad, atol=1e-12)


def test_a_goal_that_the_leash_cuts_stays_inside_the_box_and_on_the_leash() -> None:
    rng, path = np.random.default_rng(0), made_path()
    cuts = 0
    for _ in range(400):
        path.stand(HOME_RAD + rng.uniform(-0.5, 0.5, 7))
        if outside_m(path.motion.pose.position_m) > 0.0:
            continue
        asked = joint_goal(path.kinematics, path.state.position + rng.uniform(-1.5, 1.5, 7), 0.0)
        goal, hits = path.leash(asked, 0.004)
        assert goal.joints_rad is not None
        assert outside_m(goal.pose.position_m) < OUTSIDE_M
        assert np.abs(goal.joints_rad - path.state.position).max() < LEAD_RAD + 1e-5
        cuts += any(hit.name == "workspace" for hit in hits)
    assert cuts > 50


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_goal_before_or_behind_a_moving_arm_is_on_the_leash_of_its_next_command(
    sign: float,
) -> None:
    path, joint = made_path(100.0), np.eye(7)[6]
    path.go_to(joint_goal(path.kinematics, HOME_RAD + 0.5 * joint, 0.0))
    for _ in range(20):
        path.tick()
    asked = joint_goal(path.kinematics, HOME_RAD + 2.0 * sign * joint, 0.0)
    goal, _ = path.leash(asked, 0.01)
    path.go_to(goal)
    path.tick()
    lead_rad = (goal.known_rad - path.state.position)[6]
    assert lead_rad == pytest.approx(sign * LEAD_RAD, abs=1e-3)


def test_commands_stay_inside_the_box_whenever_the_goal_changes() -> None:
    """The goals are inside; it is the way to them, and the stop, that could leave the box."""
    rng, path = np.random.default_rng(1), made_path()
    worst_m = 0.0
    for _ in range(120):
        asked = joint_goal(path.kinematics, HOME_RAD + rng.uniform(-1.0, 1.0, 7), 0.0)
        path.go_to(path.leash(asked, 0.0)[0])
        if rng.random() < 0.2:
            path.brake()
        for _ in range(int(rng.integers(1, 60))):
            worst_m = max(worst_m, outside_m(path.tick().pose.position_m))
    assert worst_m < OUTSIDE_M


ALONG_A_FACE = AxisState(
    np.array([-2.0567, -0.618, 1.0799, -2.7307, 0.4957, 3.0595, 0.5071]),
    np.array([-0.1006, 0.0381, 0.2138, -0.0404, 0.312, 0.0361, -0.1625]),
    np.array([0.4172, -0.3385, 1.1917, 0.8087, 1.7875, -1.5966, 0.2551]),
)
"""A micrometre outside the box, and faster all the time."""
GOAL_RAD = np.array([-2.2119, -0.5585, 1.4566, -2.7785, 1.0133, 3.0973, 0.2508])
GOAL_RAD_A_TICK = np.array([-0.00188, 0.00077, 0.00474, -0.00024, 0.00626, 0.00026, -0.00321])


def test_commands_that_curve_along_a_face_do_not_creep_through_it() -> None:
    """Every tick's stop would end no further outside than that tick began."""
    path = made_path()
    path.stand(ALONG_A_FACE.position)
    path.state = ALONG_A_FACE
    worst_m, hits = 0.0, 0
    for tick in range(60):
        goal = joint_goal(path.kinematics, GOAL_RAD + tick * GOAL_RAD_A_TICK, 0.0)
        path.go_to(goal, path.shares(goal))
        worst_m = max(worst_m, outside_m(path.tick().pose.position_m))
        hits += len(path.taken_hits())
    assert worst_m < OUTSIDE_M
    assert hits > 0


def test_a_slow_arm_does_not_creep_along_an_arc_through_a_face() -> None:
    """Each tick takes it out of the box by less than is seen."""
    turned, aside_rad, share = np.eye(7)[0], 0.1, 0.01
    face_m = float(made_path().motion.pose.position_m[0] * np.cos(aside_rad))
    profile = panda(limits={"workspace": {"x_m": [0.2, face_m]}})
    reach = ReachabilityFilter(profile)
    path = JointPath(profile, JointBounds(profile, reach.kinematics, reach.barriers))
    path.stand(HOME_RAD - aside_rad * turned)
    # All places that are looked at on the whole way are inside.
    goal = joint_goal(path.kinematics, HOME_RAD + 0.7 * turned, 0.0)
    path.go_to(goal, Shares(share, share**2, share**3))
    furthest_m = max(path.tick().pose.position_m[0] for _ in range(300)) - face_m
    assert 0.0 < furthest_m < 0.1 * OUTSIDE_M


def test_a_stop_passes_no_joint_s_targets() -> None:
    """Joints that do not move in proportion stop one by one; none waits for another. Others stop on
    their line, where one has the least acceleration and another the least jerk."""
    rng = np.random.default_rng(2)
    path = made_path(100.0)
    worst_rad = 0.0
    for _ in range(100):
        path.stand(HOME_RAD)
        low = high = HOME_RAD
        for _ in range(int(rng.integers(1, 5))):
            target = HOME_RAD + 0.6 - rng.choice([0.0, 0.0, 0.3, 1.2], 7) * rng.random(7)
            low, high = np.minimum(low, target), np.maximum(high, target)
            path.move_to(target)
            for _ in range(int(rng.integers(5, 120))):
                path.advance(1.0)
        end = path.braked()
        worst_rad = max(worst_rad, float(np.maximum(low - end, end - high).max()))
    assert worst_rad < PASSED_RAD


def test_joints_stay_in_their_ranges_however_slow_a_fast_arm_is_asked_to_be() -> None:
    """Goals at the ends of ranges, and limits that shrink in motion: a gentle stop would pass."""
    rng, path = np.random.default_rng(3), made_path()
    low, high = path._bounds.lower_rad, path._bounds.upper_rad
    passed_rad = 0.0
    for _ in range(60):
        path.stand(rng.uniform(low, high))
        for _ in range(int(rng.integers(2, 6))):
            target = np.clip(path.state.position + rng.uniform(-1.0, 1.0, 7), low, high)
            share = float(rng.choice([1.0, 0.5, 0.1, 0.02]))
            path.move_to(target, Shares(share, share**2, share**3))
            for _ in range(int(rng.integers(5, 120))):
                path.advance(1.0)
                joints_rad = path.state.position
                passed_rad = max(passed_rad, float((low - joints_rad).max()))
                passed_rad = max(passed_rad, float((joints_rad - high).max()))
        end_rad = path.braked()
        passed_rad = max(passed_rad, float((low - end_rad).max()), float((end_rad - high).max()))
    assert passed_rad < PASSED_RAD


@pytest.mark.long
def test_joints_that_braked_before_a_bound_go_on_when_the_way_is_free() -> None:
    """A new goal makes the way bend towards a bound; at rest the straight way may be free."""
    rng, path = np.random.default_rng(1), made_path()
    braked = 0
    for _ in range(80):
        path.stand(HOME_RAD)
        for _ in range(2):
            asked = joint_goal(path.kinematics, HOME_RAD + rng.uniform(-1.0, 1.0, 7), 0.0)
            goal = path.leash(asked, 0.0)[0]
            path.taken_hits()
            path.go_to(goal)
            for _ in range(int(rng.integers(5, 60))):
                path.tick()
        still = 0
        while still < 2:
            path.tick()
            still = still + 1 if path.at_rest else 0
        if not path.taken_hits():
            continue
        braked += 1
        assert goal.joints_rad is not None
        here_rad = path.state.position
        hit = path._near_hit() or path._bounds.ahead_hit(here_rad, goal.joints_rad, path._floor)
        if hit is None:
            assert np.abs(here_rad - goal.joints_rad).max() < PASSED_RAD
    assert braked > 5


POST = {"centre_m": [0.25, 0.35, 0.16], "radius_m": 0.03}
"""In the way of a hand whose base turns from home by `TURN_RAD`, 0.95 rad from there."""
TURN_RAD, BEFORE_RAD = 2.0, 0.62
PASSED_M = 0.0006
"""By so much may joints come nearer than a stop; at 50 Hz they are checked every 20 ms."""


@pytest.mark.parametrize("command_hz", [50.0, 250.0])
@pytest.mark.parametrize("goals_hz", [0.0, 20.0])
@pytest.mark.parametrize(
    ("begin_rad", "share"), [(0.0, 1.0), (0.0, 0.3), (0.3, 1.0), (0.5, 0.8), (BEFORE_RAD, 0.02)]
)
def test_joints_stay_before_a_post_on_their_way_however_slow_and_however_often_asked(
    command_hz: float, goals_hz: float, begin_rad: float, share: float
) -> None:
    """The goal behind it is free, as where an arm that lags would cut a corner."""
    box = {"x_m": [-0.9, 0.9], "y_m": [-0.9, 0.9], "z_m": [0.02, 1.0]}
    profile = panda(
        limits={"workspace": box, "reach": {"keep_out": {"post": POST}}},
        timing={"command_hz": command_hz},
    )
    reach = ReachabilityFilter(profile)
    path = JointPath(profile, JointBounds(profile, reach.kinematics, reach.barriers))
    turned = np.eye(7)[0]
    path.stand(HOME_RAD + begin_rad * turned)
    shares = Shares(share)
    left_m = np.inf
    for tick in range(int(4 * command_hz)):
        again = goals_hz and tick % round(command_hz / goals_hz) == 0
        if tick == 0 or again:
            asked_rad = HOME_RAD + (TURN_RAD + 1e-3 * (tick % 3)) * turned
            path.go_to(joint_goal(path.kinematics, asked_rad, 0.0), shares)
        path.tick()
        apart_m = reach.barriers.collisions.distances(path.state.position)
        left_m = min(left_m, float((apart_m - reach.barriers.stop[1:]).min()))
    assert path.at_rest
    assert -PASSED_M < left_m < 0.02


@pytest.mark.parametrize("height_m", [0.02, 0.3])
def test_a_far_target_is_approached_no_faster_than_the_limit_along_the_whole_curve(
    height_m: float,
) -> None:
    """Half a turn of the base: the TCP's way is 1.5 times the distance of its ends, and more."""
    box = {"x_m": [-0.9, 0.9], "y_m": [-0.9, 0.9], "z_m": [0.02, 1.0]}
    arm = Joints(panda(limits={"workspace": box}))
    start_rad = arm.home_rad.copy()
    start_rad[[0, 1]] = -2.6, height_m
    arm.at(start_rad)
    arm.activate()
    goal_rad = start_rad.copy()
    goal_rad[0] = 2.6
    begun = len(arm.places_m)
    for _ in range(4):
        arm.send(*[arm.columns(goal_rad)] * 8)
        arm.run(0.4)
    speed = np.diff(np.array(arm.places_m[begun:]), axis=0) * 1e9 / arm.rig.period_ns
    most_m_s = arm.profile.limits.approach_m_s
    assert 0.9 * most_m_s < np.linalg.norm(speed, axis=1).max() < 1.001 * most_m_s


def test_joints_that_brake_pass_and_end_where_they_were_said_to() -> None:
    rng, path = np.random.default_rng(3), made_path()
    dt_s, moved_rad = 1.0 / OFTEN["command_hz"], 0.0
    for _ in range(100):
        target = HOME_RAD + 0.6 - rng.choice([0.0, 0.0, 0.3, 1.2], 7) * rng.random(7)
        path.move_to(target)
        for _ in range(int(rng.integers(5, 120))):
            path.advance(1.0)
        before = path.state
        said = path.stopping_rad(dt_s)
        assert path.state is before
        path.advance(1.0)
        path.brake()
        passed = [path.state.position]
        while not path.at_rest:
            path.advance(1.0)
            passed.append(path.state.position)
        middle_rad, end_rad = said
        tick_rad = max(float(np.abs(b - a).max()) for a, b in pairwise(passed))
        assert min(float(np.abs(middle_rad - at).max()) for at in passed) < tick_rad
        np.testing.assert_allclose(end_rad, passed[-1], atol=PASSED_RAD)
        moved_rad = max(moved_rad, float(np.abs(end_rad - before.position).max()))
    assert moved_rad > 0.05


@pytest.mark.parametrize("turn_rad", [-0.8, -1.5])
def test_a_step_into_a_barrier_is_cut_where_it_is_forbidden_and_not_dropped(
    turn_rad: float,
) -> None:
    profile = panda()
    reach = ReachabilityFilter(profile)
    way_rad = turn_rad * np.eye(7)[6]

    def bounded(share: float) -> BoundedStep:
        pieces = JointBounds(profile, reach.kinematics, reach.barriers).bound_in_pieces(
            HOME_RAD, HOME_RAD + share * way_rad
        )
        while True:
            try:
                next(pieces)
            except StopIteration as end:
                return end.value

    step = bounded(1.0)
    share = float((step.joints_rad - HOME_RAD)[6] / turn_rad)
    np.testing.assert_allclose(step.joints_rad, HOME_RAD + share * way_rad, atol=1e-12)
    assert step.hits[0].name == "self_collision"
    assert 0.05 < share < 1.0
    assert not bounded(0.99 * share).hits
    assert bounded(share + 2.0**-STEP_HALVINGS).hits


def test_a_step_of_joints_is_cut_by_the_limit_that_cuts_most_and_not_by_rounding() -> None:
    profile, states = panda(), StateHistory[JointState]()
    reach, action, limits = ReachabilityFilter(profile), Joints().rig.spec.action, profile.limits
    bounds = JointBounds(profile, reach.kinematics, reach.barriers)
    steps = JointSteps(bounds, reach, states, 0)
    start = joint_goal(reach.kinematics, HOME_RAD, 0.0)

    def cut(way_rad: FloatArray) -> tuple[float, float, set[str]]:
        asked = joint_goal(reach.kinematics, HOME_RAD + way_rad, 0.0)
        end, hits = steps.within_step(action.model_copy(update={"kind": "delta"}), start, asked)
        return *steps.way(start, end)[:2], {hit.name for hit in hits}

    for way_rad in (1.2 * np.eye(7)[0], 1.2 * np.eye(7)[6] + 0.1 * np.eye(7)[0]):
        far_m, far_rad, hits = cut(way_rad)
        assert far_m <= limits.step_m * (1 + 1e-6)
        assert far_rad <= limits.step_rad * (1 + 1e-6)
        assert hits
    far_rad, hits = cut(float(np.float32(limits.step_rad)) * np.eye(7)[6])[1:]
    assert far_rad == pytest.approx(limits.step_rad)
    assert not hits


def test_between_two_measurements_joints_are_where_they_were_by_then() -> None:
    profile, states, ms = panda(), StateHistory[JointState](), 1_000_000
    reach = ReachabilityFilter(profile)
    bounds = JointBounds(profile, reach.kinematics, reach.barriers)
    for at_ns, turned_rad in ((10**18, 0.0), (10**18 + 8 * ms, 0.2)):
        still = np.zeros(len(HOME_RAD))
        record = JointState(reach.kinematics.arm_joints, HOME_RAD + turned_rad, still, still)
        states.add(Stamped(Header(at_ns, 1, "arm"), record, at_ns))
    found = JointSteps(bounds, reach, states, 100 * ms).measured(10**18 + 2 * ms, 0.0)
    assert isinstance(found, JointGoal)
    np.testing.assert_allclose(found.joints_rad, HOME_RAD + 0.05)


def test_the_length_of_a_motion_is_no_less_than_the_curve_of_its_tcp() -> None:
    path = made_path()
    profile, arm = panda(), path.kinematics
    bounds = JointBounds(profile, arm, ReachabilityFilter(profile).barriers)
    way_rad = np.array([0.0, -0.9, 0.0, 0.9, 0.0, 0.0, 0.0])
    places_m = [arm.forward(HOME_RAD + t * way_rad).position_m for t in np.linspace(0, 1, 200)]
    curve_m = float(np.linalg.norm(np.diff(places_m, axis=0), axis=1).sum())
    assert curve_m <= bounds.ways(HOME_RAD, way_rad)[0] < 1.5 * curve_m


def test_an_approach_in_joints_takes_no_more_than_a_step_at_a_time() -> None:
    """In a step of 0.2 s its speed alone would allow 0.3 rad."""
    arm = Joints(panda(limits={"approach_rad_s": 1.5}), dt_s=0.2)
    arm.activate()
    goal_rad = arm.home_rad + np.eye(7)[6]
    arm.send(*[arm.columns(goal_rad)] * 4)
    arm.run(0.04)
    timeline = arm.rig.commander.parts[0].motion.timeline
    assert timeline is not None
    turned_rad = np.diff([goal.joints_rad[6] for goal in timeline.plan.goals])
    assert turned_rad.max() == pytest.approx(arm.profile.limits.step_rad)


def test_the_share_of_a_long_way_keeps_the_tcp_within_its_speed_along_each_axis_all_the_way() -> (
    None
):
    slow = {"velocity_m_s": 0.05, "acceleration_m_s2": 0.3, "jerk_m_s3": 1.0}
    profile = panda(limits={"translation": slow})
    reach = ReachabilityFilter(profile)
    path = JointPath(profile, JointBounds(profile, reach.kinematics, reach.barriers))
    path.stand(HOME_RAD)
    way_rad = 1.2 * np.eye(7)[0]  # at first sideways, at the end mostly back
    share = path.shares(joint_goal(path.kinematics, HOME_RAD + way_rad, 0.04)).velocity
    rates_rad_s = share * path.box[0, 0] * np.eye(7)[0]
    places = [HOME_RAD + part * way_rad for part in np.linspace(0.0, 1.0, 13)]
    twists = np.array([path.kinematics.jacobian(place) @ rates_rad_s for place in places])
    fastest_m_s = np.abs(twists[:, :3]).max()
    assert 0.9 * slow["velocity_m_s"] < fastest_m_s <= slow["velocity_m_s"]


@pytest.mark.parametrize(
    ("velocity_m_s", "velocity_rad_s"), [(0.001, 1.5), (0.005, 1.5), (0.03, 1.5), (0.25, 0.005)]
)
def test_joints_are_as_slow_as_the_tcp_may_be_however_slow_that_is(
    velocity_m_s: float, velocity_rad_s: float
) -> None:
    slow = {
        "translation": {"velocity_m_s": velocity_m_s},
        "rotation": {"velocity_rad_s": velocity_rad_s},
    }
    arm = Joints(panda(limits=slow))
    arm.activate()
    ramp_rad = arm.home_rad + 0.3 * np.linspace(0.0, 4.0, 41)[:, None] * np.eye(7)[0]
    arm.follow(ramp_rad)
    poses = [arm.kinematics.forward(command.position_rad) for command in arm.joints]
    period_s = arm.rig.period_ns / 1e9
    pairs = list(pairwise(poses))
    moved_m = np.array([after.position_m - before.position_m for before, after in pairs])
    turned_rad = [angle_between(before.rotation, after.rotation) for before, after in pairs]
    shares = np.abs(moved_m).max() / velocity_m_s, max(turned_rad) / velocity_rad_s
    assert 0.5 < max(shares) / period_s < 1.001


@pytest.mark.parametrize("space", ["joint", "tcp"])
def test_a_joint_that_may_only_be_slow_slows_no_other(space: str) -> None:
    def fastest_rad_s(slow_rad_s: float) -> FloatArray:
        limits = {"joint": {"velocity_rad_s": [slow_rad_s, *[1.0] * 6]}}
        more = {} if space == "joint" else {"joints": (), "kind": "delta", "rotation": "rotvec"}
        arm = Joints(panda(limits=limits), space=space, **more)
        if space == "joint":
            arm.activate()
            arm.follow(arm.home_rad + np.linspace(0.0, 2.0, 21)[:, None] * np.eye(7)[6])
        else:  # the wrist's last joint turns the tool about its own axis
            arm.send([0.0] * 6)
            arm.tick(Setting("active", True))
            for _ in range(5):
                arm.send(*[[0.0, 0.0, 0.0, 0.0, 0.0, 0.07]] * 8)
                arm.run(0.4)
        return np.abs([command.velocity_rad_s for command in arm.joints]).max(axis=0)

    free, slowed = fastest_rad_s(1.0), fastest_rad_s(0.05)
    assert free[6] > 0.5
    assert slowed[6] == pytest.approx(free[6], rel=0.02)
    assert slowed[0] <= 0.05 + 1e-9
