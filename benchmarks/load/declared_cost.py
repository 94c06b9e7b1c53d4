# /// script
# requires-python = ">=3.11"
# dependencies = ["numpy"]
# ///
"""A model that only takes its time: cost(n) = c (1 + k (n - 1)) for n robots at once."""

from __future__ import annotations

import time
from collections.abc import Sequence

import numpy as np

from vla_zenoh.policy import (
    ActionSpec,
    ActionSteps,
    CameraSpec,
    ModelSpec,
    Observation,
    ObservationSpec,
)

HORIZON, DT_S, STEP_M = 10, 0.1, 0.005
CAMERAS = ("front", "wrist", "side")


class DeclaredCost:
    """Steps without motion, after the declared time.

    Args:
        cost_ms: c, of one robot.
        growth: k, the share of it that each further robot adds; 1: batching gains nothing.
        max_batch: robots in one inference; 0: all.
        cameras: images of an observation; 0: it sees the arm, which it moves up and down.
        side: their width and height; 0: any.
    """

    def __init__(
        self,
        cost_ms: str = "80",
        growth: str = "0.15",
        max_batch: str = "0",
        cameras: str = "1",
        side: str = "0",
    ) -> None:
        self._cost_s, self._growth = float(cost_ms) / 1e3, float(growth)
        self._steps = np.zeros((HORIZON, 6))
        if cameras == "0":
            self._steps[:, 2] = STEP_M * np.resize((1, -1), HORIZON)
        self.max_batch = int(max_batch)
        size = int(side) or None
        seen = tuple(
            CameraSpec(camera=name, width=size, height=size, resize="pad" if size else "none")
            for name in CAMERAS[: int(cameras)]
        )
        self.spec = ModelSpec(
            name="declared",
            observation=ObservationSpec(cameras=seen, state=() if seen else ("pose",)),
            action=ActionSpec(horizon=HORIZON, dt_s=DT_S, gripper="none"),
        )

    def infer(self, observation: Observation) -> ActionSteps:
        """The steps."""
        return self.infer_batch([observation])[0]

    def infer_batch(self, observations: Sequence[Observation]) -> list[ActionSteps]:
        """The steps of each, after the time for all."""
        # It sleeps: a model on a GPU leaves the processor to the others.
        time.sleep(self._cost_s * (1 + self._growth * (len(observations) - 1)))
        return [ActionSteps(self._steps) for _ in observations]
