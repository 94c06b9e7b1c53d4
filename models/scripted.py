# /// script
# requires-python = ">=3.11"
# dependencies = ["numpy"]
# ///
"""Fixed motions by prompt, without any learning: to test the chain.

Prompts, one step per request, as in the thesis this package grew from::

    HARD: go up | go down                    +-0.01 m along z of the base
    HARD: rol(l) left | right                +-0.05 rad about x
    HARD: pitch up | down                    +-0.05 rad about y
    HARD: yaw left | right                   +-0.05 rad about z
    HARD: open gripper | close gripper       +-0.05 m of width
    hold                                     stands still

``HARD: go up x50`` does 50 steps, then reports that it is done and stands still; ``HARD: go down
x50 within 0.1`` turns back before it is further than 0.1 m from its start.
"""

from __future__ import annotations

import math
import random
import time
from itertools import pairwise

import numpy as np

from vla_zenoh.errors import SpecError
from vla_zenoh.lab.demo.scripted_motions import GRIPPER_AXIS, parse_scripted
from vla_zenoh.policy import (
    ActionSpec,
    ActionSteps,
    CameraSpec,
    ModelSpec,
    Observation,
    ObservationSpec,
)
from vla_zenoh.policy.options import number, whole_number
from vla_zenoh.profile import load_profile

ROUNDING = 1e-6
"""A smaller part of a step counts as none."""


class Scripted:
    """Fixed motions by prompt; see the module.

    Args:
        camera: camera whose image every request waits for, as a real model would, or several
            (``front,wrist``); empty: none.
        horizon: steps in one chunk.
        dt_s: duration of a step.
        delay_ms: pretend an inference takes this long.
        jitter: vary that by up to this fraction either way.
        profile: of the robot; one without a gripper gets no number for it.
    """

    def __init__(
        self,
        camera: str = "front",
        horizon: str = "1",
        dt_s: str = "0.1",
        delay_ms: str = "0",
        jitter: str = "0",
        profile: str = "",
    ) -> None:
        self._no_gripper = load_profile(profile).robot.no_gripper if profile else ""
        grips = () if self._no_gripper else ("HARD: close gripper",)
        self.example_prompts = ("HARD: go up", "HARD: yaw left", *grips, "hold")
        cameras = tuple(CameraSpec(camera=name) for name in camera.split(",") if name)
        self.spec = ModelSpec(
            name="scripted",
            observation=ObservationSpec(cameras=cameras, state=("pose", "gripper"), prompt=True),
            action=ActionSpec(
                horizon=whole_number("horizon", horizon),
                dt_s=number("dt_s", dt_s),
                rotation="rpy",
                gripper="none" if self._no_gripper else "delta_m",
            ),
        )
        self._delay_s = number("delay_ms", delay_ms) / 1e3
        self._jitter = number("jitter", jitter)
        self._random = random.Random(0)
        self.reset()

    def reset(self) -> None:
        """Restart the count."""
        self._reached = [(0.0, 0.0)]
        """Steps and distance, before the last chunk and after each of its steps."""

    def infer(self, observation: Observation) -> ActionSteps:
        """The next chunk of the motion the prompt names."""
        asked = parse_scripted(observation.prompt)
        if asked.motion is not None and asked.motion.axis == GRIPPER_AXIS and self._no_gripper:
            raise SpecError(f"{asked.text!r}: {self._no_gripper}")
        if self._delay_s:
            time.sleep(self._delay_s * (1 + self._jitter * self._random.uniform(-1, 1)))
        # Of a chunk that the arm does not follow no step is executed, and none is counted.
        begun, place = self._asked_by(observation.executed_steps or 0.0)
        horizon, limit = self.spec.action.horizon, asked.steps or math.inf
        ends = [min(begun + index, limit) for index in range(1, horizon + 1)]
        # No step twice: the chunk ends with the one that completes the count.
        ends = [ends[0], *(b for a, b in pairwise(ends) if b > a + ROUNDING)]
        steps = np.zeros((len(ends), self.spec.action.dimension), np.float32)
        reached = [(begun, place)]
        for row, end in enumerate(ends):
            before, place = place, asked.offset(end)
            reached.append((end, place))
            if asked.motion is not None:
                steps[row, asked.motion.axis] = place - before
        self._reached = reached
        return ActionSteps(steps, asked.motion is None or ends[-1] >= limit - ROUNDING)

    def _asked_by(self, executed: float) -> tuple[float, float]:
        """Steps and distance requested by so many steps of the last chunk."""
        done = math.floor(executed)
        if done >= len(self._reached) - 1:
            return self._reached[-1]
        (steps, place), (later_steps, later_place) = self._reached[done : done + 2]
        share = executed - done
        return steps + share * (later_steps - steps), place + share * (later_place - place)
