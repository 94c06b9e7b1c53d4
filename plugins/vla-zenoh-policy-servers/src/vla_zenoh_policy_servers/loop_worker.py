"""The worker whose chunks are the actions of a loop of others, one step each."""

from __future__ import annotations

import threading
import time

import numpy as np
import zenoh

from vla_zenoh.bus.buffers import Wake
from vla_zenoh.nodes.worker.robot_session import RobotSession
from vla_zenoh.policy import ActionSpec, ActionSteps, ModelSpec, Observation, ObservationSpec
from vla_zenoh.profile import Profile
from vla_zenoh.types import FloatArray

LOOK_S, NAP_S = 0.02, 0.002
STAND_S = 0.1
"""After this time without an action the last one is repeated, so that the arm stands there."""


class LoopWorker:
    """Publishes each action of a loop when it is sent; while there is none the arm stands.

    Such a loop pauses, as where it saves an episode: the arm then keeps its last goal, as motors
    with a controller of their own do. When the process ends the deadman brakes it.

    Args:
        session: with the rights of a worker of this name.
        action: what a step means.
        model: name in its spec.
    """

    def __init__(
        self,
        profile: Profile,
        session: zenoh.Session,
        name: str,
        action: ActionSpec,
        model: str = "lerobot",
    ) -> None:
        self.name = name
        self.spec = ModelSpec(
            name=model,
            observation=ObservationSpec(
                cameras=(),
                state=("joint", "gripper"),
                prompt=False,
                max_age_s=profile.timing.max_observation_age_s,
            ),
            action=action,
        )
        self._joints = profile.robot.arm_joints
        self._max_width_m = profile.robot.require_gripper("its last number").max_width_m
        self._session = RobotSession(
            profile, session, self, name, images="raw", host=None, changed=Wake()
        )
        self._session.complaint = ""
        # More than `state_timeout_s`, with which the guard decides when late states brake the arm.
        timing = profile.timing
        self._patience_s = max(timing.state_timeout_s, timing.max_observation_age_s)
        self._goal: FloatArray | None = None
        self._sent_s = 0.0
        self._lock, self._end = threading.Lock(), threading.Event()
        self._thread = threading.Thread(target=self._stand, name="loop worker", daemon=True)
        self._thread.start()

    def infer(self, observation: Observation) -> ActionSteps:
        """The last action; before the first one, and before the arm follows, where it is."""
        leads = observation.task.active and observation.task.worker == self.name
        if self._goal is None or not leads:
            joint, gripper = observation.joint, observation.gripper
            assert joint is not None
            assert gripper is not None
            measured = dict(zip(joint.names, joint.position_rad, strict=True))
            opening = gripper.kept_width_m / self._max_width_m
            self._goal = np.array([*(measured[name] for name in self._joints), min(opening, 1.0)])
        return ActionSteps(self._goal)

    def send(self, step: FloatArray) -> bool:
        """Publish a step as a chunk; False: no state within ``timing.max_observation_age_s``."""
        give_up_s = time.monotonic() + self._patience_s
        with self._lock:
            self._goal = step
            while not self._publish():
                if time.monotonic() > give_up_s:
                    return False
                time.sleep(NAP_S)
        return True

    @property
    def ready(self) -> bool:
        """Whether a chunk was published."""
        return self._sent_s > 0.0

    @property
    def complaint(self) -> str:
        """Why no chunk can be published; empty if one can, or nothing is wrong."""
        return self._session.complaint

    def close(self) -> None:
        """End the worker."""
        self._end.set()
        self._thread.join()
        self._session.close()

    def _publish(self) -> bool:
        observation = self._session.observe()
        if observation is None:
            return False
        now_ns = self._session.node.clock.wall_ns()
        self._session.publish(observation, self.infer(observation), (now_ns, now_ns, now_ns), 1)
        self._sent_s = time.monotonic()
        return True

    def _stand(self) -> None:
        while not self._end.wait(LOOK_S):
            with self._lock:
                if time.monotonic() - self._sent_s > STAND_S:
                    self._publish()
                else:
                    self._session.poll()
                self._session.report()
