"""One pass of OpenVLA answers several robots, whose prompts have other lengths, as one for each."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("timm", reason="needs OpenVLA's environment: make test-models")
import tiny_openvla
from test_openvla_numbers import mosaic
from test_openvla_oft import KEY, STATE_TEXT, Oft

from vla_zenoh.lab.check.examples import example_observation
from vla_zenoh.policy import Observation
from vla_zenoh.policy.loader import find_model, make_policy

pytestmark = pytest.mark.models

PROMPTS = ("up", "put the red brick in the box", "up", "move the arm a little to the left")
ATOL = 2e-4
"""Of numbers in [-1, 1], float32 sums in another order."""


def loaded(folder: Path, **options: str) -> Any:
    given = {"checkpoint": str(folder), "device": "cpu", "dtype": "float32", **options}
    policy: Any = make_policy(find_model("openvla"), given)
    policy.load()
    return policy


@pytest.fixture(scope="module")
def plain(tmp_path_factory: pytest.TempPathFactory) -> Any:
    folder = tmp_path_factory.mktemp("batches") / "tiny"
    tiny_openvla.write(folder, tiny_openvla.Parts())
    return loaded(folder, unnorm_key="bridge_orig")


@pytest.fixture(scope="module")
def oft(tmp_path_factory: pytest.TempPathFactory) -> Any:
    folder = tmp_path_factory.mktemp("batches") / "oft"
    Oft().write(folder)
    return loaded(folder, cameras="front,wrist", state=STATE_TEXT, unnorm_key=KEY)


def robots(policy: Any) -> list[Observation]:
    """One for each prompt, each with pictures of its own."""
    return [
        replace(
            example_observation(policy.spec, prompt=prompt),
            images={
                camera: mosaic(10 * number + index)
                for index, camera in enumerate(policy.spec.observation.camera_names)
            },
            robot=f"r{number}",
        )
        for number, prompt in enumerate(PROMPTS)
    ]


@pytest.mark.parametrize("kind", ["plain", "oft"])
def test_each_robot_is_answered_as_by_a_pass_of_its_own(
    kind: str, request: pytest.FixtureRequest
) -> None:
    policy = request.getfixturevalue(kind)
    seen = robots(policy)
    assert len({len(policy.ids(prompt)) for prompt in PROMPTS}) > 2
    found = policy.infer_batch(seen)
    for one, answer in zip(seen, found, strict=True):
        alone = policy.infer(one)
        np.testing.assert_allclose(answer.raw["normalised"], alone.raw["normalised"], atol=ATOL)
        np.testing.assert_array_equal(answer.raw["prompt_tokens"], alone.raw["prompt_tokens"])
    assert not np.allclose(found[0].raw["normalised"], found[1].raw["normalised"], atol=ATOL)


@pytest.mark.parametrize("kind", ["plain", "oft"])
def test_the_order_of_the_robots_makes_no_difference(
    kind: str, request: pytest.FixtureRequest
) -> None:
    policy = request.getfixturevalue(kind)
    seen = robots(policy)
    there, back = policy.infer_batch(seen), policy.infer_batch(seen[::-1])[::-1]
    for one, other in zip(there, back, strict=True):
        np.testing.assert_allclose(one.raw["normalised"], other.raw["normalised"], atol=ATOL)
