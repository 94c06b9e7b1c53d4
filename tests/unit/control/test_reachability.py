"""The kinematic shadow: what it cuts, what it lets through, and that it never traps the arm."""

from __future__ import annotations

import itertools
from typing import Any, NamedTuple

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from panda_arm import HOME_RAD, moved, panda, tool_down_at
from pydantic import ValidationError

from vla_zenoh.control.limits import LEAST_NEAR_STOP, BoundedStep, LimitHit, Slowdown
from vla_zenoh.control.reachability import ReachabilityFilter
from vla_zenoh.errors import ProfileError, RecordError
from vla_zenoh.kinematics.collision import HELD, TABLE
from vla_zenoh.kinematics.kinematics import smallest_singular_value
from vla_zenoh.kinematics.so3 import Pose, angle_between, log3
from vla_zenoh.profile import Limits, Profile, ReachLimits, load_profile, override
from vla_zenoh.types import FloatArray, HeldBox

STEP_M, STEP_RAD = 0.01, 0.05
SOLVED_M = 2e-6
SOLVED_RAD = 2e-6
DRIFT_M = 1e-9
RETURNED_M = 1e-6
RETURNED_RAD = 1e-6
DISTANCE_NOISE_M = 1e-5
ROUNDING = 1e-9
ROUNDING_M = 1e-12
"""Of two positions in float64, which are less than a metre from the origin, and then some."""
NAMES = {
    "reach",
    "joint_limit",
    "joint_velocity",
    "singularity",
    "self_collision",
    "table_distance",
    "keep_out",
}
FORWARD, BACK, LEFT, UP, DOWN = np.array(
    [[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, 0, 1], [0, 0, -1]], float
)
ROLL, PITCH, YAW = np.eye(3)
STILL = np.zeros(3)

KINEMATICS = panda()
LIMITS = Limits().reach
MIDDLE_RAD = tool_down_at(KINEMATICS, 0.45, 0.0, 0.4)


def limits(**reach: Any) -> Limits:
    return Limits(reach=ReachLimits.model_validate(reach))


def panda_with(own: Limits, **changes: Any) -> Profile:
    robot = {"home_rad": HOME_RAD.tolist(), **changes}
    return override(load_profile("panda_sim"), {"robot": robot}).model_copy(update={"limits": own})


def shadow_at(
    joints_rad: FloatArray, own: Limits | None = None, **robot: Any
) -> ReachabilityFilter:
    """The shadow of an arm with these limits, at these joints."""
    shadow = ReachabilityFilter(panda_with(own or Limits(), **robot), KINEMATICS)
    shadow.reset(joints_rad)
    return shadow


SHADOW = shadow_at(HOME_RAD)


def bounded(
    shadow: ReachabilityFilter,
    before: Pose,
    asked: Pose,
    dt_s: float = 0.1,
    start_rad: FloatArray | None = None,
) -> BoundedStep:
    """All pieces of a step at once."""
    pieces = shadow.bound_in_pieces(before, asked, dt_s, start_rad)
    while True:
        try:
            next(pieces)
        except StopIteration as end:
            return end.value


def bound(
    shadow: ReachabilityFilter, before: Pose, asked: Pose, **how: Any
) -> tuple[Pose, list[LimitHit]]:
    return bounded(shadow, before, asked, **how)[:2]


class Walk(NamedTuple):
    """Repeated steps: poses (n + 1), fraction of each step made, and what acted on each."""

    poses: list[Pose]
    hits: list[list[LimitHit]]

    @property
    def moved_m(self) -> FloatArray:
        return self.poses[-1].position_m - self.poses[0].position_m

    @property
    def turned_rad(self) -> float:
        """All steps' turns together: beyond half a turn, too."""
        return sum(angle_between(a.rotation, b.rotation) for a, b in itertools.pairwise(self.poses))

    @property
    def names(self) -> set[str]:
        return {hit.name for hits in self.hits for hit in hits}

    @property
    def last(self) -> LimitHit:
        hit = self.hits[-1][0]
        assert isinstance(hit, LimitHit)
        return hit


