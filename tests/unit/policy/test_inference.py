"""Real-time chunking: what is under way is told as it lies on the path, and ends no jump."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vla_zenoh.lab.check.examples import example_observation
from vla_zenoh.policy import ActionSpec, ActionSteps, ModelSpec, Observation
from vla_zenoh.policy.inference import ChunkPrefix, Committed, rest_of

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
    first = seen(0)
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


def test_the_first_step_counts_as_asked_for_at_once() -> None:
    committed = told(30, 100)
    assert committed is not None
    np.testing.assert_allclose(committed.steps, ramp()[1:], atol=ATOL)


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
    committed = told(600, 5000)
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
