"""A leader arm: the arm follows another one of its kind that a person moves by hand.

The leader is a class of the robot contract (`vla_zenoh.robot`), of which only `read` is called. It
need not stand as the arm does: when the person takes over, the difference of the two is noted, and
the arm follows the leader at that distance until it is given back. So nothing jumps, and nothing
drifts. An arm that takes joints follows the leader's joints, one that takes poses its TCP.
"""

from __future__ import annotations

import math
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np

from vla_zenoh.errors import NodeError, PeerError, in_words
from vla_zenoh.kinematics.kinematics import make_kinematics
from vla_zenoh.kinematics.so3 import orthonormal, pose_of, quat_from_rotation
from vla_zenoh.policy import ActionSpec, ActionSteps, ModelSpec, Observation, ObservationSpec
from vla_zenoh.policy.loader import make_robot
from vla_zenoh.policy.meaning import wrapped
from vla_zenoh.policy.spec import PERSON
from vla_zenoh.profile import Profile
from vla_zenoh.robot import numbers
from vla_zenoh.types import FloatArray
from vla_zenoh_teleop.policy import COVER_S, DT_S, HORIZON

READ_S = 0.01
KEPT_S = 2.0
"""Of the leader's path; a chunk asks for the last period of the rate."""
LOST_S = 0.5
"""A leader that reads nothing new for this long is gone."""


class LeaderArm:
    """A leader that is read on a thread of its own.

    Args:
        joints: number of the arm's joints, which is the leader's.

    Raises:
        WorkerError: no such file or class.
        NodeError: it cannot be connected to.
    """

    def __init__(self, path: Path, options: Mapping[str, str], joints: int) -> None:
        self.name = path.name
        self._robot, self._joints = make_robot(path, options), joints
        try:
            getattr(self._robot, "connect", lambda: None)()
        except Exception as error:
            raise NodeError(f"leader {self.name}: connect: {in_words(error)}") from error
        self._path: deque[LeaderState] = deque(maxlen=round(KEPT_S / READ_S))
        self._lock, self._end, self._why = threading.Lock(), threading.Event(), ""
        self._thread = threading.Thread(target=self._read_all, name="leader", daemon=True)
        self._thread.start()

    def _read_all(self) -> None:
        while not self._end.wait(READ_S):
            try:
                reading = self._robot.read()
                if reading is None:
                    continue
                position_rad = numbers("position_rad", reading.position_rad, self._joints)
                if np.isfinite(position_rad).all():
                    now = LeaderState(time.monotonic(), position_rad, reading.width_m)
                    with self._lock:
                        self._path.append(now)
            except Exception as error:
                self._why = in_words(error)
                return

    def path(self) -> list[LeaderState]:
        """Its last seconds, oldest first. Raises PeerError: it is gone."""
        with self._lock:
            path = list(self._path)
        silent = not path or time.monotonic() - path[-1].time_s > LOST_S
        if self._why or silent:
            why = self._why or "it reads nothing new"
            raise PeerError("device_lost", f"leader {self.name}: {why}")
        return path

    def close(self) -> None:
        self._end.set()
        self._thread.join()
        getattr(self._robot, "close", lambda: None)()


GRIPPER_M = 0.01
"""The gripper follows once the leader's was moved by this much: to take over drops nothing."""


class LeaderState(NamedTuple):
    """Of a leader at one moment.

    Args:
        time_s: monotonic clock.
        position_rad: (n,) in the order of the arm's joints.
        width_m: of its gripper; None: not measured.
    """

    time_s: float
    position_rad: FloatArray
    width_m: float | None


