"""Each declared meaning moves the arm as its source does, against references of the definitions."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from command_rig import DOWN, MS, START_M, START_NS, Rig, lone_chunk, profile, quat_of
from hypothesis import given, settings
from hypothesis import strategies as st

from vla_zenoh.control.actions import Response, as_deltas, between, chunk_poses, covered_step
from vla_zenoh.control.chunk_planner import ChunkPlan, ChunkPlanner
from vla_zenoh.control.commander import Setting
from vla_zenoh.control.commander_io import StateHistory
from vla_zenoh.control.plan_timeline import Goal, GoalTimeline
from vla_zenoh.control.step_space import PoseSteps
from vla_zenoh.kinematics.so3 import (
    Pose,
    angle_between,
    exp3,
    interpolate,
    log3,
    rotation_from_quat,
)
from vla_zenoh.policy import ActionSpec, ControllerSpec
from vla_zenoh.profile.limits import Workspace
from vla_zenoh.types import FloatArray, PoseState

ATOL = 1e-9
FEW = settings(max_examples=25)
START = Pose(np.array([0.45, -0.1, 0.3]), exp3(np.array([2.8, 0.3, -0.5])))
OSC = {"dt_s": 0.05, "controller": ControllerSpec(kp=150.0)}
POSITION_M, ROTATION_RAD = 0.05, 0.5

small = st.tuples(*[st.floats(-0.05, 0.05)] * 3, *[st.floats(-0.2, 0.2)] * 3).map(
    lambda row: np.round(np.array(row), 4)
)
chunks = st.lists(small, min_size=1, max_size=16).map(np.array)
inputs = st.lists(st.tuples(*[st.floats(-1.0, 1.0)] * 6).map(np.array), min_size=1, max_size=24)


def spec(**fields: Any) -> ActionSpec:
    base = {"horizon": 64, "dt_s": 0.1, "gripper": "none", "rotation": "rotvec"}
    return ActionSpec(**{**base, **fields})  # pyright: ignore[reportArgumentType]


def matrix(pose: Pose) -> FloatArray:
    out = np.eye(4)
    out[:3, :3], out[:3, 3] = pose.rotation, pose.position_m
    return out


def assert_same(poses: list[Pose], wanted: list[FloatArray]) -> None:
    np.testing.assert_allclose([matrix(pose) for pose in poses], wanted, atol=ATOL)


JOINTS = tuple(f"joint{number}" for number in range(1, 7))
STATE_RAD = np.array([0.3, -0.5, 0.1, -1.8, 0.2, 1.1])


def joint_columns(kind: str, relative_to: str, steps: FloatArray) -> FloatArray:
    """Joints that a chunk reaches from `STATE_RAD`, as deltas on the step before."""
    action = spec(space="joint", joints=JOINTS, kind=kind, relative_to=relative_to, dt_s=0.25)
    plain, rows = as_deltas(action, steps)
    assert (plain.space, plain.joints, plain.relative_to) == ("joint", JOINTS, "previous")
    return rows if kind == "absolute" else STATE_RAD + np.cumsum(rows, axis=0)


@FEW
@given(chunks)
def test_joints_of_a_chunk_are_those_of_their_sources(steps: FloatArray) -> None:
    # openpi's AbsoluteActions adds the state to every row, DROID's delta the row before; a velocity
    # lasts for the duration of its step.
    for kind, relative_to, wanted in (
        ("delta", "start", STATE_RAD + steps),
        ("delta", "previous", STATE_RAD + np.cumsum(steps, axis=0)),
        ("velocity", "previous", STATE_RAD + 0.25 * np.cumsum(steps, axis=0)),
        ("absolute", "previous", steps),
    ):
        reached = joint_columns(kind, relative_to, steps)
        np.testing.assert_allclose(reached, wanted, atol=ATOL, err_msg=f"{kind} {relative_to}")


# -- references -----------------------------------------------------------------------------------
@FEW
@given(chunks)
def test_umi_puts_every_pose_of_a_chunk_on_the_pose_of_the_observation(steps: FloatArray) -> None:
    action = spec(frame="tcp", relative_to="start", anchor="measured")
    relative = [matrix(Pose(step[:3], exp3(step[3:]))) for step in steps]
    assert_same(chunk_poses(action, steps, START), [matrix(START) @ each for each in relative])


@FEW
@given(chunks)
def test_openpi_adds_every_delta_of_a_chunk_to_the_state(steps: FloatArray) -> None:
    steps[:, 3:] = 0.0
    action = spec(relative_to="start", anchor="measured")
    state = START.position_m
    absolute = steps[:, :3] + state  # AbsoluteActions: actions += state, for all steps
    reached = [pose.position_m for pose in chunk_poses(action, steps, START)]
    np.testing.assert_allclose(reached, absolute, atol=ATOL)


@FEW
@given(chunks, st.sampled_from(["base", "tcp"]))
def test_a_velocity_is_integrated_over_each_step(steps: FloatArray, frame: str) -> None:
    action, parts = spec(kind="velocity", frame=frame, dt_s=0.25), 50
    position_m, rotation = START
    wanted = []
    for step in steps:
        velocity, rate = step[:3], step[3:]
        axes = rotation if frame == "tcp" else np.eye(3)
        # Both parts of a twist in the TCP frame are in its axes when the step begins.
        for _ in range(parts):
            position_m = position_m + axes @ velocity * 0.25 / parts
            rotation = exp3(axes @ rate * 0.25 / parts) @ rotation
        wanted.append(matrix(Pose(position_m, rotation)))
    assert_same(chunk_poses(action, steps, START), wanted)


@FEW
@given(
    chunks,
    st.sampled_from(["base", "tcp"]),
    st.sampled_from([("delta", "start"), ("velocity", "previous"), ("delta", "previous")]),
)
def test_a_chunk_is_the_same_motion_as_deltas_one_by_one(
    steps: FloatArray, frame: str, meaning: tuple[str, str]
) -> None:
    action = spec(frame=frame, kind=meaning[0], relative_to=meaning[1])
    plain, deltas = as_deltas(action, steps)
    assert (plain.kind, plain.relative_to) == ("delta", "previous")
    wanted = [matrix(pose) for pose in chunk_poses(action, steps, START)]
    assert_same(chunk_poses(plain, deltas, START), wanted)


class OperationalSpaceController:
    """robosuite's OSC_POSE on a mass of one: its update of the goals, integrated in small steps."""

    def __init__(self, start: Pose, kp: float = 150.0, ratio: float = 1.0) -> None:
        self.position_m, self.rotation = start
        self.goal_m, self.goal_rotation = start
        self.velocity, self.rate = np.zeros(3), np.zeros(3)
        self.kp, self.kd = kp, 2 * math.sqrt(kp) * ratio

    def step(self, numbers: FloatArray, dt_s: float = 0.05, parts: int = 200) -> Pose:
        delta = np.clip(numbers, -1, 1) * np.repeat([POSITION_M, ROTATION_RAD], 3)
        self.goal_m = self.position_m + delta[:3]
        if np.any(delta[3:] != 0.0):
            self.goal_rotation = exp3(delta[3:]) @ self.rotation
        h = dt_s / parts
        for _ in range(parts):
            crossed = np.cross(self.rotation.T, self.goal_rotation.T).sum(axis=0)
            force = self.kp * (self.goal_m - self.position_m) - self.kd * self.velocity
            torque = self.kp * 0.5 * crossed - self.kd * self.rate
            self.position_m = self.position_m + h * (self.velocity + 0.5 * h * force)
            self.rotation = exp3(h * (self.rate + 0.5 * h * torque)) @ self.rotation
            self.velocity, self.rate = self.velocity + h * force, self.rate + h * torque
        return Pose(self.position_m, self.rotation)


