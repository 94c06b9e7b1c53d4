# /// script
# requires-python = ">=3.11"
# dependencies = ["numpy"]
# ///
"""Fixed motions on command, without any learning: what a bridge is tested with.

Prompts, one step per request, as in the thesis this package grew from::

    HARD: go up | go down                    +-0.01 m along z of the base
    HARD: rol(l) left | right                +-0.05 rad about x
    HARD: pitch up | down                    +-0.05 rad about y
    HARD: yaw left | right                   +-0.05 rad about z
    HARD: open gripper | close gripper       +-0.05 m of width
    hold                                     stands still

``HARD: go up x50`` does 50 steps, then says it is done and stands still; ``HARD: go down x50 within
0.1`` turns back before it is further than 0.1 m from its start.
"""

from __future__ import annotations

import random
import time

import numpy as np

from vla_zenoh.motions import parse_hard
from vla_zenoh.policy import (
    ActionSpec,
    ActionSteps,
    CameraSpec,
    ModelSpec,
    Observation,
    ObservationSpec,
)


class Scripted:
    """See the module.

    Args:
        camera: picture every request waits for, as a real model would; empty: none.
        horizon: steps in one chunk.
        dt_s: duration of a step.
        delay_ms: pretend an inference takes this long.
        jitter: vary that by up to this fraction either way.
    """

    def __init__(
        self,
        camera: str = "front",
        horizon: str = "1",
        dt_s: str = "0.1",
        delay_ms: str = "0",
        jitter: str = "0",
    ) -> None:
        cameras = (CameraSpec(camera=camera),) if camera else ()
        self.spec = ModelSpec(
            name="scripted",
            observation=ObservationSpec(cameras=cameras, state=("pose", "gripper"), prompt=True),
            action=ActionSpec(
                horizon=int(horizon), dt_s=float(dt_s), rotation="rpy", gripper="delta_m"
            ),
        )
        self._delay_s, self._jitter = float(delay_ms) / 1e3, float(jitter)
        self._random = random.Random(0)
        self.reset()

    def reset(self) -> None:
        """Begin to count anew."""
        self._begun = 0  # steps before the last chunk
        self._last_stamp_ns = -1
        self._last_length = 0

    def infer(self, observation: Observation) -> ActionSteps:
        """The next chunk of the motion the prompt names."""
        asked = parse_hard(observation.prompt)
        if self._delay_s:
            time.sleep(self._delay_s * (1 + self._jitter * self._random.uniform(-1, 1)))
        done_steps = self._done_steps(observation.stamp_wall_ns)
        horizon = self.spec.action.horizon
        left = horizon if asked.steps is None else max(asked.steps - done_steps, 0)
        steps = np.zeros((horizon, self.spec.action.dimension), np.float32)
        length = min(left, horizon)
        if asked.motion is not None:
            for index in range(length):
                steps[index, asked.motion.axis] = asked.step(done_steps + index)
        # Before the arm is given to us nothing is counted: nobody carries it out.
        if observation.task.active:
            self._begun, self._last_length = done_steps, length
            self._last_stamp_ns = observation.stamp_wall_ns
        # The last step of a longer chunk has not begun when the chunk is sent.
        done = asked.motion is None or (asked.steps is not None and left <= min(horizon, 1))
        return ActionSteps(steps[: max(length, 1)], done)

    def _done_steps(self, stamp_ns: int) -> int:
        """Steps that were in force when this observation was taken: the next one stands on them."""
        if self._last_stamp_ns < 0:
            return self._begun
        dt_ns = int(self.spec.action.dt_s * 1e9)
        begun = (stamp_ns - self._last_stamp_ns) // dt_ns + 1
        return self._begun + min(begun, self._last_length)
