"""The target stream as a model: one step of absolute pose for each inference."""

from __future__ import annotations

import os
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

from vla_zenoh.policy import ActionSpec, ActionSteps, ModelSpec, ObservationSpec

sys.path.append(str(Path(__file__).parent))
from target_stream import RATE_HZ, lateness_s, offsets

BEGAN = "FRANKA_STREAM_BEGAN"
"""Environment variable with the file that takes the time of the first target."""


class Stream:
    """Stands still until the prompt is ``go``, then plays the stream."""

    spec = ModelSpec(
        name="stream",
        observation=ObservationSpec(cameras=(), state=("pose",)),
        action=ActionSpec(
            horizon=1,
            dt_s=1 / RATE_HZ,
            kind="absolute",
            rotation="quaternion",
            gripper="none",
        ),
    )

    def __init__(self) -> None:
        self._start: np.ndarray | None = None
        self._offsets, self._late_s = offsets(), lateness_s()

    def infer(self, observation: Any) -> ActionSteps:
        """One target, as late as for every contestant."""
        pose = observation.pose
        if self._start is None or observation.prompt != "go":
            self._start = np.concatenate((pose.position_m, pose.quat_xyzw))
            return ActionSteps([self._start])
        if not Path(os.environ[BEGAN]).exists():
            Path(os.environ[BEGAN]).write_text(str(time.monotonic()))
        time.sleep(next(self._late_s))
        target = self._start.copy()
        target[:3] += next(self._offsets)
        return ActionSteps([target])
