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
        self._plan = [(0.0, 0.0)]  # steps and way (m or rad) at the end of every step given last
        self._observed_ns = -1

    def infer(self, observation: Observation) -> ActionSteps:
        """The next chunk of the motion the prompt names."""
        asked = parse_hard(observation.prompt)
        if self._delay_s:
            time.sleep(self._delay_s * (1 + self._jitter * self._random.uniform(-1, 1)))
        plan = [self._reached(observation.stamp_wall_ns)]
        begun, _ = plan[0]
        last = begun + self.spec.action.horizon if asked.steps is None else float(asked.steps)
        while asked.motion is not None and len(plan) <= self.spec.action.horizon:
            if plan[-1][0] >= last:
                break
            steps = min(begun + len(plan), last)
            plan.append((steps, asked.offset(steps)))
        given = np.zeros((max(len(plan) - 1, 1), self.spec.action.dimension), np.float32)
        if asked.motion is not None and len(plan) > 1:
            given[:, asked.motion.axis] = np.diff([way for _, way in plan])
        # Before the arm is given to us nothing is counted: nobody carries it out.
        if observation.task.active:
            self._plan, self._observed_ns = plan, observation.stamp_wall_ns
        # The last step of a longer chunk has not begun when the chunk is sent.
        done = asked.motion is None or (asked.steps is not None and last - begun <= 1.0)
        return ActionSteps(given, done)

    def _reached(self, stamp_ns: int) -> tuple[float, float]:
        """Steps and way that were asked for until this observation: the next chunk begins there.

        As the command node counts: by time, and the first step at least.
        """
        passed = (stamp_ns - self._observed_ns) / int(self.spec.action.dt_s * 1e9)
        passed = min(max(passed, 1.0), len(self._plan) - 1.0)
        index = int(passed)
        if index + 1 >= len(self._plan):
            return self._plan[-1]
        (steps, way), (next_steps, next_way) = self._plan[index : index + 2]
        share = passed - index
        return steps + share * (next_steps - steps), way + share * (next_way - way)