class LeaderPolicy:
    """A `Policy` whose chunks are the path of a leader arm.

    A chunk asks for where the leader was in the last period of the rate, so the arm does what the
    leader did, that much later.

    Args:
        path: the leader's last seconds, oldest first, at least one state.
    """

    example_prompts = ("by hand",)

    def __init__(
        self,
        profile: Profile,
        name: str,
        path: Callable[[], list[LeaderState]],
        now_s: Callable[[], float],
    ) -> None:
        in_joints = profile.robot.command == "joint"
        self._follow = _Joints(profile.robot.arm_joints) if in_joints else _Tcp(profile)
        self.spec = ModelSpec(
            name=PERSON,
            observation=ObservationSpec(
                cameras=(), state=(self._follow.state, "gripper"), prompt=False
            ),
            action=self._follow.action.model_copy(
                update={"gripper": "none" if profile.robot.gripper is None else "absolute_m"}
            ),
        )
        self._name, self._path, self._now_s = name, path, now_s
        self._grips = profile.robot.gripper is not None
        self._max_width_m = profile.robot.max_width_m
        self._leads = False
        self._width_m = 0.0
        self._leader_width_m: float | None = None

    def infer(self, observation: Observation) -> ActionSteps:
        """The leader's last path at the distance noted when it took over; before, a standstill.

        Raises:
            PeerError: the leader is gone.
        """
        path, gripper = self._path(), observation.gripper
        assert gripper is not None
        period_s = 1 / observation.rate_hz
        count = min(math.ceil((period_s + COVER_S) / DT_S - 1e-9), HORIZON)
        leads = observation.task.active and observation.task.worker == self._name
        if not (leads and self._leads):
            # What the leader did before is not meant.
            self._follow.begin(observation, path[-1].position_rad)
            self._width_m, self._leader_width_m = gripper.kept_width_m, path[-1].width_m
            path = path[-1:]
        self._leads = leads
        times_s = self._now_s() - period_s + DT_S * np.arange(1, count + 1)
        stamps = np.array([state.time_s for state in path])
        # No joint turns by half a turn between two readings: the leader wraps its numbers there.
        columns = np.unwrap([state.position_rad for state in path], axis=0).T
        joints_rad = np.column_stack([np.interp(times_s, stamps, column) for column in columns])
        width_m = self._width(path[-1].width_m) if leads else self._width_m
        width = [width_m] if self._grips else []
        steps = [[*self._follow.step(each), *width] for each in joints_rad]
        return ActionSteps(steps, raw={"leader_rad": path[-1].position_rad.tolist()})

    def _width(self, leader_m: float | None) -> float:
        """Of the gripper, which follows the leader's from when that is moved."""
        before_m = self._leader_width_m
        if leader_m is not None and (before_m is None or abs(leader_m - before_m) > GRIPPER_M):
            self._leader_width_m = None
            self._width_m = min(max(leader_m, 0.0), self._max_width_m)
        return self._width_m

    def describe(self) -> str:
        return f"leader arm, {'joints' if self._follow.state == 'joint' else 'TCP'}"


class _Joints:
    """Follows the leader's joints."""

    state: Literal["joint", "pose"] = "joint"

    def __init__(self, joints: Sequence[str]) -> None:
        self._joints = tuple(joints)
        self.action = ActionSpec(
            horizon=HORIZON, dt_s=DT_S, kind="absolute", space="joint", joints=self._joints
        )
        self._apart_rad: FloatArray = np.zeros(len(self._joints))
        self._endless = np.zeros(len(self._joints), bool)

    def begin(self, observation: Observation, leader_rad: FloatArray) -> None:
        """Note how far the arm is from the leader, (n,) rad."""
        joint = observation.joint
        assert joint is not None
        measured = dict(zip(joint.names, joint.position_rad, strict=True))
        self._endless = np.isin(self._joints, joint.endless)
        self._apart_rad = np.array([measured[name] for name in self._joints]) - leader_rad

    def step(self, leader_rad: FloatArray) -> FloatArray:
        """(n,) joints of the arm for those of the leader."""
        target_rad = leader_rad + self._apart_rad
        return np.where(self._endless, wrapped(target_rad), target_rad)


class _Tcp:
    """Follows the leader's TCP, from its joints by the arm's kinematics."""

    state: Literal["joint", "pose"] = "pose"

    def __init__(self, profile: Profile) -> None:
        self._kinematics = make_kinematics(profile)
        self.action = ActionSpec(horizon=HORIZON, dt_s=DT_S, kind="absolute", rotation="quaternion")
        self._moved_m: FloatArray = np.zeros(3)
        self._turned: FloatArray = np.eye(3)

    def begin(self, observation: Observation, leader_rad: FloatArray) -> None:
        """Note how the arm's TCP stands to the leader's."""
        assert observation.pose is not None
        here, leader = pose_of(observation.pose), self._kinematics.forward(leader_rad)
        self._moved_m = here.position_m - leader.position_m
        self._turned = leader.rotation.T @ here.rotation

    def step(self, leader_rad: FloatArray) -> FloatArray:
        """(7,) pose of the arm's TCP for joints of the leader."""
        leader = self._kinematics.forward(leader_rad)
        turn = orthonormal(leader.rotation @ self._turned)
        return np.concatenate([leader.position_m + self._moved_m, quat_from_rotation(turn)])
