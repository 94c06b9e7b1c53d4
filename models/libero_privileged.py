# /// script
# requires-python = ">=3.11"
# dependencies = ["numpy"]
# ///
"""Privileged: picks and places in LIBERO from the true poses that a model on a robot never has.

It tests the chain from environment to model and back on whole tasks, and is no measure of models.
It knows the tasks of ``spatial`` that begin with a bowl in the open, and those of ``object``.
"""

from __future__ import annotations

import re

import numpy as np

from vla_zenoh.errors import WorkerError
from vla_zenoh.policy import ActionSpec, ActionSteps, ModelSpec, Observation, ObservationSpec
from vla_zenoh.policy.spec import ControllerSpec

UNIT_M = 0.05
GAIN = 2.0
"""Share of the distance to the goal; the controller covers about a quarter of a step."""
PROMPT = re.compile(r"pick up the (?P<thing>.+?)(?: (?:between|from|next|on|in) .+)? and place it")
RIM_M = (0.0, 0.045, 0.025)
CARRIED_M = {"plate_1": 0.15, "basket_1": 0.26}
LOWERED_M = {"plate_1": 0.03, "basket_1": 0.2}
ABOVE_M, NEAR_M, GRASP_STEPS, RELEASE_STEPS = 0.1, 0.006, 8, 6


class LiberoPrivileged:
    """Goes above the object, down, closes, lifts it, carries it above its place and releases it."""

    spec = ModelSpec(
        name="libero_privileged",
        observation=ObservationSpec(state=("pose", "privileged")),
        action=ActionSpec(
            horizon=1,
            dt_s=0.05,
            rotation="rotvec",
            position_scale_m=UNIT_M,
            controller=ControllerSpec(kp=150.0),
            gripper="binary",
            gripper_open_is_high=False,
            gripper_threshold=0.0,
        ),
    )

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        self._phase, self._waited, self._grasp_m = 0, 0, np.zeros(3)

    def infer(self, observation: Observation) -> ActionSteps:
        assert observation.pose is not None
        assert observation.privileged is not None
        true = observation.privileged.values
        thing, place, grasp_m = _meant(observation.prompt)
        if f"{thing}_pos" not in true or f"{place}_pos" not in true:
            raise WorkerError(f"not known in this scene: {observation.prompt!r}")
        thing_m, place_m = true[f"{thing}_pos"], true[f"{place}_pos"]
        hand_m = observation.pose.position_m
        if self._phase < 3:
            self._grasp_m = thing_m + grasp_m
        held_m = hand_m - thing_m  # the object must arrive above the place, not the hand
        carried_m = CARRIED_M[place]
        over_m = place_m + held_m + [0.0, 0.0, carried_m]
        goals_m = (
            self._grasp_m + [0.0, 0.0, ABOVE_M],
            self._grasp_m,
            self._grasp_m,
            np.array([*self._grasp_m[:2], over_m[2]]),
            over_m,
            over_m - [0.0, 0.0, carried_m - LOWERED_M[place]],
            hand_m,
            hand_m + [0.0, 0.0, ABOVE_M],
        )
        goal_m = goals_m[self._phase]
        waits = {2: GRASP_STEPS, 6: RELEASE_STEPS}.get(self._phase, 0)
        self._waited += 1
        near_m = NEAR_M if self._phase in (0, 1) else 2 * NEAR_M
        arrived = np.linalg.norm(goal_m - hand_m) < near_m
        move = np.clip(GAIN * (goal_m - hand_m) / UNIT_M, -1.0, 1.0)
        x, y, z, w = observation.pose.quat_xyzw
        turn = np.sign(x) * np.array([w, z, -y])  # half of the small turn to straight down
        closed = 2 <= self._phase < 6
        if self._phase < len(goals_m) - 1 and self._waited > waits and arrived:
            self._phase, self._waited = self._phase + 1, 0
        return ActionSteps([[*move, *turn, 1.0 if closed else -1.0]])


def _meant(prompt: str) -> tuple[str, str, np.ndarray]:
    """Object, place, and the grasp point of the hand, relative to the object's origin.

    Raises:
        WorkerError: the prompt is none of the tasks that it knows.
    """
    found = PROMPT.match(prompt)
    if found is None:
        raise WorkerError(f"knows the tasks of spatial and object only, not {prompt!r}")
    if found["thing"] == "black bowl":
        return "akita_black_bowl_1", "plate_1", np.array(RIM_M)
    return found["thing"].replace(" ", "_") + "_1", "basket_1", np.array([0.0, 0.0, 0.01])
