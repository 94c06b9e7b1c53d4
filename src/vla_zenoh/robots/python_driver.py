"""Driver of a robot that is a Python class with `read` and `move`, see `vla_zenoh.robot`.

The class is in a file of the profile, or one of ours: a Franka arm, a UR, a robot of LeRobot.
"""

from __future__ import annotations

import operator
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from vla_zenoh.bus.metrics import RateMeter
from vla_zenoh.errors import NodeError, ProfileError, in_words
from vla_zenoh.policy.loader import make_robot
from vla_zenoh.profile import Profile
from vla_zenoh.robot import Reading
from vla_zenoh.robots.driver import DriverStatus, Measurement, RobotDriver, command_of
from vla_zenoh.robots.python_reading import MAX_WORDS, Fault, PythonReading
from vla_zenoh.sanitize import one_line
from vla_zenoh.types import Event, GripperCommand, GripperState
from vla_zenoh.types.commands import JointReference, PoseReference

FUTURE_NS = 100_000_000
RELEASED_M = 0.002
"""Fingers that are this much wider apart than around an object were opened."""


class PythonDriver(RobotDriver):
    """The robot class that the profile names: in ``arm.file``, or built in.

    Exceptions of the class become a `NodeError` with the names of class and method.

    Args:
        profile: the effective profile.

    Raises:
        ProfileError: the section of the robot is missing.
        WorkerError: the file is missing, or has no robot class.
        MissingExtraError: the library of a built-in class is missing.
    """

    name = "arm"

    def __init__(self, profile: Profile) -> None:
        super().__init__(profile)
        self.robot, self._called = make_arm(profile)
        self._reading = PythonReading(profile, self.kinematics)
        self._fault = Fault()
        self._rate = RateMeter()
        self._asked_m = profile.robot.gripper.max_width_m
        self._width_m: float | None = None
        self._held_m: float | None = None
        """Width at which an object is held."""
        self.recovers = self._method("recover") is not None
        if self._method("grip") is None:
            self.no_gripper = f"{self._called} has no method grip"
        self.silent_why = f"{self._called}: read returns nothing new"
        self.stalled_hint = f"; does {self._called} wait for something?"

    # -- calls --------------------------------------------------------------------------------
    def _method(self, name: str) -> Callable[..., Any] | None:
        method = getattr(self.robot, name, None)
        return method if callable(method) else None

    def _call(self, name: str, *given: Any) -> Any:
        method = self._method(name)
        if method is None:
            return None
        try:
            return method(*given)
        except Exception as error:
            words = one_line(in_words(error), MAX_WORDS)
            raise NodeError(f"{self._called}: {name}: {words}") from error

    def connect(self) -> None:
        """Connect."""
        self._call("connect")

    def recover(self) -> None:
        """Begin to clear the robot's errors."""
        self._call("recover")

    def read(self, mono_ns: int) -> Measurement | None:
        """The robot's newest reading; an invalid one is rejected, but its fault counts."""
        reading = self._call("read")
        if reading is None:
            return None
        if not isinstance(reading, Reading):
            given = type(reading).__name__
            raise NodeError(f"{self._called}: read returned {given}, wanted a Reading")
        if self._fault.say(reading.fault, mono_ns):
            self.fault = self._fault.words
            if self.fault:
                self.report.emit(Event("error", "fault", "robot_fault", self.fault))
        self.idle = reading.idle
        self._set_mode(one_line(reading.mode, MAX_WORDS) or "ready")
        self.away = "fault" if self.fault else "not_ready" if self.gripper_mode != "ready" else ""
        try:
            measured_ns = _measured_ns(reading)
            if measured_ns == self.measured_ns:
                return None  # unchanged: the robot is slower than this loop
            stamp_ns = self.report.clock.wall_at(measured_ns)
            measured = self._reading.take(reading, stamp_ns, self._asked_m)
        except (TypeError, ValueError) as error:
            reason = getattr(error, "reason", "invalid")
            self.report.reject(reason, f"{self._called}: read: {one_line(error, MAX_WORDS)}")
            return None
        gripper = measured.gripper
        assert gripper is not None
        self.measured_ns, self._width_m = measured_ns, gripper.width_m
        if not gripper.moving:  # while the fingers move nobody knows
            self._set_held(gripper)
        self._rate.tick()
        return measured

    def _set_mode(self, mode: str) -> None:
        if mode != self.gripper_mode:
            level = "info" if mode == "ready" else "warning"
            self.report.emit(Event(level, "transition", f"robot:{self.gripper_mode}->{mode}"))
            self.gripper_mode = mode

    def _set_held(self, gripper: GripperState) -> None:
        width_m, held_m = gripper.width_m, self._held_m
        self._held_m = width_m if gripper.holding else None
        if gripper.holding and held_m is None:
            self.report.emit(Event("info", "notice", "grasped", f"{width_m:.3f} m apart"))
        elif held_m is not None and not gripper.holding and width_m < held_m + RELEASED_M:
            why = "the gripper lost its object and was not opened"
            self.report.emit(Event("warning", "notice", "object_lost", why))

    def move(self, reference: PoseReference | JointReference, now_ns: int) -> None:
        """Give the robot its set-point."""
        self._call("move", command_of(reference, self.profile.robot.arm_joints))
        self.report.counters["arm.commands_given"] += 1

    def grip(self, command: GripperCommand, now_ns: int) -> None:
        """Ask for an opening."""
        self._asked_m = command.width_m
        self._call("grip", command.width_m, command.speed_m_s, command.force_n)

    def close(self) -> None:
        """Disconnect."""
        self._call("close")

    def status(self) -> DriverStatus:
        """Class, fault, width, and the robot's own entries."""
        width_m = self._asked_m if self._width_m is None else self._width_m
        return DriverStatus(
            {
                "arm": self._called,
                "fault": self.fault,
                "width_m": width_m,
                **(self._call("status") or {}),
            },
            rates_hz={"readings": self._rate.rate_hz},
        )


def file_of(profile: Profile) -> Path | None:
    """File whose header may ask for a separate environment."""
    if profile.robot.driver == "lerobot":
        return Path(__file__).with_name("lerobot_arm.py")
    if profile.robot.driver == "arm" and profile.arm is not None:
        path = Path(profile.arm.file).expanduser()
        return path if path.is_file() else None  # `make_arm` reports that it is missing
    return None


def make_arm(profile: Profile) -> tuple[Any, str]:
    """The robot of a profile, and its name in messages."""
    if profile.robot.driver == "franka":
        from vla_zenoh.robots.franka.arm import FrankaArm  # its library is an extra

        return FrankaArm(profile), "franka"
    if profile.robot.driver == "ur":
        from vla_zenoh.robots.ur_arm import UrArm

        return UrArm(profile), "ur"
    if profile.robot.driver == "lerobot":
        from vla_zenoh.robots.lerobot_arm import LeRobotArm

        return LeRobotArm(profile), "lerobot"
    if profile.arm is None:
        raise ProfileError(
            f"profile {profile.name!r} has no section arm, which names a Python file: "
            "arm: {file: my_arm.py}, with robot.driver: arm"
        )
    path = Path(profile.arm.file).expanduser()
    return make_robot(path, profile.arm.options), path.name


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
        raise ValueError("measured_ns is in the future; use time.monotonic_ns()")
    return measured_ns