def walk(
    shadow: ReachabilityFilter, translation_m: FloatArray, rotvec_rad: FloatArray, steps: int
) -> Walk:
    """`steps` equal steps from where the shadow stands, each on what became of the last."""
    poses, all_hits = [KINEMATICS.forward(shadow.joints_rad)], []
    for _ in range(steps):
        pose, hits = bound(shadow, poses[-1], moved(poses[-1], translation_m, rotvec_rad))
        poses.append(pose)
        all_hits.append(hits)
        assert_sane(shadow, pose)
    return Walk(poses, all_hits)


def at(joints_rad: FloatArray) -> ReachabilityFilter:
    SHADOW.reset(joints_rad)
    return SHADOW


def assert_sane(shadow: ReachabilityFilter, pose: Pose) -> None:
    """The shadow's joints are at `pose`, inside their ranges, and everything keeps its distance."""
    joints = shadow.joints_rad
    reached = KINEMATICS.forward(joints)
    assert np.linalg.norm(reached.position_m - pose.position_m) < SOLVED_M
    assert angle_between(reached.rotation, pose.rotation) < SOLVED_RAD
    margin = LIMITS.joint_margin_rad - ROUNDING
    assert (joints >= KINEMATICS.lower_rad + margin).all()
    assert (joints <= KINEMATICS.upper_rad - margin).all()
    singular_value = smallest_singular_value(KINEMATICS.jacobian(joints))
    assert singular_value >= LIMITS.singularity_stop - ROUNDING
    distances = shadow.barriers.collisions.distances(joints)
    for pair, distance_m in zip(shadow.barriers.collisions.pairs, distances, strict=True):
        hand_at_table = pair.second == TABLE and pair.is_hand
        stop_m = LIMITS.table_stop_m if hand_at_table else LIMITS.collision_stop_m
        assert distance_m >= stop_m - DISTANCE_NOISE_M, pair


# -- measured facts ---------------------------------------------------------------------------
def test_turning_right_stops_where_joint_7_ends_and_nothing_drifts() -> None:
    steps = walk(at(MIDDLE_RAD), STILL, -STEP_RAD * YAW, 50)
    assert steps.turned_rad == pytest.approx(2.144, abs=0.005)
    assert np.abs(steps.moved_m).max() < DRIFT_M
    turn = log3(steps.poses[-1].rotation @ steps.poses[0].rotation.T)
    assert np.abs(turn[:2]).max() < 1e-6
    assert steps.last.name == "joint_limit"
    assert steps.last.where == "panda_joint7"
    assert steps.last.limit == pytest.approx(2.8973 - 0.05, abs=1e-6)
    assert steps.last.value > steps.last.limit


@pytest.mark.parametrize(
    ("direction", "count", "reached_m"),
    [(FORWARD, 60, 0.30), (UP, 80, 0.345), (LEFT, 80, 0.60)],
)
def test_stretching_stops_cleanly_before_the_arm_is_straight(
    direction: FloatArray, count: int, reached_m: float
) -> None:
    steps = walk(at(MIDDLE_RAD), STEP_M * direction, STILL, count)
    assert steps.moved_m @ direction == pytest.approx(reached_m, abs=0.01)
    aside = steps.moved_m - (steps.moved_m @ direction) * direction
    assert np.abs(aside).max() < DRIFT_M
    assert angle_between(steps.poses[0].rotation, steps.poses[-1].rotation) < 1e-7
    assert steps.names <= {"singularity", "joint_velocity"}
    assert steps.hits[0] == []
    assert np.linalg.norm(steps.poses[-1].position_m - steps.poses[-2].position_m) < 1e-3


def test_the_first_half_metre_up_from_home_is_not_touched() -> None:
    steps = walk(at(HOME_RAD), STEP_M * UP, STILL, 50)
    assert steps.names == set()
    assert np.abs(steps.moved_m - 0.5 * UP).max() < DRIFT_M


