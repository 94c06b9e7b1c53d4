"""One brick policy answers several robots, and remembers each for itself."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from batch_law import ROBOTS, Round, check_law, rounds
from hypothesis import given, settings

from vla_zenoh.lab.check.examples import example_observation
from vla_zenoh.policy import Observation
from vla_zenoh.policy.loader import find_model, make_policy
from vla_zenoh.types import GripperState

PROMPTS = ("put the red brick in the box", "push the blue brick away", "stack red on green", "?")
ATOL = 2e-4
"""Metres and radians: sums of float32 in another order."""


def made(prefix: str) -> Any:
    policy = make_policy(find_model("brick"), {"prefix": prefix, "threads": "1"})
    policy.load()  # pyright: ignore[reportAttributeAccessIssue]
    return policy


@pytest.fixture(scope="module", params=["off", "on"])
def policies(request: pytest.FixtureRequest) -> tuple[Any, dict[str, Any]]:
    return made(request.param), {robot: made(request.param) for robot in ROBOTS}


def looking(policy: Any, seed: int) -> Observation:
    random = np.random.default_rng(seed)
    seen = example_observation(policy.spec, prompt=PROMPTS[seed % len(PROMPTS)])
    assert seen.pose is not None
    images = {
        name: random.integers(0, 256, picture.shape, dtype=np.uint8)
        for name, picture in seen.images.items()
    }
    place_m = random.uniform([0.4, -0.1, 0.01], [0.55, 0.1, 0.15])
    return replace(
        seen,
        images=images,
        task=replace(seen.task, active=True),
        pose=replace(seen.pose, position_m=place_m),
        gripper=GripperState(float(random.uniform(0.0, 0.08)), False, False),
    )


@settings(deadline=None, max_examples=15)
@given(given=rounds())
def test_each_robot_is_answered_as_by_a_worker_of_its_own(
    policies: tuple[Any, dict[str, Any]], given: list[Round]
) -> None:
    together, alone = policies
    check_law(together, alone, given, lambda seed: looking(together, seed), ATOL)


def test_what_one_robot_pushed_is_not_forgotten_when_another_begins(
    policies: tuple[Any, dict[str, Any]],
) -> None:
    together, _ = policies
    together.reset()
    low = looking(together, 1)
    assert low.pose is not None
    for x_m in (0.4, 0.5):
        pose = replace(low.pose, position_m=np.array([x_m, 0.0, 0.016]))
        together.infer_batch([replace(low, pose=pose, robot=robot) for robot in "ab"])
    together.reset("a")
    assert "a" not in together._memory
    assert together._memory["b"].hand.swept_m == pytest.approx(0.1)
