"""No barrier depends on where the arm stands; beyond one it may only move away."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from command_rig import Rig
from joint_rig import Joints
from panda_arm import HOME_RAD, panda, tool_down_at

from vla_zenoh.control.commander import Setting
from vla_zenoh.control.reachability import NOISE, Barriers, Floors, ReachabilityFilter
from vla_zenoh.errors import ProfileError
from vla_zenoh.kinematics.collision import NEIGHBOURS_M, CollisionModel
from vla_zenoh.kinematics.so3 import Pose
from vla_zenoh.lab.profile.check import check_profile
from vla_zenoh.profile import Limits, Profile, load_profile, override
from vla_zenoh.types import FloatArray

KINEMATICS = panda()
LIMITS = Limits().reach
BASE = Barriers(KINEMATICS, LIMITS, HOME_RAD)
SPAN_RAD = KINEMATICS.upper_rad - KINEMATICS.lower_rad
SAME_M = 1e-5


def homes(seed: int, count: int) -> list[FloatArray]:
    """Random homes: anywhere, near the table and near the arm itself, in contact or inside it."""
    rng = np.random.default_rng(seed)
    found: list[FloatArray] = []
    kinds = ("anywhere", "table_distance", "self_collision")
    for number in range(count):
        kind = kinds[number % 3]
        tried = KINEMATICS.lower_rad + SPAN_RAD * rng.random((40, KINEMATICS.size))
        names = np.array([pair.limit == kind for pair in BASE.collisions.pairs])
        if kind == "anywhere":
            found.append(tried[0])
            continue
        left_m = [
            float(np.abs(BASE.collisions.distances(joints)[names] - rng.uniform(0, 0.02)).min())
            for joints in tried
        ]
        found.append(tried[int(np.argmin(left_m))])
    return found


def lost(home_rad: FloatArray) -> list[str]:
    """Pairs that are not checked, or later, because the arm is at home there."""
    barriers = Barriers(KINEMATICS, LIMITS, home_rad)
    stops_m = dict(zip(map(str, barriers.collisions.pairs), barriers.stop[1:], strict=True))
    expected = zip(map(str, BASE.collisions.pairs), BASE.stop[1:], strict=True)
    return [pair for pair, stop_m in expected if stops_m.get(pair, -np.inf) < stop_m - SAME_M]


@pytest.mark.parametrize("seed", range(3))
def test_no_barrier_is_lost_whatever_the_home(seed: int) -> None:
    for home_rad in homes(seed, 6):
        assert lost(home_rad) == []


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_no_barrier_is_lost_at_1000_homes() -> None:
    for home_rad in homes(1000, 1000):
        assert lost(home_rad) == []


def test_only_neighbours_and_what_no_joint_moves_are_left_out() -> None:
    checked = {str(pair) for pair in BASE.collisions.pairs}
    everything = CollisionModel(KINEMATICS, near_m=10.0, table_z_m=0.0)
    left_out = {str(pair) for pair in everything.pairs} - checked
    rng = np.random.default_rng(5)
    indices = [k for k, pair in enumerate(everything.pairs) if str(pair) in left_out]
    for _ in range(500):
        joints_rad = KINEMATICS.lower_rad + SPAN_RAD * rng.random(KINEMATICS.size)
        distances_m = everything.distances(joints_rad)[indices]
        assert distances_m.min() > LIMITS.collision_stop_m


@pytest.mark.parametrize("stop_m", [0.0, 0.02, 0.1, 0.3])
def test_a_larger_stop_takes_no_barrier_away(stop_m: float) -> None:
    own = LIMITS.model_copy(update={"collision_stop_m": stop_m, "collision_slow_m": 0.3})
    barriers = Barriers(KINEMATICS, own, HOME_RAD)
    pairs = {str(pair) for pair in barriers.collisions.pairs}
    assert {str(pair) for pair in BASE.collisions.pairs} <= pairs
    # Nor is there one that the arm cannot leave.
    assert (barriers.stop[1:] < barriers.collisions.farthest_m).all()
    assert (barriers.slow[1:] < barriers.collisions.farthest_m).all()
    assert (barriers.stop <= barriers.slow).all()


def test_an_upper_arm_near_the_table_has_a_barrier_to_it() -> None:
    from other_arms import ur5

    profile = ur5()
    reach = ReachabilityFilter(profile)
    pairs = [str(pair) for pair in reach.barriers.collisions.pairs]
    assert "upper_arm_link and table" in pairs
    assert reach.barriers.inside(reach.joints_rad) == []


def test_declared_pairs_may_touch_and_unknown_ones_are_named() -> None:
    touching = {"limits": {"reach": {"may_touch": [["panda_link5", "panda_hand"]]}}}
    may = override(load_profile("panda_sim"), touching).limits.reach
    pairs = {str(pair) for pair in Barriers(KINEMATICS, may, HOME_RAD).collisions.pairs}
    assert "panda_link5 and panda_hand" not in pairs
    wrong = LIMITS.model_copy(update={"may_touch": (("panda_link5", "panda_hnd"),)})
    with pytest.raises(ProfileError, match=r"panda_hnd.*panda_hand"):
        Barriers(KINEMATICS, wrong, HOME_RAD)
    same = LIMITS.model_copy(update={"may_touch": (("panda_hand", "panda_hand"),)})
    with pytest.raises(ProfileError, match="'panda_hand' touches itself: name two links"):
        Barriers(KINEMATICS, same, HOME_RAD)


def test_neighbours_are_those_that_are_never_far_apart() -> None:
    assert np.isfinite(BASE.collisions.farthest_m).any()
    to_links = [pair.limit == "self_collision" for pair in BASE.collisions.pairs]
    assert (BASE.collisions.farthest_m[to_links] > NEIGHBOURS_M).all()


# -- an arm whose home is near the table ----------------------------------------------------------
def low(height_m: float, command: str, **limits: Any) -> Profile:
    home_rad = tool_down_at(KINEMATICS, 0.43, 0.0, height_m)
    robot = {"home_rad": home_rad.tolist(), "command": command}
    box = {"x_m": [0.2, 0.75], "y_m": [-0.4, 0.4], "z_m": [-0.2, 0.7]}
    return override(
        load_profile("panda_sim"), {"robot": robot, "limits": {"workspace": box, **limits}}
    )


def lowest_m(rig: Rig, profile: Profile) -> float:
    reach = rig.commander.parts[0].reach
    assert reach is not None
    assert rig.joints_rad is not None
    if profile.robot.command == "pose":
        return float(rig.position_m[2])
    return float(reach.kinematics.forward(rig.joints_rad).position_m[2])


@pytest.mark.parametrize(
    ("command", "height_m"),
    [("pose", 0.0085), ("joint", 0.022)],
)
def test_a_panda_that_begins_near_the_table_does_not_go_into_it(
    command: str, height_m: float
) -> None:
    profile = low(height_m, command)
    arm = Joints(profile, space="tcp", joints=(), kind="delta", rotation="rotvec")
    rig = arm.rig
    arm.tick(chunks=[rig.chunk([[0.0] * 6])])
    arm.tick(Setting("active", True))
    assert rig.state == "active", rig.commander.why
    places_m = [height_m]
    for step_m in [0.01] * 4 + [1e-5] * 4 + [1e-6] * 4:
        arm.tick(chunks=[rig.chunk([[0.0, 0.0, -step_m, 0.0, 0.0, 0.0]] * 4)])
        for _ in range(30):
            arm.tick()
            places_m.append(lowest_m(rig, profile))
    # The fingers end 8.5 mm below the TCP.
    fingers_m = 0.0085 + LIMITS.table_stop_m
    assert min(places_m) > min(height_m, fingers_m) - 1e-4
    arm.tick(chunks=[rig.chunk([[0.0, 0.0, 0.01, 0.0, 0.0, 0.0]] * 4)])
    arm.run(0.8)
    assert lowest_m(rig, profile) > places_m[-1] + 0.005


def test_an_arm_that_begins_inside_a_bound_is_told_by_name() -> None:
    profile = low(0.005, "joint")
    arm = Joints(profile)
    arm.activate()
    told = [event for event in arm.rig.events if "may only move away" in event.why]
    assert {event.what for event in told} == {"table_distance"}
    assert any("panda_leftfinger" in event.why for event in told)


def test_profile_check_names_a_home_inside_a_bound(tmp_path: Any) -> None:
    home_rad = tool_down_at(KINEMATICS, 0.43, 0.0, 0.005).tolist()
    file = tmp_path / "low.yaml"
    file.write_text(f"extends: panda_sim\nrobot:\n  home_rad: {home_rad}\n")
    report = check_profile(str(file))
    assert any("table_distance at panda_leftfinger" in hint for hint in report.advice)
    assert not any("home_rad" in hint for hint in check_profile("panda_sim").advice)


def test_a_violated_barrier_does_not_creep_in_many_small_steps() -> None:
    shadow = ReachabilityFilter(low(0.005, "pose"), KINEMATICS)
    pose = KINEMATICS.forward(shadow.joints_rad)
    begin_m = float(pose.position_m[2])
    for _ in range(100):
        asked = Pose(pose.position_m - [0.0, 0.0, 1e-6], pose.rotation)
        search = shadow.bound_in_pieces(pose, asked, 0.02)
        try:
            while True:
                next(search)
        except StopIteration as last:
            pose = last.value.pose
    assert pose.position_m[2] > begin_m - 2 * NOISE


def test_an_arm_that_was_pushed_further_beyond_a_barrier_may_leave_from_there() -> None:
    floors, here = Floors(BASE), np.ones(len(BASE.stop))
    for left_m, least_m in ((-0.01, -0.01), (-0.02, -0.02), (-0.015, -0.015), (-0.016, -0.016)):
        here[1] = left_m
        assert floors.after(here)[1] == pytest.approx(least_m, abs=2 * NOISE)
    here[1] = -0.016 - NOISE / 2  # by itself it does not come nearer, in however many steps
    assert floors.after(here)[1] == pytest.approx(-0.016 - NOISE, abs=NOISE / 10)


# -- an arm that begins outside the box -----------------------------------------------------------
@pytest.mark.parametrize(
    ("mode", "command", "space"),
    [
        *(("replace", "joint", "joint"), ("blend", "pose", "joint")),
        *(("blend", "joint", "tcp"), ("ensemble", "pose", "tcp")),
    ],
)
def test_an_arm_that_began_outside_the_box_never_gets_a_goal_further_out(
    command: str, space: str, mode: str
) -> None:
    box = {"x_m": [0.2, 0.4], "y_m": [-0.4, 0.4], "z_m": [0.05, 0.7]}
    base = load_profile("panda_sim")
    changes = {
        "robot": {"command": command},
        "limits": {"workspace": box},
        "composition": {"mode": mode},
    }
    profile = override(base, changes)
    names = {} if space == "joint" else {"joints": (), "rotation": "rotvec"}
    arm = Joints(profile, space=space, kind="delta", **names)
    rig, rng = arm.rig, np.random.default_rng(1)
    size = 7 if space == "joint" else 6
    arm.tick(chunks=[rig.chunk([[0.0] * size])])
    arm.tick(Setting("active", True))
    assert rig.state == "active", rig.commander.why
    motion = rig.commander.parts[0].motion
    worst_m, came_in = 0.0, False
    for _ in range(15):
        steps = rng.normal(0.0, 0.01, (8, size))
        if space == "tcp":
            steps[:, 0] += rng.choice([-0.004, 0.004])
        chunk = rig.chunk(steps.tolist(), observed_ago_s=float(rng.uniform(0.0, 0.2)))
        arm.tick(chunks=[chunk])
        for _ in range(int(rng.integers(10, 60))):
            joints_rad = motion.joints_rad
            here = motion.commanded if joints_rad is None else arm.kinematics.forward(joints_rad)
            arm.tick()
            goal = motion.goal
            if goal is None or here is None:
                continue
            out_m = max(float(goal.pose.position_m[0]) - 0.4, 0.0)
            now_m = max(float(here.position_m[0]) - 0.4, 0.0)
            came_in |= now_m < 0.02
            worst_m = max(worst_m, out_m - now_m)
    assert came_in
    assert worst_m < 1e-5