@pytest.mark.parametrize(("axis", "count"), [(ROLL, 20), (PITCH, 20), (YAW, 40)])
@pytest.mark.parametrize("sign", [-1, 1])
def test_turns_that_fit_are_not_touched(axis: FloatArray, count: int, sign: int) -> None:
    steps = walk(at(MIDDLE_RAD), STILL, sign * STEP_RAD * axis, count)
    assert steps.names == set()
    assert steps.turned_rad == pytest.approx(count * STEP_RAD, abs=1e-6)


def test_the_hand_stops_just_above_the_table() -> None:
    steps = walk(at(HOME_RAD), STEP_M * DOWN, STILL, 30)
    assert steps.last.name == "table_distance"
    assert "finger" in steps.last.where
    assert LIMITS.table_stop_m <= SHADOW.margins.table_m < LIMITS.table_stop_m + 2e-4
    assert steps.poses[-1].position_m[2] == pytest.approx(0.0105, abs=0.0003)
    assert np.abs(steps.moved_m[:2]).max() < DRIFT_M


def test_the_height_of_the_table_counts() -> None:
    shadow = shadow_at(HOME_RAD, limits(table_z_m=0.1))
    pose = KINEMATICS.forward(HOME_RAD)
    for _ in range(20):
        pose, _ = bound(shadow, pose, moved(pose, STEP_M * DOWN, STILL))
    assert pose.position_m[2] == pytest.approx(0.1105, abs=0.0003)


def test_without_a_table_the_arm_may_go_below_it() -> None:
    shadow = shadow_at(HOME_RAD, limits(table_z_m=None))
    pose = KINEMATICS.forward(HOME_RAD)
    for _ in range(25):
        pose, hits = bound(shadow, pose, moved(pose, STEP_M * DOWN, STILL))
        assert hits == []
    assert pose.position_m[2] < 0
    assert shadow.margins.table_m == np.inf


KEEP_OUTS = {
    "box": {"centre_m": [0.7, 0, 0.4], "box_m": [0.1, 0.4, 0.8]},
    "turned box": {"centre_m": [0.7, 0, 0.4], "box_m": [0.4, 0.1, 0.8], "yaw_rad": np.pi / 2},
    "sphere": {"centre_m": [0.8, 0, 0.3], "radius_m": 0.15},
    "wall": {"centre_m": [0.65, 0, 0], "normal": [-2, 0, 0]},
}
HAND_M = 0.0316
"""Half the thickness of the hand, forwards of the TCP that points down."""


@pytest.mark.parametrize("shape", KEEP_OUTS.values(), ids=list(KEEP_OUTS))
def test_no_link_enters_what_the_arm_keeps_out_of(shape: dict[str, Any]) -> None:
    kept_out = limits(keep_out={"post": shape})
    shadow = shadow_at(HOME_RAD, kept_out)
    pose, hits = KINEMATICS.forward(HOME_RAD), []
    for _ in range(40):
        pose, hits = bound(shadow, pose, moved(pose, STEP_M * FORWARD, STILL))
    assert hits[0].name == "keep_out"
    assert hits[0].where.endswith(" and post")
    stop_m = kept_out.reach.collision_stop_m
    assert stop_m - DISTANCE_NOISE_M <= shadow.margins.keep_out_m < stop_m + 2e-3
    assert pose.position_m[0] < 0.65 - stop_m - HAND_M + 0.01


def test_a_keep_out_around_the_arm_at_home_is_an_error_with_its_name_and_the_link() -> None:
    inside = limits(keep_out={"post": {"centre_m": [0.45, 0, 0.3], "radius_m": 0.1}})
    with pytest.raises(ProfileError, match=r"panda_.* m from the keep-out 'post' with"):
        shadow_at(HOME_RAD, inside)


@pytest.mark.parametrize(
    ("shape", "said"),
    [
        ({}, "has no shape; give one of box_m, radius_m, normal"),
        ({"radius_m": 0.1, "normal": [0, 0, 1]}, "has radius_m and normal; give one of"),
        ({"normal": [0, 0, 0]}, "is zero; give a direction"),
        ({"radius_m": 0.1, "yaw_rad": 1.0}, "rotates a box; this is not one"),
        ({"box_m": [0.1, 0.0, 0.1]}, "greater than 0"),
        ({"radius_m": 450.0}, "less than or equal to 3"),
    ],
)
def test_a_keep_out_that_is_no_shape_is_rejected(shape: dict[str, Any], said: str) -> None:
    with pytest.raises(ValidationError, match=said):
        limits(keep_out={"post": {"centre_m": [0.5, 0, 0], **shape}})


