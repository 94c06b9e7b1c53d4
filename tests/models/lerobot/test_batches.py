"""One pass of a LeRobot policy answers several robots as a worker for each would."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

pytest.importorskip("lerobot", reason="needs LeRobot's environment: make test-models")
import tiny_act
import tiny_smolvla
from batch_law import ROBOTS, Round, check_law, rounds
from hypothesis import HealthCheck, given, settings
from test_lerobot import ACTION_OPTIONS, loaded, looking

from vla_zenoh.policy import Observation
from vla_zenoh.policy.loader import find_model, make_policy
from vla_zenoh.types import GripperState

pytestmark = [pytest.mark.models, pytest.mark.timeout(1200)]

ATOL = 2e-5
"""Of the actions' own units: sums of float32 in another order."""
PROMPTS = ("hold", "hold the brick", "the brick the brick", "")
SHORT = settings(
    deadline=None, max_examples=8, suppress_health_check=[HealthCheck.function_scoped_fixture]
)


class Watched:
    """A policy of LeRobot's, and how many robots each pass had."""

    def __init__(self, policy: Any) -> None:
        self.passes: list[int] = []
        self._ask = policy.predict_action_chunk
        policy.predict_action_chunk = self._count

    def _count(self, batch: dict[str, Any], **more: Any) -> Any:
        chunk = self._ask(batch, **more)
        self.passes.append(len(chunk))
        return chunk


def of_all(make: Callable[[], Any]) -> tuple[Any, dict[str, Any]]:
    return make(), {robot: make() for robot in ROBOTS}


@pytest.fixture(scope="module")
def act(tmp_path_factory: pytest.TempPathFactory) -> tuple[Any, dict[str, Any]]:
    folder = tmp_path_factory.mktemp("batches") / "act"
    tiny_act.write(folder)
    return of_all(lambda: loaded(folder))


@pytest.fixture(scope="module")
def averaging(tmp_path_factory: pytest.TempPathFactory) -> tuple[Any, dict[str, Any]]:
    folder = tmp_path_factory.mktemp("batches") / "averaging"
    tiny_act.write(folder, temporal_ensemble_coeff=0.01, n_action_steps=1)
    return of_all(lambda: loaded(folder))


@pytest.fixture(scope="module", params=["off", "on"])
def smolvla(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> tuple[Any, dict[str, Any]]:
    folder = tmp_path_factory.mktemp("batches") / "smolvla"
    tiny_smolvla.write(folder, mean=[0.1] * 6 + [0.5], std=[0.01] * 6 + [0.05])
    options = {
        "checkpoint": str(folder),
        "device": "cpu",
        "rtc": request.param,
        **ACTION_OPTIONS,
    }

    def make() -> Any:
        policy: Any = make_policy(find_model("lerobot"), options)
        policy.load()
        return policy

    return of_all(make)


def seen_by(policy: Any, seed: int) -> Observation:
    seen = looking(policy, seed)
    return replace(
        seen,
        task=replace(seen.task, prompt=PROMPTS[seed % len(PROMPTS)]),
        gripper=GripperState(width_m=0.001 * (seed % 80), moving=False, holding=False),
    )


@SHORT
@given(given=rounds())
def test_act_answers_each_robot_as_a_worker_of_its_own(
    act: tuple[Any, dict[str, Any]], given: list[Round]
) -> None:
    check_law(*act, given, lambda seed: seen_by(act[0], seed), ATOL)


@SHORT
@given(given=rounds())
def test_a_policy_that_averages_chunks_averages_those_of_each_robot(
    averaging: tuple[Any, dict[str, Any]], given: list[Round]
) -> None:
    check_law(*averaging, given, lambda seed: seen_by(averaging[0], seed), ATOL)


@SHORT
@given(given=rounds())
def test_smolvla_answers_each_robot_as_a_worker_of_its_own_with_its_own_noise(
    smolvla: tuple[Any, dict[str, Any]], given: list[Round]
) -> None:
    check_law(*smolvla, given, lambda seed: seen_by(smolvla[0], seed), ATOL)


def test_robots_with_pictures_of_one_size_are_one_pass(act: tuple[Any, dict[str, Any]]) -> None:
    policy = act[0]
    watched = Watched(policy.policy)
    seen = [replace(seen_by(policy, seed), robot=robot) for seed, robot in enumerate(ROBOTS)]
    policy.infer_batch(seen)
    assert watched.passes == [len(ROBOTS)]


def test_robots_share_the_weights_of_a_policy_that_remembers(
    averaging: tuple[Any, dict[str, Any]],
) -> None:
    policy = averaging[0]
    policy.infer_batch([replace(seen_by(policy, 1), robot=robot) for robot in ROBOTS])
    first, second, _ = (policy._policy_of(robot) for robot in ROBOTS)
    assert first is not second
    assert all(a is b for a, b in zip(first.parameters(), second.parameters(), strict=True))
    assert np.isfinite(next(first.parameters()).detach().numpy()).all()
