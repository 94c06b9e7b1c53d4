"""Real-time chunking: what is under way is told as it lies on the path, and ends no jump."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from vla_zenoh_dataset.episodes import StepClock, step_begins

from vla_zenoh.control.plan_timeline import Goal, GoalTimeline, Plan
from vla_zenoh.kinematics.so3 import Pose
from vla_zenoh.lab.check.examples import example_observation
from vla_zenoh.lab.recording.run import RecordedSample
from vla_zenoh.policy import ActionSpec, ActionSteps, ModelSpec, Observation
from vla_zenoh.policy.inference import ChunkPrefix, Committed, rest_of
from vla_zenoh.policy.spec import MotionKind
from vla_zenoh.types import ActionChunk, Cause, Header, Task

ATOL = 1e-6  # steps travel as float32
MS = 1_000_000
DELTA = ActionSpec(horizon=8, dt_s=0.1, gripper="absolute_m")
ABSOLUTE = ActionSpec(horizon=8, dt_s=0.1, kind="absolute", gripper="open_fraction")


class Model:
    """Remembers what it was told."""

    def __init__(self, action: ActionSpec = DELTA, *, takes: bool = True) -> None:
        self.spec = ModelSpec(name="m", action=action)
        self.takes_committed = takes
        self.told: Any = "nothing"

    def infer(self, observation: Observation, committed: Committed | None = None) -> ActionSteps:
        self.told = committed
        return ActionSteps(np.zeros((self.spec.action.horizon, self.spec.action.dimension)))


def ramp(horizon: int = 8) -> np.ndarray[Any, Any]:
    steps = np.zeros((horizon, 7), np.float32)
    steps[:, 0] = 0.001 * np.arange(1, horizon + 1)
    steps[:, 6] = np.linspace(0.0, 0.07, horizon)
    return steps


def seen(at_ms: float, episode: int = 1) -> Observation:
    found = example_observation(Model().spec)
    task = replace(found.task, episode=episode, active=True)
    return replace(found, stamp_wall_ns=10**18 + round(at_ms * MS), task=task)


def told(at_ms: float, late_ms: float, *, obeyed: bool = True, **more: Any) -> Committed | None:
    model = Model(**more)
    continuation = ChunkPrefix(model)
    first, earlier = seen(0), seen(-1)
    continuation.published(earlier, ramp(), earlier.stamp_wall_ns, obeyed=obeyed)
    published_ns = first.stamp_wall_ns + round(late_ms * MS)
    continuation.published(first, ramp(), published_ns, obeyed=obeyed)
    continuation.infer(seen(at_ms))
    return model.told


def test_what_lies_behind_the_observation_is_left_out() -> None:
    committed = told(300, 200)
    assert committed is not None
    np.testing.assert_allclose(committed.steps, ramp()[3:], atol=ATOL)
    assert committed.frozen == 2


def test_an_observation_within_a_step_cuts_the_path_anew() -> None:
    committed = told(350, 240)
    assert committed is not None
    np.testing.assert_allclose(
        committed.steps[:, 0], (ramp()[3:-1, 0] + ramp()[4:, 0]) / 2, atol=ATOL
    )
    np.testing.assert_allclose(committed.steps[:, 6], ramp()[3:-1, 6], atol=ATOL)
    assert committed.frozen == 3


def test_of_a_chunk_that_is_replaced_within_its_first_step_that_part_was_executed() -> None:
    committed = told(30, 100)
    assert committed is not None
    np.testing.assert_allclose(
        committed.steps[:, 0], 0.7 * ramp()[:-1, 0] + 0.3 * ramp()[1:, 0], atol=ATOL
    )


@pytest.mark.parametrize(("kind", "executed"), [("delta", 1.0), ("velocity", 0.3)])
def test_a_chunk_of_one_delta_is_a_step_and_of_one_velocity_what_it_had_time_for(
    kind: MotionKind, executed: float
) -> None:
    action = ActionSpec(horizon=1, dt_s=0.1, kind=kind, rotation="rotvec", gripper="none")
    prefix = ChunkPrefix(Model(action))
    prefix.published(seen(0), np.zeros((1, 6), np.float32), seen(0).stamp_wall_ns, obeyed=True)
    assert prefix.with_progress(seen(30)).executed_steps == pytest.approx(executed)


def test_nothing_is_committed_by_who_is_not_obeyed_nor_in_another_episode_nor_when_over() -> None:
    assert told(300, 200, obeyed=False) is None
    assert told(900, 200) is None
    model = Model()
    continuation = ChunkPrefix(model)
    first = seen(0)
    continuation.published(first, ramp(), first.stamp_wall_ns, obeyed=True)
    continuation.infer(seen(200, episode=2))
    assert model.told is None


def test_a_model_that_does_not_take_it_is_called_without() -> None:
    model = Model(takes=False)
    ChunkPrefix(model).infer(seen(0))
    assert model.told is None


def test_never_more_is_frozen_than_there_is() -> None:
    # It is late by more than the step before it: as much of the time the arm stood.
    committed = told(600 + 5000 - 799, 5000)
    assert committed is not None
    assert committed.frozen == len(committed.steps) == 2


def test_the_weights_are_those_of_the_paper() -> None:
    committed = Committed(np.zeros((6, 7), np.float32), 2)
    weights = committed.weights(8)
    expected = [1.0, 1.0]
    for index in range(2, 6):
        c = (6 - index) / (6 - 2 + 1)
        expected.append(c * (math.exp(c) - 1) / (math.e - 1))
    assert weights == pytest.approx([*expected, 0.0, 0.0])
    assert np.all(np.diff(weights) <= 0)
    assert committed.padded(8).shape == (8, 7)


@given(st.floats(1.0, 7.0))
def test_deltas_that_are_left_end_where_the_chunk_ends(had: float) -> None:
    steps = ramp()
    whole, share = math.floor(had), had - math.floor(had)
    path = np.concatenate([[0.0], np.cumsum(steps[:, 0])])
    left = rest_of(DELTA, steps, had)
    begin = np.interp(had, np.arange(9), path)
    ends = begin + np.cumsum(left[:, 0])
    wanted = np.interp(had + np.arange(1, len(left) + 1), np.arange(9), path)
    np.testing.assert_allclose(ends, wanted, atol=2e-5)
    assert len(left) in (8 - whole, 7 - whole)
    assert share < 2e-3 or len(left) == 7 - whole


def test_absolute_angles_are_mixed_the_short_way() -> None:
    steps = np.zeros((3, 7), np.float32)
    steps[:, 5] = (3.1, -3.1, -3.0)
    steps[:, 6] = (1.0, 0.0, 0.0)
    left = rest_of(ABSOLUTE, steps, 0.5)
    assert math.cos(left[0, 5]) == pytest.approx(-1.0, abs=1e-3)
    assert left[0, 6] == 1.0


def test_quaternions_stay_unit_whatever_their_sign() -> None:
    spec = ActionSpec(horizon=3, dt_s=0.1, kind="absolute", rotation="quaternion", gripper="none")
    steps = np.zeros((3, 7), np.float32)
    steps[:, 3] = (1.0, -1.0, 1.0)
    left = rest_of(spec, steps, 1.5)
    assert np.linalg.norm(left[:, 3:7], axis=1) == pytest.approx(1.0)
    assert abs(left[0, 3]) == pytest.approx(1.0)


Overrides = tuple[tuple[float, float], ...]
"""(Time in ms, share) of the speed override, oldest first."""


def set_override(prefix: ChunkPrefix, at_ms: float, share: float) -> None:
    now = seen(at_ms)
    prefix.set_task(replace(now.task, speed_percent=100.0 * share), now.stamp_wall_ns)


def told_under(
    overrides: Overrides,
    at_ms: float,
    *,
    max_age_s: float = 60.0,
    published_ms: float = 100,
    stood: bool = False,
) -> Committed | None:
    """What a model is told at a time of the chunk that it answered to the observation at 0 ms.

    The arm followed an earlier chunk, unless it `stood`.
    """
    model = Model()
    prefix = ChunkPrefix(model, max_age_s)
    set_override(prefix, *overrides[0])
    if not stood:
        prefix.published(seen(-1), ramp(), seen(-1).stamp_wall_ns, obeyed=True)
    prefix.published(seen(0), ramp(), seen(published_ms).stamp_wall_ns, obeyed=True)
    for time_ms, share in overrides[1:]:
        set_override(prefix, time_ms, share)
    task = replace(seen(at_ms).task, speed_percent=100.0 * overrides[-1][1])
    prefix.infer(replace(seen(at_ms), task=task))
    return model.told


@pytest.mark.parametrize(
    ("overrides", "had"),
    [
        (((-1000, 1.0), (300, 0.1)), 3),
        (((-1000, 0.5), (200, 1.0)), 2),
        (((-1000, 1.0), (100, 0.0), (200, 1.0)), 2),
        (((-1000, 1.0), (100, 0.5), (301, 1.0), (301, 0.0)), 2),
    ],
)
def test_steps_are_counted_at_the_speed_override_of_their_time_not_at_the_present_one(
    overrides: Overrides, had: int
) -> None:
    committed = told_under(overrides, 301)
    assert committed is not None
    np.testing.assert_allclose(committed.steps[0], ramp()[had], atol=2e-4)
    assert len(committed.steps) in (8 - had, 7 - had)


def test_the_latency_to_come_is_counted_at_the_present_speed_override() -> None:
    slow, fast = told_under(((-1000, 1.0), (300, 0.1)), 301), told_under(((-1000, 1.0),), 301)
    assert slow is not None
    assert fast is not None
    assert slow.frozen == fast.frozen == 1
    very_late = Model()
    prefix = ChunkPrefix(very_late, 60.0)
    set_override(prefix, -1, 1.0)
    prefix.published(seen(0), ramp(), seen(400).stamp_wall_ns, obeyed=True)
    set_override(prefix, 200, 0.5)
    prefix.infer(seen(200))
    assert very_late.told.frozen == 2


def test_after_a_pause_what_the_command_node_dropped_is_not_committed() -> None:
    paused = ((-1000, 1.0), (150, 0.0), (1150, 1.0))
    kept = told_under(paused, 1160, max_age_s=1.2)
    assert kept is not None
    np.testing.assert_allclose(kept.steps[0], ramp()[1] * 0.4 + ramp()[2] * 0.6, atol=1e-2)
    assert told_under(paused, 1160, max_age_s=1.0) is None


@pytest.mark.parametrize(("published_ms", "executed"), [(140, 2.0), (160, 1.0)])
def test_a_chunk_that_came_after_a_new_prompt_was_not_executed(
    published_ms: float, executed: float
) -> None:
    """The new episode begins at 150 ms: a chunk of before goes on until the first new one."""
    prefix = ChunkPrefix(Model(), 60.0)
    set_override(prefix, -1000, 1.0)
    prefix.published(seen(0), ramp(), seen(published_ms).stamp_wall_ns, obeyed=True)
    task = replace(seen(0).task, episode=seen(0).task.episode + 1)
    prefix.set_task(task, seen(150).stamp_wall_ns)
    first = replace(seen(200), task=task)
    prefix.published(first, ramp(), seen(300).stamp_wall_ns, obeyed=True)
    assert prefix.with_progress(replace(seen(400), task=task)).executed_steps == executed


@given(
    st.lists(
        st.tuples(st.integers(1, 400), st.sampled_from((0.0, 0.1, 0.35, 0.5, 1.0))), max_size=5
    ),
    st.sampled_from((0.25, 0.5, 1.0)),
    st.integers(0, 400),
    st.integers(1, 1500),
    st.booleans(),
)
def test_worker_command_node_and_data_set_count_the_same_steps(
    changes: list[tuple[int, float]], first: float, published_ms: int, after_ms: int, stood: bool
) -> None:
    at_ms = published_ms + after_ms
    times = np.cumsum([after for after, _ in changes])
    later = [(float(at), share) for at, (_, share) in zip(times, changes, strict=True)]
    overrides = ((-1000.0, first), *(one for one in later if one[0] < at_ms))
    zero_ns = seen(0).stamp_wall_ns
    poses = [Pose(np.array([0.001 * (k + 1), 0.0, 0.0]), np.eye(3)) for k in range(8)]
    timeline = GoalTimeline(Goal(poses[0], 0.0), zero_ns - 1000 * MS)
    timeline.clock.set(first, zero_ns - 1000 * MS)
    goals, published_ns = [Goal(pose, 0.0) for pose in poses], zero_ns + published_ms * MS
    cause = Cause("m", 1, *(zero_ns,) * 6)
    followed = [] if stood else [published(seen(-1), -1)]
    if not stood:
        timeline.add(Plan(zero_ns - MS, zero_ns - MS, 100 * MS, goals, cause), zero_ns - MS)
    followed.append(published(seen(0), published_ms))
    task = replace(seen(0).task, speed_percent=100.0 * first)
    tasks = [recorded(task, -1000.0)]
    for time_ms, share in overrides[1:]:
        timeline.clock.set(share, zero_ns + round(time_ms * MS))
        tasks.append(recorded(replace(task, speed_percent=100.0 * share), time_ms))
    plan = Plan(published_ns, zero_ns, 100 * MS, goals, cause)
    plan.idle_ns = timeline.idle_ns(zero_ns, published_ns)
    plan.begin = goals[0]
    timeline.add(plan, published_ns)
    end_ns = zero_ns + at_ms * MS
    executed = timeline.plan.steps_until(end_ns)
    begin_ns = step_begins(tasks, followed, {"": 0.1})[followed[-1].header]
    exported = StepClock(tasks, zero_ns, end_ns, 0.1)
    exported = exported.steps(end_ns) - exported.steps(begin_ns)
    assert min(max(exported, 0.0), 8.0) == pytest.approx(executed, abs=1e-4)
    committed = told_under(overrides, at_ms, published_ms=published_ms, stood=stood)
    if committed is None:
        assert executed > 7.0 - 1e-3
        return
    left = rest_of(DELTA, ramp(), executed)
    assert abs(len(left) - len(committed.steps)) <= 1
    shared = min(len(left), len(committed.steps))
    np.testing.assert_allclose(committed.steps[:shared, 0], left[:shared, 0], atol=2e-6)


def published(observation: Observation, at_ms: float) -> RecordedSample:
    """A recorded chunk that answers it."""
    seen_ns, at_ns = observation.stamp_wall_ns, seen(at_ms).stamp_wall_ns
    chunk = ActionChunk("m", "", 1, seen_ns, 1, at_ns, ramp(), seen_ns, seen_ns, at_ns)
    return RecordedSample(Header(at_ns, 1, "worker-m#1"), chunk, at_ns, "delta/m")


def recorded(task: Task, time_ms: float) -> RecordedSample:
    stamp_ns = seen(time_ms).stamp_wall_ns
    return RecordedSample(Header(stamp_ns, 0, "command#1"), task, stamp_ns, "task")