# -- what the gripper holds -----------------------------------------------------------------------
BAR = HeldBox((0.04, 0.04, 0.2))
"""Half of it is below the TCP, whose z axis points down."""


def test_what_the_gripper_holds_stops_above_the_table_as_the_fingers_would() -> None:
    def lowest_m(box: HeldBox | None) -> float:
        model = shadow_at(MIDDLE_RAD, limits())
        model.hold(box)
        pose, hits = KINEMATICS.forward(MIDDLE_RAD), []
        for _ in range(60):
            pose, hits = bound(model, pose, moved(pose, STEP_M * DOWN, STILL))
        assert hits[0].name in ("table_distance", "workspace")
        return float(pose.position_m[2])

    assert LIMITS.table_z_m is not None
    held_m = lowest_m(BAR)
    bottom_m = held_m - BAR.size_m[2] / 2 - LIMITS.table_z_m
    assert bottom_m == pytest.approx(LIMITS.table_stop_m, abs=2e-3)
    assert held_m > lowest_m(None) + 0.05


def test_a_box_that_stands_on_the_table_is_lifted_and_not_pushed() -> None:
    assert LIMITS.table_z_m is not None
    start_m = LIMITS.table_z_m + BAR.size_m[2] / 2
    start_rad = tool_down_at(KINEMATICS, 0.45, 0.0, start_m)
    model = shadow_at(start_rad, limits())
    model.hold(BAR)
    start = KINEMATICS.forward(start_rad)
    down, hits = bound(model, start, moved(start, STEP_M * DOWN, STILL))
    assert hits[0].name == "table_distance"
    assert HELD in hits[0].where
    assert start.position_m[2] - down.position_m[2] < 1e-4
    up, hits = bound(model, down, moved(down, STEP_M * UP, STILL))
    assert not hits
    assert up.position_m[2] - down.position_m[2] == pytest.approx(STEP_M)


def test_an_arm_that_let_go_has_the_bounds_that_it_had() -> None:
    model = ReachabilityFilter(panda_with(limits(), home_rad=MIDDLE_RAD.tolist()), KINEMATICS)
    before = model.margins
    model.hold(BAR)
    assert model.margins.table_m < before.table_m
    model.hold(None)
    assert model.margins == before


@pytest.mark.parametrize("axis", [ROLL, PITCH])
def test_folding_the_hand_onto_the_forearm_stops(axis: FloatArray) -> None:
    steps = walk(at(MIDDLE_RAD), STILL, STEP_RAD * axis, 70)
    assert steps.last.name == "self_collision"
    assert "panda_hand" in steps.last.where
    assert np.abs(steps.moved_m).max() < DRIFT_M
    assert LIMITS.collision_stop_m - DISTANCE_NOISE_M <= SHADOW.margins.self_m < 0.025


def test_pulling_the_arm_into_its_own_shoulder_stops() -> None:
    steps = walk(at(MIDDLE_RAD), STEP_M * BACK, STILL, 60)
    assert steps.names <= {"joint_limit", "self_collision"}
    assert np.linalg.norm(steps.poses[-1].position_m - steps.poses[-2].position_m) < 1e-3


# -- what holds always ------------------------------------------------------------------------
DELTAS = st.lists(
    st.tuples(
        st.tuples(*[st.floats(-1, 1)] * 3),
        st.tuples(*[st.floats(-1, 1)] * 3),
        st.integers(1, 12),
    ),
    min_size=1,
    max_size=5,
)


