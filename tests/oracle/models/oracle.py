# /// script
# requires-python = ">=3.11"
# dependencies = ["numpy"]
# ///
"""Puts bricks in the box by cheating: it listens to where the objects truly are.

No model, but a proof that whoever does the task is said to have done it.
``VLA_ZENOH_PATH=tests/oracle vla-zenoh bench task --model oracle --family put``
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import zenoh

from vla_zenoh.bus.buffers import LatestSample
from vla_zenoh.bus.session import open_session
from vla_zenoh.codec import records
from vla_zenoh.lab.tasks.order import COLOURS, brick
from vla_zenoh.policy import (
    ActionSpec,
    ActionSteps,
    CameraSpec,
    ModelSpec,
    Observation,
    ObservationSpec,
)
from vla_zenoh.profile import load_profile
from vla_zenoh.types import ObjectPoses

STEP_M, STEP_RAD = 0.04, 0.18
OPEN_M, SHUT_M, HELD_M = 0.08, 0.0, 0.037
HOVER_M, CARRY_M, RELEASE_M, RETREAT_M = 0.10, 0.15, 0.09, 0.20
NEAR_M, OVER_BOX_M, IN_BOX_M = 0.004, 0.012, 0.05
GRIP_ABOVE_M, LOWEST_M = 0.002, 0.0135


class Oracle:
    """See the module.

    Args:
        profile: of the robot, for the address of its router and its keys.
    """

    example_prompts = ("put the red brick in the box",)

    def __init__(self, profile: str = "panda_sim") -> None:
        self.spec = ModelSpec(
            name="oracle",
            # The picture is not looked at: it is waited for, as a model would.
            observation=ObservationSpec(cameras=(CameraSpec(camera="front"),)),
            action=ActionSpec(horizon=1, dt_s=0.1, kind="absolute", gripper="absolute_m"),
        )
        self._profile = load_profile(profile)
        self._truth = LatestSample()
        self._objects: ObjectPoses | None = None
        self._session: Any = None

    def load(self) -> None:
        self._session = open_session(self._profile.session, identity="worker-oracle")
        handler = zenoh.handlers.Callback(self._truth, indirect=False)
        key = self._profile.keys.sim_objects
        self._subscriber = self._session.declare_subscriber(key, handler)

    def close(self) -> None:
        self._session.close()

    def infer(self, observation: Observation) -> ActionSteps:
        assert observation.pose is not None
        assert observation.gripper is not None
        arrival = self._truth.pop()
        if arrival is not None:
            self._objects = records.decode(ObjectPoses, arrival.sample.payload.to_bytes())
        position = observation.pose.position_m
        x, y, z, w = observation.pose.quat_xyzw
        yaw = math.atan2(2 * (x * y + w * z), 1 - 2 * (y * y + z * z))
        target = next((c for c in COLOURS if c in observation.prompt.split()), None)
        if self._objects is None or target is None:
            return self._step(position, yaw, position, 0.0, observation.gripper.width_m)
        goal, turn, width_m = self._wish(position, yaw, observation.gripper.width_m, target)
        return self._step(position, yaw, goal, turn, width_m)

    def _wish(
        self, tcp: np.ndarray, yaw: float, width_m: float, target: str
    ) -> tuple[np.ndarray, float, float]:
        """Where to go, how far to turn, how wide to open: a function of the present alone."""
        assert self._objects is not None
        index = {name: i for i, name in enumerate(self._objects.names)}
        place = self._objects.position_m[index[brick(target)]]
        box = self._objects.position_m[index["box"]]
        to_box = np.abs(place - box)[:2].max()
        if to_box < IN_BOX_M and place[2] < 0.05:
            return np.array([*tcp[:2], RETREAT_M]), 0.0, OPEN_M
        apart = place - tcp
        aside = float(np.hypot(apart[0], apart[1]))
        if aside < 0.02 and abs(apart[2]) < 0.02 and width_m < HELD_M:
            if to_box < OVER_BOX_M:
                let_go = tcp[2] < RELEASE_M + 0.01
                return np.array([*box[:2], RELEASE_M]), 0.0, OPEN_M if let_go else SHUT_M
            over = box[:2] if tcp[2] > CARRY_M - 0.03 else tcp[:2]
            return np.array([*over, CARRY_M]), 0.0, SHUT_M
        x, y, z, w = self._objects.quat_xyzw[index[brick(target)]]
        brick_yaw = math.atan2(2 * (x * y + w * z), 1 - 2 * (y * y + z * z))
        turn = (brick_yaw - yaw + math.pi / 4) % (math.pi / 2) - math.pi / 4
        grip_m = max(place[2] + GRIP_ABOVE_M, LOWEST_M)
        slack = 1.0 if width_m > 0.07 else 3.0
        if aside < NEAR_M * slack and abs(turn) < 0.1 * slack:
            there = abs(tcp[2] - grip_m) < 0.004 * slack
            return np.array([*place[:2], grip_m]), turn, SHUT_M if there else OPEN_M
        return np.array([*place[:2], max(HOVER_M, place[2] + 0.05)]), turn, OPEN_M

    @staticmethod
    def _step(
        tcp: np.ndarray, yaw: float, goal: np.ndarray, turn: float, width_m: float
    ) -> ActionSteps:
        way = goal - tcp
        way = way * min(1.0, STEP_M / max(float(np.linalg.norm(way)), 1e-9))
        turned = yaw + min(max(turn, -STEP_RAD), STEP_RAD)
        return ActionSteps([[*(tcp + way), math.pi, 0.0, turned, max(width_m, 0.0)]])
