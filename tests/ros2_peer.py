"""A ROS 2 robot as a bridge shows it: plain CDR on keys that are topic names, and queryables.

`Ros2Peer` is the other side of the node ``ros2`` for tests: no bridge and no DDS, but the wire form
of zenoh-bridge-ros2dds or of rmw_zenoh, spelled out here by hand. `KinematicPanda` is a robot on it
that is always exactly where it was told to be.
"""

from __future__ import annotations

import struct
import threading
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import zenoh
from panda_arm import ARM_JOINTS, HOME_RAD, panda
from vla_zenoh_ros2.messages import Messages

from vla_zenoh.kinematics.kinematics import InverseKinematics
from vla_zenoh.kinematics.so3 import Pose, rotation_from_quat

FINGERS = ("panda_finger_joint1", "panda_finger_joint2")
GOAL = "multi_mode_control_msgs/msg/CartesianImpedanceGoal"
GID = bytes(range(16))


def stamp_fields(stamp_ns: int) -> dict[str, int]:
    return {"sec": stamp_ns // 10**9, "nanosec": stamp_ns % 10**9}


class Ros2Peer:
    """Publishes, subscribes, serves and calls as the ROS side does.

    Args:
        session: of its own.
        bridge: ``ros2dds`` or ``rmw_zenoh``.
        distribution: of the robot.
    """

    def __init__(
        self, session: zenoh.Session, bridge: str = "ros2dds", distribution: str = "jazzy"
    ) -> None:
        self.session, self._rmw = session, bridge == "rmw_zenoh"
        self.messages = Messages(distribution)
        self._declared: list[Any] = []
        self._seq = 0

    def key(self, name: str, kind: str) -> str:
        if not self._rmw:
            return name[1:]
        package, room, last = kind.split("/")
        return f"0{name}/{package}::{room}::dds_::{last}_/{self.messages.hash(kind)}"

    def attachment(self) -> bytes | None:
        self._seq += 1
        return struct.pack("<qqB16s", self._seq, time.time_ns(), 16, GID) if self._rmw else None

    def message(self, kind: str, **values: Any) -> Any:
        return self.messages.new(kind, **values)

    def header(self, stamp_ns: int, frame: str = "") -> Any:
        stamp = self.message("builtin_interfaces/msg/Time", **stamp_fields(stamp_ns))
        return self.message("std_msgs/msg/Header", stamp=stamp, frame_id=frame)

    def put(self, name: str, message: Any) -> None:
        self.put_bytes(name, message.__msgtype__, self.messages.encode(message))

    def put_bytes(self, name: str, kind: str, payload: bytes) -> None:
        self.session.put(self.key(name, kind), payload, attachment=self.attachment())

    def on(self, name: str, kind: str, take: Callable[[Any], None]) -> None:
        def handle(sample: zenoh.Sample) -> None:
            if self._rmw:  # a real subscriber drops what has none
                assert sample.attachment is not None
                assert len(sample.attachment.to_bytes()) == 33
            take(self.messages.decode(kind, sample.payload.to_bytes()))

        handler = zenoh.handlers.Callback(handle, indirect=False)
        self._declared.append(self.session.declare_subscriber(self.key(name, kind), handler))

    def serve(self, name: str, kind: str, answer: Callable[[Any], Any]) -> None:
        """`answer` makes a response of a request; None drops the query."""
        key = self.key(name, kind)

        def run(query: zenoh.Query) -> None:
            with query:
                payload = query.payload
                assert payload is not None
                asked = self.messages.decode(f"{kind}_Request", payload.to_bytes())
                response = answer(asked)
                if response is not None:
                    query.reply(
                        key,
                        self.messages.encode(response),
                        attachment=query.attachment.to_bytes() if query.attachment else None,
                    )

        def handle(query: zenoh.Query) -> None:  # an answer may take its time
            threading.Thread(target=run, args=(query,), daemon=True).start()

        handler = zenoh.handlers.Callback(handle, indirect=False)
        self._declared.append(self.session.declare_queryable(key, handler, complete=True))

    def call(self, name: str, kind: str, timeout_s: float = 8.0, **values: Any) -> Any:
        """The response of a service, None without one."""
        request = self.messages.encode(self.message(f"{kind}_Request", **values))
        sent = self.attachment()
        for reply in self.session.get(
            self.key(name, kind), payload=request, attachment=sent, timeout=timeout_s
        ):
            if reply.ok is not None:
                back = reply.ok.attachment
                if sent is not None:
                    assert back is not None
                    assert back.to_bytes()[:8] == sent[:8], "the number of the request comes back"
                    assert back.to_bytes()[16:] == sent[16:], "and its gid"
                return self.messages.decode(f"{kind}_Response", reply.ok.payload.to_bytes())
        return None

    def close(self) -> None:
        for declared in self._declared:
            declared.undeclare()


class KinematicPanda:
    """Joint states at a rate; takes pose goals, which it is at in the next state.

    Args:
        peer: its voice.
        topic: of its pose goals.
        kind: their type, with a field ``pose``.
        rate_hz: of joint states.
        clock_ns: how far its clock is ahead.
    """

    def __init__(
        self,
        peer: Ros2Peer,
        topic: str = "/panda/panda_cartesian_impedance_controller/desired_pose",
        kind: str = GOAL,
        rate_hz: float = 100.0,
        clock_ns: int = 0,
    ) -> None:
        self.peer, self._period_s = peer, 1.0 / rate_hz
        self._kinematics = panda()
        self._solver = InverseKinematics(self._kinematics, HOME_RAD)
        self.joints_rad = HOME_RAD.copy()
        self.width_m = 0.08
        self.goals: list[Any] = []
        self.goal_times_s: list[float] = []
        self._followed: Any = None
        self.clock_ns = clock_ns
        self.silent = self.frozen = False
        self.alter: Callable[[dict[str, Any]], None] = lambda fields: None
        self._stop = threading.Event()
        peer.on(topic, kind, self._take)
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def _take(self, goal: Any) -> None:
        self.goals.append(goal)
        self.goal_times_s.append(time.monotonic())

    @property
    def tcp_m(self) -> np.ndarray[Any, Any]:
        return self._kinematics.forward(self.joints_rad).position_m

    def _follow(self) -> None:
        if not self.goals or self.goals[-1] is self._followed:
            return
        self._followed = self.goals[-1]
        pose = self._followed.pose
        pose = getattr(pose, "pose", pose)
        at, turn = pose.position, pose.orientation
        goal = Pose(
            np.array([at.x, at.y, at.z]),
            rotation_from_quat(np.array([turn.x, turn.y, turn.z, turn.w])),
        )
        found = self._solver.approach(goal, self.joints_rad)
        if found.solved:
            self.joints_rad = found.joints_rad

    def _run(self) -> None:
        stamp_ns = time.time_ns()
        before = self.joints_rad.copy()
        while not self._stop.wait(self._period_s):
            self._follow()
            if not self.frozen:
                now_ns = time.time_ns() + self.clock_ns
                velocity = (self.joints_rad - before) / max((now_ns - stamp_ns) / 1e9, 1e-3)
                stamp_ns, before = now_ns, self.joints_rad.copy()
            if self.silent:
                continue
            fields: dict[str, Any] = {
                "header": self.peer.header(stamp_ns),
                "name": [*ARM_JOINTS, *FINGERS],
                "position": np.array([*before, self.width_m / 2, self.width_m / 2]),
                "velocity": np.array([*velocity, 0.0, 0.0]),
                "effort": np.full(9, np.nan),
            }
            self.alter(fields)
            self.peer.put(
                "/joint_states", self.peer.message("sensor_msgs/msg/JointState", **fields)
            )

    def close(self) -> None:
        self._stop.set()
        self._thread.join()