@settings(max_examples=15)
@given(DELTAS)
def test_no_sequence_of_bounded_steps_leaves_the_bounds(
    deltas: list[tuple[tuple[float, ...], tuple[float, ...], int]],
) -> None:
    shadow = at(MIDDLE_RAD)
    for translation, rotation, count in deltas:
        steps = walk(shadow, 0.05 * np.array(translation), 0.15 * np.array(rotation), count)
        assert steps.names <= NAMES
        for before, after, hits in zip(steps.poses, steps.poses[1:], steps.hits, strict=False):
            gone_m = after.position_m - before.position_m
            asked_m = 0.05 * np.array(translation)
            far_m = float(np.linalg.norm(asked_m))
            along_m = float(gone_m @ asked_m) / far_m if far_m else 0.0
            assert -ROUNDING_M <= along_m <= far_m + ROUNDING_M
            assert np.linalg.norm(gone_m - along_m * asked_m / (far_m or 1.0)) < 1e-8  # never aside
            assert hits or along_m == pytest.approx(far_m, rel=1e-6, abs=ROUNDING_M)


@settings(max_examples=10)
@given(
    st.tuples(*[st.floats(-1, 1)] * 3).filter(lambda v: np.linalg.norm(v) > 0.3),
    st.tuples(*[st.floats(-1, 1)] * 3),
)
def test_from_every_stop_the_way_back_is_open(
    translation: tuple[float, ...], rotation: tuple[float, ...]
) -> None:
    shadow = at(MIDDLE_RAD)
    step_m = 0.03 * np.array(translation) / np.linalg.norm(translation)
    step_rad = 0.05 * np.array(rotation)
    out = walk(shadow, step_m, step_rad, 60)
    assert out.names, "no direction goes on for ever"
    here = out.poses[-1]
    for pose in reversed(out.poses):
        for _ in range(8):  # where it was slowed on the way out it may be slowed on the way in
            here, _ = bound(shadow, here, pose)
    assert np.linalg.norm(here.position_m - out.poses[0].position_m) < RETURNED_M
    assert angle_between(here.rotation, out.poses[0].rotation) < RETURNED_RAD


@settings(max_examples=10)
@given(
    st.tuples(*[st.floats(-1, 1)] * 3).filter(lambda v: np.linalg.norm(v) > 0.3),
    st.integers(0, 40),
)
def test_a_longer_wish_never_gets_the_arm_less_far(
    direction: tuple[float, ...], steps_before: int
) -> None:
    shadow = at(MIDDLE_RAD)
    unit = np.array(direction) / np.linalg.norm(direction)
    walked = walk(shadow, 0.02 * unit, STILL, steps_before)
    before, joints = walked.poses[-1], shadow.joints_rad
    reached_m = []
    for wish_m in (0.002, 0.005, 0.01, 0.02, 0.04):
        shadow.reset(joints)
        pose, _ = bound(shadow, before, moved(before, wish_m * unit, STILL), start_rad=joints)
        reached_m.append(float((pose.position_m - before.position_m) @ unit))
    resolution_m = 0.04 / 16
    assert all(b >= a - resolution_m for a, b in itertools.pairwise(reached_m))


def test_what_was_cut_is_let_through_when_asked_for_itself() -> None:
    shadow = at(MIDDLE_RAD)
    steps = walk(shadow, STEP_M * FORWARD, STILL, 29)
    before, joints = steps.poses[-1], shadow.joints_rad
    cut, hits = bound(shadow, before, moved(before, 0.04 * FORWARD, STILL))
    assert hits
    assert np.linalg.norm(cut.position_m - before.position_m) > 0.001
    again, hits_again = bound(shadow, before, cut, start_rad=joints)
    assert hits_again == []
    assert again is cut


def test_joints_slow_no_step_that_takes_the_tcp_longer() -> None:
    SHADOW.reset(HOME_RAD)
    here = KINEMATICS.forward(HOME_RAD)
    step = bounded(SHADOW, here, moved(here, 0.03 * UP, STILL), dt_s=1e-3)
    assert step.hits == []
    assert step.slowdown is None


def test_the_first_look_of_a_model_that_was_moved_counts_as_one() -> None:
    SHADOW.cost = 5
    assert at(HOME_RAD).cost == 1


