# /// script
# requires-python = ">=3.11"
# dependencies = ["numpy", "msgspec", "eclipse-zenoh", "vla-zenoh-physicalai"]
# ///
"""A client of Intel's physicalai as a worker: it sees our arm as a robot of its own.

The worker owns the robot `name` on this computer: it replies to ``metadata``, publishes ``state``
with every inference, and gives the newest action as its answer. What the arm does with it is up to
activation, limits and watchdogs, as with every worker.
"""

from __future__ import annotations

import socket
import time
from typing import Any

import numpy as np

from vla_zenoh.errors import CodecError, PeerError, WorkerError
from vla_zenoh.policy import ActionSpec, ActionSteps, ModelSpec, Observation, ObservationSpec
from vla_zenoh.policy.options import number, one_of, yes_no
from vla_zenoh.profile import load_profile
from vla_zenoh.types import FloatArray
from vla_zenoh_physicalai import wire
from vla_zenoh_physicalai.layout import Layout, Unit

GRIPPER = "gripper"
UNITS: tuple[Unit, ...] = ("normalised", "degrees", "radians")
MAX_EARLY_S = 0.1


class PhysicalAiClient:
    """A client of physicalai; see the module.

    Args:
        profile: of the robot: its joints and their ends.
        name: under which its clients find the arm.
        units: of the joints: ``normalised`` (-100 to 100 from end to end, as physicalai's SO-101),
            ``degrees`` or ``radians``. The gripper is 0 (shut) to 100.
        gripper: whether the last number is the gripper: yes or no.
        dt_s: duration of a step: how far apart actions come.
        silence_s: an older action is not used, and the worker has no answer.
    """

    def __init__(
        self,
        profile: str,
        name: str = "arm",
        units: str = "normalised",
        gripper: str = "yes",
        dt_s: str = "0.1",
        silence_s: str = "0.5",
    ) -> None:
        robot = load_profile(profile)
        joints, self._name = robot.robot.arm_joints, name
        grips = yes_no("gripper", gripper)
        self._names = (*joints, GRIPPER) if grips else joints
        unit: Unit = UNITS[UNITS.index(one_of("units", units, UNITS))]
        self._layout = Layout(
            *(robot, self._names, unit), joints=joints, gripper=GRIPPER if grips else ""
        )
        self._class, self._joints = f"vla_zenoh.{unit}", joints
        if grips:
            robot.robot.require_gripper("gripper=yes of this model")
        self._max_width_m = robot.robot.max_width_m
        self._silence_s = number("silence_s", silence_s)
        wire.key(name, "state")
        self._session: Any = None
        self._action: tuple[FloatArray, float | None] | None = None
        self._sent_s, self._rejected, self._complaint = float("-inf"), 0, ""
        self._began_s = float("-inf")
        self.spec = ModelSpec(
            name="physicalai_client",
            observation=ObservationSpec(state=("joint", "gripper"), prompt=False),
            action=ActionSpec(
                horizon=1,
                dt_s=number("dt_s", dt_s),
                kind="absolute",
                space="joint",
                joints=joints,
                gripper="absolute_m" if grips else "none",
            ),
        )

    def load(self) -> None:
        """Listen as the owner of the robot, on this computer alone."""
        from vla_zenoh_physicalai import link  # zenoh, which a check of models does not need

        self._newest = link.newest
        where = wire.local_endpoint(self._name)
        try:
            session = self._session = link.open_session("peer", listen=where)
        except link.ZError as error:
            raise WorkerError(
                f"{where} is taken: does another owner have the robot {self._name!r}? Set name "
                f"({error})"
            ) from error
        key, count = wire.key(self._name, "metadata"), len(self._names)
        said = wire.encode(
            wire.Metadata(
                *(wire.VERSION, self._name, self._class, socket.gethostname()),
                *(self._names, count, count),
            )
        )
        self._metadata = session.declare_queryable(key, lambda query: query.reply(key, said))
        self._actions = link.subscribe(session, self._name, "action")
        self._states = link.declare_publisher(session, self._name, "state")

    def reset(self) -> None:
        """Forget what was put before the episode: it must not move the arm now."""
        self._action, self._began_s = None, time.monotonic()

    def infer(self, observation: Observation) -> ActionSteps:
        """Publish the state, and answer with the newest action.

        Raises:
            PeerError: no client has put a valid action lately.
        """
        self._publish(observation)
        self._take()
        now_s = time.monotonic()
        if self._action is None or now_s - self._sent_s > self._silence_s:
            words = f"; {self._complaint}" if self._complaint else ""
            raise PeerError(
                "silent",
                f"no client of {self._name!r} put a valid action in the last "
                f"{self._silence_s:g} s{words}",
            )
        position_rad, width_m = self._action
        step = position_rad if width_m is None else np.append(position_rad, width_m)
        return ActionSteps([step], raw={"rejected_actions": self._rejected})

    def _publish(self, observation: Observation) -> None:
        joint, gripper = observation.joint, observation.gripper
        assert joint is not None
        assert gripper is not None
        order = [joint.names.index(name) for name in self._joints]
        vector = wire.array_of(self._layout.theirs(joint.position_rad[order], gripper.width_m))
        age_s = (time.time_ns() - observation.stamp_wall_ns) / 1e9
        self._states.put(wire.encode(wire.State(vector, vector, time.monotonic() - age_s)))

    def _take(self) -> None:
        """Keep the newest action, unless it is wrong."""
        now_s = time.monotonic()
        try:
            payload = self._newest(self._actions)
            if payload is None:
                return
            vector, sent_s = wire.decode_action(payload, self._layout.count)
            if not self._began_s < sent_s <= now_s + MAX_EARLY_S:
                raise CodecError("stale", f"ts {sent_s:.3f} is not of this episode")
        except CodecError as error:
            self._rejected, self._complaint = self._rejected + 1, f"action: {error}"
            return
        self._action, self._sent_s, self._complaint = self._layout.ours(vector), sent_s, ""

    def close(self) -> None:
        """Own the robot no longer."""
        if self._session is not None:
            self._session.close()
