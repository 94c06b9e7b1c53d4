"""Driver of a robot in a Python file: a class with `read` and `move`, see `vla_zenoh.robot`."""

from __future__ import annotations

import operator
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from vla_zenoh.bus.metrics import RateMeter
from vla_zenoh.bus.node import Node
from vla_zenoh.errors import NodeError, ProfileError, in_words
from vla_zenoh.interop.python_reading import MAX_WORDS, Fault, PythonReading
from vla_zenoh.policy.loader import make_robot
from vla_zenoh.profile import Profile
from vla_zenoh.robot import Reading
from vla_zenoh.robots.command_follower import CommandFollower
from vla_zenoh.robots.driver import DriverStatus, Measurement, RobotDriver, command_of
from vla_zenoh.sanitize import one_line
from vla_zenoh.types import Event, GripperCommand
from vla_zenoh.types.commands import JointReference, PoseReference

CONNECTING_S = 0.2
FUTURE_NS = 100_000_000


class PythonDriver(RobotDriver):
    """The robot class in the file that the profile names in ``arm.file``.

    What the class raises becomes a `NodeError` with the names of file and method.

    Args:
        profile: the effective profile, with its section arm.

    Raises:
        ProfileError: the section arm is missing.
        WorkerError: the file is missing, or has no robot class.
    """

    name = "arm"

    def __init__(self, profile: Profile) -> None:
        super().__init__(profile)
        if profile.arm is None:
            raise ProfileError(
                f"profile {profile.name!r} has no section arm, which names a Python file: "
                "arm: {file: my_arm.py}, with robot.driver: arm"
            )
        path = Path(profile.arm.file).expanduser()
        self._robot = make_robot(path, profile.arm.options)
        self._file = path.name
        self._reading = PythonReading(profile, self.kinematics)
        self._fault = Fault()
        self._rate = RateMeter()
        self._asked_m = profile.robot.gripper.max_width_m
        self._width_m: float | None = None
        if self._method("grip") is None:
            self.no_gripper = f"{self._file} has no method grip"
        self.silent_why = f"{self._file}: read gives nothing new"
        self.stalled_hint = f"; does {self._file} wait for something?"

    def attach(self, node: Node, follower: CommandFollower | None) -> None:
        """Keep the node."""
        self._node = node

    # -- calls --------------------------------------------------------------------------------
    def _method(self, name: str) -> Callable[..., Any] | None:
        method = getattr(self._robot, name, None)
        return method if callable(method) else None

    def _call(self, name: str, *given: Any) -> Any:
        method = self._method(name)
        if method is None:
            return None
        try:
            return method(*given)
        except Exception as error:
            words = one_line(in_words(error), MAX_WORDS)
            raise NodeError(f"{self._file}: {name}: {words}") from error

    def connect(self) -> None:
        """Connect; the status says so meanwhile, since a silent node would count as hung."""
        self._node.publish_status("connecting", now=True)
        done = threading.Event()

        def report() -> None:
            while not done.wait(CONNECTING_S):
                self._node.publish_status("connecting")

        reporter = threading.Thread(target=report, name="connecting", daemon=True)
        reporter.start()
        try:
            self._call("connect")
        finally:
            done.set()
            reporter.join()

    def read(self, mono_ns: int) -> Measurement | None:
        """The robot's newest reading; an invalid one is rejected, but its fault counts."""
        reading = self._call("read")
        if reading is None:
            return None
        if not isinstance(reading, Reading):
            given = type(reading).__name__
            raise NodeError(f"{self._file}: read gave {given}, wanted a Reading")
        if self._fault.say(reading.fault, mono_ns):
            self.fault = self._fault.words
            self.away = "fault" if self.fault else ""
            if self.fault:
                self._node.emit(Event("error", "fault", "robot_fault", self.fault))
        try:
            measured_ns = _measured_ns(reading)
            if measured_ns == self.measured_ns:
                return None  # the same again: the robot is slower than this loop
            stamp_ns = self._node.clock.wall_at(measured_ns)
            valid = self._reading.take(reading, stamp_ns, self._asked_m)
        except (TypeError, ValueError) as error:
            reason = getattr(error, "reason", "invalid")
            self._node.reject(reason, f"{self._file}: read: {one_line(error, MAX_WORDS)}")
            return None
        self.measured_ns, self._width_m = measured_ns, valid.gripper.width_m
        self._rate.tick()
        return Measurement(*valid)

    def move(self, reference: PoseReference | JointReference, now_ns: int) -> None:
        """Give the robot its set-point."""
        self._call("move", command_of(reference, self.profile.robot.arm_joints))
        self._node.counters["arm.commands_given"] += 1

    def grip(self, command: GripperCommand, now_ns: int) -> None:
        """Ask for an opening."""
        self._asked_m = command.width_m
        self._call("grip", command.width_m, command.speed_m_s, command.force_n)

    def close(self) -> None:
        """Disconnect."""
        self._call("close")

    def status(self) -> DriverStatus:
        """File, fault and width."""
        width_m = self._asked_m if self._width_m is None else self._width_m
        return DriverStatus(
            {"file": self._file, "fault": self.fault, "width_m": width_m},
            rates_hz={"readings": self._rate.rate_hz},
        )


def _measured_ns(reading: Reading) -> int:
    """Time of the measurement on the monotonic clock.

    Raises:
        TypeError: it is not a whole number.
        ValueError: it is in the future.
    """
    now_ns = time.monotonic_ns()
    if reading.measured_ns is None:
        return now_ns
    measured_ns = operator.index(reading.measured_ns)
    if measured_ns > now_ns + FUTURE_NS:
        raise ValueError("measured_ns is in the future; it is of time.monotonic_ns()")
    return measured_ns