def test_the_same_questions_get_the_same_answers() -> None:
    first = walk(at(HOME_RAD), STEP_M * (UP + 0.3 * LEFT), 0.02 * ROLL, 40)
    joints = SHADOW.joints_rad
    second = walk(at(HOME_RAD), STEP_M * (UP + 0.3 * LEFT), 0.02 * ROLL, 40)
    assert np.abs(SHADOW.joints_rad - joints).max() < ROUNDING
    assert np.abs(first.poses[-1].position_m - second.poses[-1].position_m).max() < 1e-4


# -- no trap ----------------------------------------------------------------------------------
def test_a_joint_found_outside_its_margin_may_come_in_and_not_go_out() -> None:
    joints = MIDDLE_RAD.copy()
    joints[6] = KINEMATICS.upper_rad[6] - 0.01
    shadow = at(joints)
    pose = KINEMATICS.forward(joints)
    outwards, hits = bound(shadow, pose, moved(pose, STILL, -0.05 * YAW))
    assert [hit.name for hit in hits] == ["joint_limit"]
    assert outwards is pose
    inwards, hits = bound(shadow, pose, moved(pose, STILL, 0.05 * YAW))
    assert hits == []
    assert angle_between(inwards.rotation, pose.rotation) == pytest.approx(0.05, abs=1e-6)


def test_a_hand_found_too_near_the_table_may_rise_and_not_sink() -> None:
    strict = limits(table_stop_m=0.08, table_slow_m=0.10)
    low = tool_down_at(KINEMATICS, 0.45, 0.0, 0.05)
    shadow = shadow_at(low, strict)
    pose = KINEMATICS.forward(low)
    assert shadow.margins.table_m < strict.reach.table_stop_m
    stays, hits = bound(shadow, pose, moved(pose, STEP_M * DOWN, STILL))
    assert stays is pose
    assert {hit.name for hit in hits} == {"table_distance"}
    for _ in range(10):
        higher, hits = bound(shadow, pose, moved(pose, STEP_M * UP, STILL))
        assert hits == []
        assert higher.position_m[2] > pose.position_m[2]
        pose = higher


def test_an_arm_found_stretched_may_bend_and_not_stretch() -> None:
    straight = np.array([0.0, 0.6, 0.0, -0.5, 0.0, 1.8, 0.785])
    strict = limits(singularity_stop=0.08, singularity_slow=0.1)
    shadow = shadow_at(straight, strict)
    assert shadow.margins.singular_value < strict.reach.singularity_stop
    pose = KINEMATICS.forward(straight)
    outwards = pose.position_m - (0, 0, 0.333)
    outwards = outwards / np.linalg.norm(outwards)
    stays, hits = bound(shadow, pose, moved(pose, STEP_M * outwards, STILL))
    assert {hit.name for hit in hits} & {"singularity", "reach"}
    assert np.linalg.norm(stays.position_m - pose.position_m) < 1e-4
    for _ in range(5):
        nearer, hits = bound(shadow, pose, moved(pose, -STEP_M * outwards, STILL))
        assert hits == []
        pose = nearer


def test_a_start_out_of_reach_may_only_come_nearer() -> None:
    shadow = at(MIDDLE_RAD)
    beyond = moved(KINEMATICS.forward(MIDDLE_RAD), 0.6 * FORWARD, STILL)
    stays, hits = bound(shadow, beyond, moved(beyond, STEP_M * FORWARD, STILL))
    assert stays is beyond
    assert hits[0].name in {"reach", "joint_limit"}
    nearer, hits = bound(shadow, beyond, moved(beyond, 0.02 * BACK, STILL))
    assert hits == []
    assert nearer.position_m[0] < beyond.position_m[0]


