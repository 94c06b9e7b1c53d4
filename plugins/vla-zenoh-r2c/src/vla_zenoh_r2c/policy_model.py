# /// script
# requires-python = ">=3.11"
# dependencies = ["numpy", "eclipse-zenoh", "protobuf>=5", "vla-zenoh-r2c"]
# ///
"""A policy that answers over Huawei's R2C as a worker: our arm is a robot of its own.

The worker publishes an observation with an id of its own and waits for the actions that repeat it.
What the arm does with them is up to activation, limits and watchdogs, as with every worker.
"""

from __future__ import annotations

import time
from typing import Any

import numpy as np

from vla_zenoh.errors import PeerError
from vla_zenoh.policy import (
    ActionSpec,
    ActionSteps,
    CameraSpec,
    ModelSpec,
    Observation,
    ObservationSpec,
)
from vla_zenoh.policy.options import number
from vla_zenoh.profile import load_profile
from vla_zenoh.types import FloatArray, Image
from vla_zenoh_r2c import wire
from vla_zenoh_r2c.declared import Numbers, read_robot
from vla_zenoh_r2c.pictures import write_image
from vla_zenoh_r2c.question import Question

MAX_WAITING = 8
QUIET_S = 5.0
"""The policy is not asked for this long after an observation was answered twice."""


class R2cPolicy:
    """A policy behind R2C; see the module.

    Args:
        robot: file that declares our arm as its robot, see `vla_zenoh_r2c.declared`.
        profile: of the arm.
        endpoint: of the router that the policy reaches; empty: the profile's.
        timeout_s: for each answer.
    """

    def __init__(self, robot: str, profile: str, endpoint: str = "", timeout_s: str = "1") -> None:
        declared = self._robot = read_robot(robot)
        loaded = self._profile = load_profile(profile)
        loaded.require_one_arm("the worker r2c_policy")
        self._numbers = numbers = Numbers(declared, loaded)
        self._joints, self._endpoint = loaded.robot.arm_joints, endpoint
        self._timeout_s = number("timeout_s", timeout_s, least=0.01)
        self._session: Any = None
        self._question = Question(numbers, declared.horizon)
        self._quiet_until_s = 0.0
        self.spec = ModelSpec(
            name="r2c_policy",
            observation=ObservationSpec(
                cameras=tuple(CameraSpec(camera=name) for name in declared.cameras),
                state=("joint", "gripper") if numbers.grips else ("joint",),
            ),
            action=ActionSpec(
                horizon=declared.horizon,
                dt_s=1.0 / declared.step_hz,
                kind="absolute",
                space="joint",
                joints=self._joints,
                gripper="absolute_m" if numbers.grips else "none",
            ),
        )

    def load(self) -> None:
        """Connect to the router."""
        from vla_zenoh.bus.buffers import CallbackRing, Wake
        from vla_zenoh_r2c import link  # zenoh, which a check of models does not need

        project, device = self._robot.project, self._robot.device
        self._session = link.connected(self._profile, self._endpoint)
        self._arrival = Wake()
        self._answers = CallbackRing(MAX_WAITING, wire.MAX_ACTION_BYTES, self._arrival)
        link.listen(self._session, wire.actions_key(project, device), self._answers)
        self._questions = link.declare(self._session, wire.observations_key(project, device))

    def infer(self, observation: Observation) -> ActionSteps:
        """Ask the policy.

        Raises:
            PeerError: no answer in time, or none that can be used; says why.
        """
        self._take()
        self._heed_others()
        asked = self._question.ask(time.time_ns() // 1_000_000)
        self._questions.put(wire.encode_observation(self._asked(asked, observation)))
        until_s = time.monotonic() + self._timeout_s
        while (left_s := until_s - time.monotonic()) > 0:
            self._arrival.wait(left_s)
            found = self._take()
            if found is not None:
                joints_rad, width_m = self._numbers.ours(found)
                width_m = np.clip(width_m, 0.0, self._profile.robot.max_width_m)
                parts = (joints_rad, width_m[:, None]) if self._numbers.grips else (joints_rad,)
                steps = np.concatenate(parts, axis=1)
                return ActionSteps(steps, raw={"ignored_answers": self._question.ignored})
        words = f"; {self._question.complaint}" if self._question.complaint else ""
        raise PeerError(
            "peer_timeout",
            f"no policy answered observation {asked} of {self._robot.project}/"
            f"{self._robot.device} within {self._timeout_s:g} s{words}",
        )

    def _take(self) -> FloatArray | None:
        """(H, n) numbers of the answer to the newest question, if it has come."""
        from vla_zenoh.bus.buffers import bytes_of

        for each in self._answers.pop_rejected():
            self._question.ignore(each.why, each.times)
        found: FloatArray | None = None
        for each in self._answers.drain():
            steps = self._question.take(bytes_of(each.sample.payload, wire.MAX_ACTION_BYTES))
            found = found if steps is None else steps
        return found

    def _heed_others(self) -> None:
        """Raise a `PeerError` while two policies answer: the arm would follow both in turn."""
        now_s = time.monotonic()
        if self._question.twice:
            self._quiet_until_s, self._question.twice = now_s + QUIET_S, 0
        if now_s < self._quiet_until_s:
            raise PeerError(
                "second_policy",
                f"an observation of {self._robot.project}/{self._robot.device} was answered twice: "
                f"two policies; asking again in {self._quiet_until_s - now_s:.0f} s",
            )

    def _asked(self, asked: int, observation: Observation) -> wire.Seen:
        joint, gripper = observation.joint, observation.gripper
        assert joint is not None
        order = [joint.names.index(name) for name in self._joints]
        width_m = np.array(gripper.opening_m if gripper is not None else 0.0)
        return wire.Seen(
            stamp_ms=observation.stamp_wall_ns // 1_000_000,
            id=asked,
            task=observation.prompt,
            images={
                camera.name: write_image(camera, Image(observation.images[name]))
                for name, camera in self._robot.cameras.items()
            },
            names=self._numbers.order,
            position=self._numbers.theirs(joint.position_rad[order], width_m),
        )

    def close(self) -> None:
        """Leave the router."""
        if self._session is not None:
            self._session.close()