def osc_steps(numbers: Any) -> FloatArray:
    """Action steps of OSC's inputs, clipped and scaled as its controller does."""
    clipped = np.clip(np.array(numbers, dtype=np.float64), -1, 1)
    return clipped * np.repeat([POSITION_M, ROTATION_RAD], 3)


@settings(max_examples=10)
@given(inputs, st.data())
def test_osc_moves_as_robosuites_update_of_its_goal_says(
    numbers: list[FloatArray], data: st.DataObject
) -> None:
    for row in numbers:
        if data.draw(st.booleans()):
            row[3:] = 0.0  # its orientation goal stays
    reference = OperationalSpaceController(START)
    wanted = [reference.step(row) for row in numbers]
    reached = chunk_poses(spec(**OSC), osc_steps(numbers), START)
    for ours, theirs in zip(reached, wanted, strict=True):
        assert np.linalg.norm(ours.position_m - theirs.position_m) < 1e-4
        assert angle_between(ours.rotation, theirs.rotation) < 0.02


@pytest.mark.parametrize(("amplitude", "moved_m"), [(0.3, 0.0770), (0.6, 0.1540), (1.0, 0.2567)])
def test_twenty_steps_of_osc_move_a_quarter_of_their_sum(amplitude: float, moved_m: float) -> None:
    row = np.array([amplitude, 0, 0, 0, 0, 0])
    reference = OperationalSpaceController(START)
    theirs = np.array([reference.step(row).position_m for _ in range(20)])
    poses = chunk_poses(spec(**OSC), osc_steps([row] * 20), START)
    ours = np.array([pose.position_m for pose in poses])
    apart_mm = 1e3 * np.linalg.norm(ours - theirs, axis=1)
    assert np.percentile(apart_mm, 95) < 0.2
    assert ours[-1, 0] - START.position_m[0] == pytest.approx(moved_m, abs=1e-4)


