"""Somebody else in the robot's ROS graph: sees where the arm is and what it is told, on DDS alone.

What a test says of the motion it says by this, not by what our own nodes report.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from camera_rig import until
from chain import Track
from cyclonedds.sub import DataReader
from numpy.typing import NDArray
from panda_robot import CURRENT_POSE, DESIRED_POSE, JOINT_STATES
from ros_messages import CartesianImpedanceGoal, JointState, PoseStamped
from ros_node import Listener, RosNode

FloatArray = NDArray[np.float64]
STILL_M_S = 0.005
STAND_S = 0.3


@dataclass(frozen=True, slots=True)
class Seen:
    """A pose and when it was seen (wall clock); of the arm it is the robot's own stamp."""

    stamp_ns: int
    position_m: FloatArray


class Witness:
    """See the module.

    Args:
        domain: ROS domain id.
        watch_goals: see what the robot is told, too.
    """

    def __init__(self, domain: int, *, watch_goals: bool = True) -> None:
        self.node = RosNode("witness", domain)
        self._lock = threading.Lock()
        self._poses: list[Seen] = []
        self._goals: list[Seen] = []
        self.fingers_m: list[tuple[int, float]] = []
        node = self.node
        handlers: dict[DataReader[Any], Callable[[Any, int], None]] = {
            node.subscription(CURRENT_POSE, PoseStamped, depth=1000): self._on_pose,
            node.subscription(JOINT_STATES, JointState, depth=1000): self._on_joints,
        }
        if watch_goals:
            goals = node.subscription(DESIRED_POSE, CartesianImpedanceGoal, depth=1000)
            handlers[goals] = self._on_goal
        self._listener = Listener(handlers)

    def close(self) -> None:
        self._listener.close()
        self.node.close()

    def _on_pose(self, message: PoseStamped, arrived_ns: int) -> None:
        p = message.pose.position
        seen = Seen(message.header.stamp.ns, np.array([p.x, p.y, p.z]))
        with self._lock:
            self._poses.append(seen)

    def _on_goal(self, message: CartesianImpedanceGoal, arrived_ns: int) -> None:
        p = message.pose.position
        with self._lock:
            self._goals.append(Seen(arrived_ns, np.array([p.x, p.y, p.z])))

    def _on_joints(self, message: JointState, arrived_ns: int) -> None:
        with self._lock:
            self.fingers_m.append((message.header.stamp.ns, 2 * message.position[-1]))

    def forget(self) -> None:
        """What was seen so far."""
        with self._lock:
            self._poses.clear()
            self._goals.clear()
            self.fingers_m.clear()

    def track(self, since_ns: int = 0) -> Track:
        """How the arm moved; its reference is not to be seen from here and left out."""
        with self._lock:
            seen = [pose for pose in self._poses if pose.stamp_ns >= since_ns]
        stamps = np.array([pose.stamp_ns for pose in seen], np.int64)
        places = np.array([pose.position_m for pose in seen]).reshape(-1, 3)
        twist = np.zeros((len(seen), 6))
        if len(seen) > 1:
            twist[:, :3] = np.gradient(places, stamps / 1e9, axis=0)
        nobody = np.full(len(seen), "panda", object)
        return Track(stamps, places, twist, np.full_like(places, np.nan), nobody)

    def goals(self, since_ns: int = 0) -> tuple[NDArray[np.int64], FloatArray]:
        """(n,) when each pose that the robot was told arrived, and (n, 3) the poses."""
        with self._lock:
            seen = [goal for goal in self._goals if goal.stamp_ns >= since_ns]
        return (
            np.array([goal.stamp_ns for goal in seen], np.int64),
            np.array([goal.position_m for goal in seen]).reshape(-1, 3),
        )

    def position_m(self) -> FloatArray:
        """Where the arm is now."""

        def newest() -> FloatArray | None:
            with self._lock:
                return self._poses[-1].position_m if self._poses else None

        return until("a pose of the robot", lambda: newest() is not None) and newest()

    def width_m(self) -> float:
        """How far the fingers are apart now."""
        with self._lock:
            return self.fingers_m[-1][1] if self.fingers_m else float("nan")

    def speed_m_s(self) -> float:
        """How fast it is, over the last 50 ms."""
        track = self.track(time.time_ns() - 60_000_000)
        if len(track.stamp_ns) < 2:
            return float("nan")
        way = track.position_m[-1] - track.position_m[0]
        return float(np.linalg.norm(way) / (track.stamp_ns[-1] - track.stamp_ns[0]) * 1e9)

    def stands(self) -> bool:
        """Whether the arm has not moved for a while."""
        track = self.track(time.time_ns() - int(STAND_S * 1e9))
        if len(track.stamp_ns) < 5:
            return False
        spread = np.ptp(track.position_m, axis=0)
        return float(spread.max()) < STILL_M_S * STAND_S

    def wait_still(self, timeout_s: float = 10.0) -> FloatArray:
        """Wait until the arm stands; returns where."""
        until("the robot stands", self.stands, timeout_s)
        return self.position_m()