# -- other -------------------------------------------------------------------------------------
def test_a_step_for_which_the_joints_are_too_slow_is_kept_and_taken_slower() -> None:
    near = at(MIDDLE_RAD)
    steps = walk(near, STEP_M * FORWARD, STILL, 28)
    before, joints = steps.poses[-1], near.joints_rad
    asked = moved(before, 0.008 * FORWARD, STILL)
    calm, hits, _, slower = bounded(near, before, asked, dt_s=0.5, start_rad=joints)
    assert hits == []
    assert slower is None or slower.name == "singularity"
    fast, hits, _, slower = bounded(near, before, asked, dt_s=0.016, start_rad=joints)
    assert hits == []
    assert fast is calm is asked
    assert slower is not None
    assert (slower.name, slower.where, slower.limit) == ("joint_velocity", "panda_joint4", 2.175)
    assert slower.value > slower.limit
    # At that share of the TCP's speed the joint is just as fast as it may be.
    takes_s = 0.008 / (slower.share * Limits().translation.velocity_m_s)
    moved_rad = np.abs(near.joints_rad - joints)[KINEMATICS.arm_joints.index("panda_joint4")]
    assert moved_rad / takes_s == pytest.approx(2.175)
    assert slower.late_s == pytest.approx(takes_s - 0.016)


def test_joints_that_would_need_ten_times_as_long_leap_and_the_step_is_shortened() -> None:
    near = at(MIDDLE_RAD)
    before = walk(near, STEP_M * FORWARD, STILL, 28).poses[-1]
    own = Limits.model_validate({"joint": {"velocity_rad_s": 0.1}})
    slow = shadow_at(near.joints_rad, own, command="joint")
    asked = moved(before, 0.008 * FORWARD, STILL)
    pose, hits = bound(slow, before, asked, dt_s=0.016)
    assert [hit.name for hit in hits] == ["joint_velocity"]
    assert np.linalg.norm(pose.position_m - before.position_m) < 0.008


def test_a_step_that_starts_elsewhere_is_judged_from_there() -> None:
    shadow = at(MIDDLE_RAD)
    steps = walk(shadow, STEP_M * UP, STILL, 10)
    earlier = steps.poses[3]  # goals of an older observation
    pose, hits = bound(shadow, earlier, moved(earlier, STEP_M * LEFT, STILL))
    assert hits == []
    assert_sane(shadow, pose)


def test_a_step_that_starts_at_the_same_place_turned_is_judged_from_there() -> None:
    """Joints of 0.1 rad/s would need 2 s from how the shadow stands to how the step starts."""
    own = Limits.model_validate({"joint": {"velocity_rad_s": 0.1}})
    shadow = shadow_at(MIDDLE_RAD, own, command="joint")
    turned = moved(KINEMATICS.forward(MIDDLE_RAD), STILL, 0.2 * YAW)
    found = bounded(shadow, turned, turned, dt_s=0.1)
    assert (found.hits, found.slowdown) == ([], None)


def test_after_a_reset_the_shadow_stands_where_the_robot_is() -> None:
    shadow = at(MIDDLE_RAD)
    walk(shadow, STEP_M * UP, STILL, 20)
    shadow.reset(HOME_RAD)
    assert np.array_equal(shadow.joints_rad, HOME_RAD)
    pose = KINEMATICS.forward(HOME_RAD)
    same, hits = bound(shadow, pose, pose)
    assert same is pose
    assert hits == []


def test_an_elbow_that_is_free_turns_further() -> None:
    free = shadow_at(MIDDLE_RAD, command="joint")
    steps = walk(free, STILL, -STEP_RAD * YAW, 50)
    assert steps.turned_rad > 2.3
    assert np.abs(steps.moved_m).max() < DRIFT_M


def test_margins_are_those_of_what_is_nearest() -> None:
    margins = at(HOME_RAD).margins
    assert margins.joint == "panda_joint4"
    assert margins.joint_rad == pytest.approx(3.0718 - 2.627, abs=1e-3)
    assert margins.singular_value == pytest.approx(0.221, abs=1e-3)
    assert 0.05 < margins.self_m < 0.1
    assert margins.table_m == pytest.approx(0.16 - 0.0095, abs=1e-3)


def test_neighbours_are_no_collision_and_far_links_are_watched() -> None:
    pairs = {str(pair) for pair in SHADOW.barriers.collisions.pairs}
    for first in range(7):
        assert f"panda_link{first} and panda_link{first + 1}" not in pairs
    assert {"panda_link0 and panda_hand", "panda_link5 and panda_hand"} <= pairs
    assert {"panda_link5 and table", "panda_hand and table", "panda_leftfinger and table"} <= pairs
    assert "panda_link0 and table" not in pairs