def test_a_turn_of_osc_is_pulled_by_the_sine_of_its_angle() -> None:
    """robosuite's error of orientation: half the sum of cross products of the axes."""
    row = np.array([0.0, 0.0, 0.0, 0.6, 0.0, 0.8])
    wanted = OperationalSpaceController(START).step(row)
    (reached,) = chunk_poses(spec(**OSC), osc_steps([row]), START)
    assert angle_between(reached.rotation, wanted.rotation) < 1e-3


def test_what_a_limit_cuts_off_of_a_response_is_cut_off_evenly_on_its_way() -> None:
    action, step = spec(**OSC), np.array([0.05, -0.02, 0.0, 0.0, 0.3, 0.4])
    asked, whole = covered_step(action, step, START, START, None)
    assert whole is not None
    after = interpolate(START, asked, 0.6)
    cut = whole.stopped(asked, after)
    end, last = between(START, after, cut, action.dt_s, 1.0)
    np.testing.assert_allclose(matrix(end), matrix(after), atol=ATOL)
    np.testing.assert_allclose(last.rate, cut.rate, atol=ATOL)
    middle, _ = between(START, after, cut, action.dt_s, 0.5)
    uncut, _ = between(START, asked, whole, action.dt_s, 0.5)
    apart_m = middle.position_m - uncut.position_m
    np.testing.assert_allclose(apart_m, (after.position_m - asked.position_m) / 2, atol=ATOL)


@pytest.mark.parametrize(("speed", "left"), [(0.3, 0.0), (-0.3, -0.3)])
def test_a_response_keeps_its_speed_where_it_comes_back_from_a_wall(
    speed: float, left: float
) -> None:
    rate = np.array([speed, 0.2, 0.0, 0.0, 0.0, 0.1])
    state = Response(ControllerSpec(kp=150.0), rate, np.eye(3), np.zeros(6), np.zeros(6))
    asked = Pose(START.position_m + [0.01, 0.0, 0.0], START.rotation)
    stopped = state.stopped(asked, START)
    np.testing.assert_allclose(stopped.rate, [left, *rate[1:]], atol=ATOL)


@pytest.mark.parametrize("ratio", [0.3, 0.999999999, 1.0, 1.000000001, 2.5])
def test_a_response_of_any_damping_is_that_of_the_equation(ratio: float) -> None:
    reference = OperationalSpaceController(START, kp=80.0, ratio=ratio)
    rows = [np.array([0.4, -0.2, 0.1, 0.1, 0.0, 0.0])] * 3
    wanted = [reference.step(row, parts=1000).position_m for row in rows]
    action = spec(dt_s=0.05, controller=ControllerSpec(kp=80.0, damping_ratio=ratio))
    reached = chunk_poses(action, osc_steps(rows), START)
    np.testing.assert_allclose([pose.position_m for pose in reached], wanted, atol=5e-5)


