"""The scripted policy for LIBERO: a hand does as it is told, and a thing sticks to it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from vla_zenoh.errors import WorkerError
from vla_zenoh.lab.check.examples import example_observation
from vla_zenoh.policy import Observation
from vla_zenoh.policy.loader import find_model, make_policy
from vla_zenoh.types import FloatArray, PoseState, PrivilegedState

BOWL = "pick up the black bowl next to the ramekin and place it on the plate"
SOUP = "pick up the alphabet soup and place it in the basket"
COVERED = 0.27
"""Of a step, by LIBERO's controller."""
UNIT_M, NEAR_M, STEPS = 0.05, 0.06, 220


@pytest.mark.parametrize(
    ("prompt", "thing", "place"),
    [(BOWL, "akita_black_bowl_1", "plate_1"), (SOUP, "alphabet_soup_1", "basket_1")],
)
def test_the_thing_is_let_go_above_its_place_having_been_lifted(
    prompt: str, thing: str, place: str
) -> None:
    policy = make_policy(find_model("libero_privileged"))
    thing_m, place_m = np.array([-0.1, -0.2, 0.9]), np.array([0.05, 0.2, 0.9])
    hand_m, highest_m, closed = np.array([-0.2, 0.0, 1.17]), 0.0, False
    for _ in range(STEPS):
        seen = observation(prompt, hand_m, {f"{thing}_pos": thing_m, f"{place}_pos": place_m})
        step = np.asarray(policy.infer(seen).steps)[0]
        assert np.abs(step[:3]).max() <= 1.0
        assert step[3:6] == pytest.approx(np.zeros(3))  # the hand points down already
        closed = step[6] > 0
        moved_m = COVERED * UNIT_M * step[:3]
        if closed and np.linalg.norm(hand_m - thing_m) < NEAR_M:
            thing_m = thing_m + moved_m
        hand_m, highest_m = hand_m + moved_m, max(highest_m, float(thing_m[2]))
    assert not closed
    assert thing_m[:2] == pytest.approx(place_m[:2], abs=0.02)
    assert highest_m > place_m[2] + 0.1


def test_a_task_that_it_does_not_know_is_an_error() -> None:
    policy = make_policy(find_model("libero_privileged"))
    with pytest.raises(WorkerError, match="open the middle drawer"):
        policy.infer(observation("open the middle drawer", np.zeros(3), {}))


def observation(prompt: str, hand_m: FloatArray, true: dict[str, FloatArray]) -> Observation:
    """What the policy reads."""
    seen = example_observation(make_policy(find_model("libero_privileged")).spec, prompt=prompt)
    pose = PoseState(hand_m, (1.0, 0.0, 0.0, 0.0), np.zeros(6))
    return replace(seen, pose=pose, privileged=PrivilegedState(true))