@pytest.mark.parametrize("joints", [np.zeros(6), np.array([np.nan] * 7), np.array([np.inf] * 7)])
def test_joints_that_are_none_are_refused(joints: FloatArray) -> None:
    with pytest.raises(RecordError, match="7 finite numbers"):
        at(joints)


@pytest.mark.parametrize(
    ("direction", "rotvec", "name"),
    [(FORWARD, STILL, "singularity"), (STILL, PITCH, "self_collision")],
)
def test_the_nearer_a_bound_the_slower_the_arm(
    direction: FloatArray, rotvec: FloatArray, name: str
) -> None:
    shadow = at(MIDDLE_RAD)
    pose, shares = KINEMATICS.forward(shadow.joints_rad), []
    for _ in range(400):
        wish = moved(pose, 0.2 * STEP_M * direction, 0.2 * STEP_RAD * rotvec)
        pose, hits, _, slower = bounded(shadow, pose, wish)
        if hits:
            break
        shares.append(1.0 if slower is None else slower.share)
    assert hits[0].name == slower.name == name if slower else hits
    assert shares[0] == 1.0
    approach = shares[len(shares) - shares[::-1].index(1.0) :]
    assert approach == sorted(approach, reverse=True)
    assert LEAST_NEAR_STOP <= approach[-1] < 0.9


def test_away_from_a_bound_the_arm_has_its_full_speed() -> None:
    shadow = at(MIDDLE_RAD)
    last = walk(shadow, STEP_M * FORWARD, STILL, 60).poses[-1]
    assert shadow.margins.singular_value < LIMITS.singularity_slow
    back = bounded(shadow, last, moved(last, STEP_M * BACK, STILL))
    assert not back.hits
    assert back.slowdown is None


# -- slow zones ---------------------------------------------------------------------------------
BARRIERS = SHADOW.barriers
FAR = 2.0 * BARRIERS.zone


def slowed(index: int, before: float, after: float) -> Slowdown | None:
    """Of a step that changes one barrier, told in its zone, while all others are far."""
    ends = np.array([FAR, FAR])
    ends[:, index] = BARRIERS.zone[index] * np.array([before, after])
    return BARRIERS.slowdown(*ends)


@pytest.mark.parametrize("index", range(len(FAR)))
def test_a_step_is_slowed_where_it_goes_further_into_a_zone_and_nowhere_else(index: int) -> None:
    shares = []
    for left in (0.9, 0.5, 0.25):
        slower = slowed(index, 1.0, left)
        assert slower is not None
        assert (slower.name, slower.where) == (BARRIERS.names[index], BARRIERS.where(index))
        assert slower.value == pytest.approx(BARRIERS.stop[index] + left * BARRIERS.zone[index])
        shares.append(slower.share)
    assert shares == sorted(shares, reverse=True)
    # As a brake of constant deceleration: at a quarter of the way, half the speed.
    assert shares[-1] == pytest.approx(0.5)
    for beside in ((1.5, 1.0), (0.5, 0.5), (0.5, 0.9), (0.2, 1.1)):
        assert slowed(index, *beside) is None


def test_every_distance_has_a_zone_before_its_stop_as_the_profile_says_where_it_can() -> None:
    reach, farthest_m = Limits().reach, BARRIERS.collisions.farthest_m
    table = np.array([name == "table_distance" for name in BARRIERS.names[1:]])
    assert (BARRIERS.slow > BARRIERS.stop).all()
    roomy = ~table & (farthest_m > 2 * reach.collision_slow_m)
    assert roomy.any()
    assert (BARRIERS.slow[1:][roomy] == reach.collision_slow_m).all()
    assert (BARRIERS.stop[1:][roomy] == reach.collision_stop_m).all()
    assert (BARRIERS.slow[1:] < np.maximum(farthest_m, BARRIERS.stop[1:])).all()