# -- chunks ---------------------------------------------------------------------------------------
WIDE = profile(
    limits={
        "step_m": 0.2,
        "step_rad": 1.0,
        "workspace": Workspace(x_m=(-3.0, 3.0), y_m=(-3.0, 3.0), z_m=(-3.0, 3.0)),
    },
    timing={"max_open_loop_s": 10.0},
)


def plan_of(action: ActionSpec, timeline: GoalTimeline, observed_ns: int, steps: Any) -> ChunkPlan:
    planner = ChunkPlanner(WIDE, None)
    plan = planner.plan(lone_chunk(steps, observed_ns), action, timeline)
    assert isinstance(plan, ChunkPlan), plan
    while plan.bounded < len(plan.goals):
        planner.begin_tick()
        planner.bound_due([plan], plan.end_ns)
    return plan


@settings(max_examples=10)
@given(st.lists(small, min_size=4, max_size=10), st.data())
def test_a_response_goes_on_where_the_next_chunk_begins(
    steps: list[FloatArray], data: st.DataObject
) -> None:
    """Also between two steps: the part of the response that was in force there is what counts."""
    action, rows = spec(**OSC), np.array(steps)
    dt_ns = 50 * MS
    whole = plan_of(action, GoalTimeline(Goal(START, 0.08), START_NS), START_NS, rows)
    after = data.draw(st.integers(1, len(rows) - 1))
    timeline = GoalTimeline(Goal(START, 0.08), START_NS)
    timeline.add(plan_of(action, timeline, START_NS, rows), START_NS)
    again = plan_of(action, timeline, START_NS + after * dt_ns, rows[after:])
    for ours, theirs in zip(again.goals, whole.goals[after:], strict=True):
        np.testing.assert_allclose(ours.pose.position_m, theirs.pose.position_m, atol=ATOL)
        assert angle_between(ours.pose.rotation, theirs.pose.rotation) < 1e-7
        assert ours.response is not None
        assert theirs.response is not None
        np.testing.assert_allclose(ours.response.rate, theirs.response.rate, atol=1e-7)
    share = data.draw(st.floats(0.01, 0.99))
    middle = whole.goal_at(START_NS + round((after + share) * dt_ns))
    reference, scale = OperationalSpaceController(START), np.repeat([POSITION_M, ROTATION_RAD], 3)
    for row in rows[:after]:
        reference.step(row / scale)
    there = reference.step(rows[after] / scale, dt_s=share * 0.05)
    np.testing.assert_allclose(middle.pose.position_m, there.position_m, atol=1e-4)
    assert angle_between(middle.pose.rotation, there.rotation) < 0.01


def test_a_wall_takes_the_speed_of_a_response_but_not_that_along_it() -> None:
    box = Workspace(x_m=(-3.0, START.position_m[0] + 0.02), y_m=(-3.0, 3.0), z_m=(-3.0, 3.0))
    of = profile(limits={"workspace": box, "step_m": 0.2})
    planner, timeline = ChunkPlanner(of, None), GoalTimeline(Goal(START, 0.08), START_NS)
    rows = osc_steps([[1.0, 1.0, 0, 0, 0, 0]] * 10 + [[-0.5, 0, 0, 0, 0, 0]] * 2)
    plan = planner.plan(lone_chunk(rows), spec(**OSC), timeline)
    assert isinstance(plan, ChunkPlan), plan
    while plan.bounded < len(plan.goals):
        planner.begin_tick()
        planner.bound_due([plan], plan.end_ns)
    state = plan.goals[9].response
    assert state is not None
    assert plan.goals[9].pose.position_m[0] == pytest.approx(box.x_m[1])
    assert state.rate[0] == pytest.approx(0.0, abs=1e-6)
    assert state.rate[1] > 0.2
    assert plan.goals[10].pose.position_m[0] < box.x_m[1]


# -- in lockstep ----------------------------------------------------------------------------------
DT_S, STEPS = 0.1, 16
UMI = {"frame": "tcp", "relative_to": "start", "anchor": "measured", "dt_s": DT_S, "horizon": STEPS}


def umi_chunk(rig: Rig, target_m: FloatArray, speed_m_s: float) -> FloatArray:
    """Poses on the way to `target_m`, relative to where the arm is: a policy's answer."""
    here = Pose(rig.position_m.copy(), rotation_from_quat(rig.quat_xyzw))
    way_m = target_m - here.position_m
    far_m = float(np.linalg.norm(way_m))
    shares = np.minimum(speed_m_s * DT_S * np.arange(1, STEPS + 1) / max(far_m, 1e-9), 1.0)
    back = rotation_from_quat(DOWN)
    turn = log3(here.rotation.T @ back)
    rows = [[*(here.rotation.T @ way_m * share), *turn, 0.0] for share in shares]
    return np.array(rows)


@pytest.mark.parametrize(
    ("mode", "latency_s"), [("replace", 0.1), ("blend", 0.0), ("blend", 0.1), ("ensemble", 0.1)]
)
def test_a_chunk_relative_to_the_observation_goes_as_far_as_it_says(
    mode: str, latency_s: float
) -> None:
    """0.10 m in chunks of 1.6 s, replanned every 0.8 s."""
    rig = Rig(profile(composition={"mode": mode}), **UMI)
    rig.activate()
    target_m = START_M + [0.10, 0.0, 0.0]
    furthest_m = 0.0
    for _ in range(4):
        steps, observed_ns = umi_chunk(rig, target_m, 0.08), rig.now_ns
        for _ in range(round(latency_s * 1e9 / rig.period_ns)):
            rig.tick()
        ago_s = (rig.now_ns + rig.period_ns - observed_ns) / 1e9
        rig.send(steps, observed_ago_s=ago_s)
        while rig.now_ns < observed_ns + 800 * MS:
            rig.tick()
            furthest_m = max(furthest_m, rig.moved_m()[0])
    rig.settle()
    assert rig.moved_m() == pytest.approx([0.10, 0.0, 0.0], abs=1e-3)
    assert furthest_m < 0.101
    assert not rig.refused


def test_a_chunk_whose_start_was_not_measured_is_rejected_by_name() -> None:
    rig = Rig(profile(timing={"max_observation_age_s": 5.0}), **UMI)
    rig.run(2.0)
    rig.activate()
    rig.silent = True
    rig.run(0.1)
    rig.silent = False
    rig.tick()
    rig.send([[0.01, 0, 0, 0, 0, 0, 0]], observed_ago_s=0.05)
    assert not rig.refused  # its last pose is recent enough
    rig.run(3.0)
    assert rig.commander.lease is not None
    rig.commander.lease.last_observation_ns = rig.commander.lease.since_ns = 0
    rig.send([[0.01, 0, 0, 0, 0, 0, 0]], observed_ago_s=4.0)
    assert rig.refused == {"not_measured": 1}


def test_a_velocity_moves_for_as_long_as_its_steps_and_then_the_arm_stands() -> None:
    rig = Rig(kind="velocity", dt_s=0.1)
    rig.activate()
    rig.send([[0.05, 0, 0, 0, 0, 0.1, 0.0]] * 8)
    rig.run(0.7)
    rig.settle()
    assert rig.moved_m() == pytest.approx([0.04, 0.0, 0.0], abs=1e-6)
    assert rig.turned_rad() == pytest.approx([0.0, 0.0, 0.08], abs=1e-6)
    rig.assert_smooth()


@pytest.mark.parametrize(
    ("steps_a_chunk", "latency_s"), [(1, 0.0), (1, 0.08), (10, 0.08), (20, 0.0)]
)
def test_twenty_steps_of_osc_move_the_arm_as_far_in_any_chunks(
    steps_a_chunk: int, latency_s: float
) -> None:
    """Amplitude 0.3: 0.30 m asked for, 0.077 m covered."""
    rig = Rig(gripper="none", **OSC, horizon=20)
    rig.tick(chunks=[rig.chunk([[0.0] * 6])])
    rig.put("active", True)
    rig.tick()
    rows = osc_steps([[0.3, 0, 0, 0, 0, 0]] * 20)
    wanted_m = chunk_poses(rig.spec.action, rows, START)[-1].position_m - START.position_m
    late = round(latency_s * 1e9 / rig.period_ns)
    for _ in range(20 // steps_a_chunk):
        observed_ns = rig.now_ns
        for _ in range(late):
            rig.tick()
        ago_s = (rig.now_ns + rig.period_ns - observed_ns) / 1e9
        rig.send(rows[:steps_a_chunk], observed_ago_s=ago_s)
        ends_ns = rig.now_ns + steps_a_chunk * 50 * MS
        while rig.now_ns < ends_ns:
            rig.tick()
    rig.settle()
    assert wanted_m[0] == pytest.approx(0.077, abs=1e-4)
    assert rig.moved_m() == pytest.approx(wanted_m, abs=1e-6)
    rig.assert_smooth()


@pytest.mark.parametrize("back_s", [0.06, 3600.0])
def test_after_the_clock_was_set_back_a_measured_anchor_is_where_the_arm_is(back_s: float) -> None:
    rig = Rig(dt_s=0.2, anchor="measured")
    rig.activate()
    rig.run(0.3)
    for _ in range(4):
        rig.send([[0.04, 0, 0, 0, 0, 0, 0]] * 5, observed_ago_s=0.05)
        rig.run(0.2)
    rig.now_ns -= round(back_s * 1e9)
    rig.tick(Setting("lose", "the wall clock was set"))
    rig.run(0.5)
    stands_m = rig.position_m.copy()
    rig.activate()
    rig.run(0.1)
    rig.refused.clear()
    rig.send([[0, 0, 0.001, 0, 0, 0, 0]], observed_ago_s=0.05)
    rig.run(1.0)
    assert not rig.refused
    np.testing.assert_allclose(rig.position_m - stands_m, [0, 0, 0.001], atol=1e-6)


def test_a_pose_from_the_future_says_nothing_about_the_past() -> None:
    rig = Rig(dt_s=0.2, anchor="measured")
    history: StateHistory[PoseState] = StateHistory()
    pose = rig.pose_state()
    history.restart(pose)
    ahead_ns = pose.received_ns + 1_000_000_000
    history.add(replace(pose, header=replace(pose.header, stamp_wall_ns=ahead_ns)))
    assert history.around(ahead_ns, 20_000_000) is None


def test_a_pose_measured_between_two_states_is_between_theirs() -> None:
    rig, history = Rig(), StateHistory[PoseState]()
    steps = PoseSteps(rig.profile.limits, None, history, 50 * MS)
    history.restart(rig.pose_state())
    rig.now_ns += 20 * MS
    rig.position_m = START_M + [0.01, 0.0, 0.0]
    rig.quat_xyzw = quat_of([0.0, 0.0, 0.2])
    history.add(rig.pose_state())
    found = steps.measured(rig.now_ns - 15 * MS, 0.08)
    assert found is not None
    np.testing.assert_allclose(found.pose.position_m, START_M + [0.0025, 0.0, 0.0], atol=1e-9)
    turned = log3(found.pose.rotation @ rotation_from_quat(DOWN).T)
    np.testing.assert_allclose(turned, [0.0, 0.0, 0.05], atol=1e-9)


@FEW
@given(
    kp=st.floats(1.0, 1e4),
    ratio=st.floats(0.1, 10.0),
    dt_s=st.floats(1e-3, 60.0),
)
def test_every_controller_that_can_be_declared_has_a_finite_response_that_ends_at_its_goal(
    kp: float, ratio: float, dt_s: float
) -> None:
    controller = ControllerSpec(kp=kp, damping_ratio=ratio)
    spec = ActionSpec(
        horizon=1, dt_s=0.1, rotation="rotvec", gripper="none", controller=controller
    ).model_copy(update={"dt_s": dt_s})
    step = np.array([0.05, 0.0, 0.0, 0.0, 0.0, 0.0])
    pose, state = covered_step(spec, step, START, START, None)
    assert state is not None
    assert np.isfinite(pose.position_m).all()
    assert np.isfinite(state.rate).all()
    gone_m = (pose.position_m - START.position_m)[0]
    overshoot = 1.0 + math.exp(-math.pi * min(ratio, 0.999) / math.sqrt(1 - min(ratio, 0.999) ** 2))
    assert -1e-12 <= gone_m <= 0.05 * overshoot + 1e-9
    slowest = math.sqrt(kp) * (ratio - math.sqrt(max(ratio**2 - 1, 0.0)))
    if slowest * dt_s > 20.0:
        assert gone_m == pytest.approx(0.05, abs=1e-6)
