"""Driver of a robot that is a Python class with `read` and `move`, see `vla_zenoh.robot`.

A plug-in makes it, see `vla_zenoh.plugins`; that of the driver ``arm`` from a file of the profile.
"""

from __future__ import annotations

import math
import operator
import time
from pathlib import Path
from typing import Any

from vla_zenoh import plugins
from vla_zenoh.bus.metrics import RateMeter
from vla_zenoh.errors import NodeError, ProfileError, VlaZenohError, in_words
from vla_zenoh.policy.loader import IS_ROBOT, is_robot
from vla_zenoh.profile import Profile
from vla_zenoh.robot import Reading, Robot, numbers
from vla_zenoh.robots.driver import DriverStatus, Measurement, RobotDriver
from vla_zenoh.robots.joint_reading import JointReading
from vla_zenoh.sanitize import one_line
from vla_zenoh.types import Event, FloatArray, GripperCommand, GripperState
from vla_zenoh.types.records import JointReference, Joints, PoseReference, plain_values

FUTURE_NS = 100_000_000
MAX_WORDS = 300
FAULT_NS = 200_000_000
"""A fault lasts at least this long: only the newest state is used, and a single one could be
missed."""
RELEASED_M = 0.002
"""Fingers that are this much wider apart than around an object were opened."""


class PythonDriver(RobotDriver):
    """The robot that the plug-in of ``robot.driver`` makes.

    Exceptions of the robot become a `NodeError` with the names of driver, or file, and method.

    Raises:
        PluginError: the driver is not installed, or cannot be imported.
        VlaZenohError: the robot cannot be made; its plug-in says why.
    """

    name = "arm"

    def __init__(self, profile: Profile) -> None:
        super().__init__(profile)
        self.robot, self._called = make_arm(profile)
        self._state = JointReading(profile, self.kinematics)
        self._fault = Fault()
        self._complaint = ""
        """Why the last reading was rejected."""
        self._rate = RateMeter()
        self._asked_m = profile.robot.max_width_m
        self._width_m: float | None = None
        self._held_m: float | None = None
        """Width at which an object is held."""
        self.recovers = callable(getattr(self.robot, "recover", None))
        if not callable(getattr(self.robot, "grip", None)):
            self.no_gripper = f"{self._called} has no method grip"
            self._asked_m = math.nan
        self.silent_why = f"{self._called}: read returns nothing new"
        self.stalled_hint = f"; does {self._called} wait for something?"

    # -- calls --------------------------------------------------------------------------------
    def _call(self, name: str, *given: Any) -> Any:
        method = getattr(self.robot, name, None)
        if not callable(method):
            return None
        try:
            return method(*given)
        except Exception as error:
            words = one_line(in_words(error), MAX_WORDS)
            if name == "move" and isinstance(error, AttributeError):
                words += f"; robot.command is {self.profile.robot.command}"
            raise NodeError(f"{self._called}: {name}: {words}") from error

    def connect(self) -> None:
        self._call("connect")

    def recover(self) -> None:
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
        mode, was = one_line(reading.mode, MAX_WORDS) or "ready", self.gripper_mode
        if mode != was:
            level = "info" if mode == "ready" else "warning"
            self.report.emit(Event(level, "transition", f"robot:{was}->{mode}"))
        self.gripper_mode = mode
        self.away = "fault" if self.fault else "not_ready" if self.gripper_mode != "ready" else ""
        try:
            measured_ns = _measured_ns(reading)
            if measured_ns == self.measured_ns:
                return None  # unchanged: the robot is slower than this loop
            stamp_ns = self.report.clock.wall_at(measured_ns)
            measured = measurement_of(reading, stamp_ns, self._asked_m, self._state)
        except (TypeError, ValueError) as error:
            reason = getattr(error, "reason", "invalid")
            self._complaint = f"{self._called}: read: {one_line(error, MAX_WORDS)}"
            self.report.reject(reason, self._complaint)
            return None
        self._complaint = ""
        gripper = measured.gripper
        assert gripper is not None
        self.measured_ns, self._width_m = measured_ns, gripper.width_m
        # While the fingers move nobody knows.
        if gripper.width_m is not None and not gripper.moving:
            self._set_held(gripper.width_m, holding=gripper.holding)
        self._rate.tick()
        return measured

    def _set_held(self, width_m: float, *, holding: bool) -> None:
        held_m = self._held_m
        self._held_m = width_m if holding else None
        if holding and held_m is None:
            self.report.emit(Event("info", "notice", "grasped", f"{width_m:.3f} m apart"))
        elif held_m is not None and not holding and width_m < held_m + RELEASED_M:
            why = "the gripper lost its object and was not opened"
            self.report.emit(Event("warning", "notice", "object_lost", why))

    @property
    def turned_rad(self) -> FloatArray:
        return self._state.turned_rad

    def move(self, reference: PoseReference | JointReference, now_ns: int) -> None:
        self._call("move", self.command_of(reference))
        self.report.counters["arm.commands_given"] += 1

    def grip(self, command: GripperCommand, now_ns: int) -> None:
        self._asked_m = command.width_m
        self._call("grip", command.width_m, command.speed_m_s, command.force_n)

    def close(self) -> None:
        self._call("close")

    def status(self) -> DriverStatus:
        """Class, fault or else why a reading was rejected, width, and the robot's own entries."""
        detail: dict[str, Any] = {"arm": self._called, "fault": self.fault}
        width_m = self._asked_m if self._width_m is None else self._width_m
        if not math.isnan(width_m):
            detail["width_m"] = width_m
        if self._complaint and not self.fault:
            detail["complaint"] = self._complaint
        own = plain_values(self._call("status"))
        return DriverStatus({**detail, **own}, rates_hz={"readings": self._rate.rate_hz})


def script_of(profile: Profile) -> Path | None:
    """File whose header may ask for an environment of its own; None: the robot has none."""
    return plugins.load(plugins.ROBOTS, profile.robot.driver).script(profile.driver_options)


def make_arm(profile: Profile) -> tuple[Robot, str]:
    """The robot of a profile, and its name in messages."""
    driver = profile.robot.driver
    plugin = plugins.load(plugins.ROBOTS, driver)
    if plugin.make is None:
        raise ProfileError(f"robot.driver is {driver}: run `vla-zenoh node {driver}`")
    options = profile.driver_options
    script = plugin.script(options)
    try:
        robot = plugin.make(profile, options)
    except VlaZenohError:
        raise
    except Exception as error:
        raise NodeError(f"{driver} cannot be made: {in_words(error)}") from error
    if not is_robot(robot):
        raise NodeError(f"{driver}: {type(robot).__name__} {IS_ROBOT}")
    return robot, driver if script is None else script.name


def _measured_ns(reading: Reading) -> int:
    """Monotonic time; a `TypeError` if it is no whole number, a `ValueError` in the future."""
    now_ns = time.monotonic_ns()
    if reading.measured_ns is None:
        return now_ns
    measured_ns = operator.index(reading.measured_ns)
    if measured_ns > now_ns + FUTURE_NS:
        raise ValueError("measured_ns is in the future; use time.monotonic_ns()")
    return measured_ns


def measurement_of(
    reading: Reading, stamp_ns: int, asked_m: float, arm: JointReading
) -> Measurement:
    """A reading that was measured at `stamp_ns` (wall clock) as the records of an arm.

    If it has no width, that is `asked_m`, the last commanded one; NaN: it has no gripper.

    Raises:
        ValueError: a value is not a number, or impossible for this arm; it rejects all.
    """
    names = arm.arm_joints

    def maybe(name: str, size: int) -> FloatArray | None:
        given = getattr(reading, name)
        return None if given is None else numbers(name, given, size)

    joints = Joints(
        stamp_ns,
        names,
        numbers("position_rad", reading.position_rad, len(names)),
        maybe("velocity_rad_s", len(names)),
        maybe("effort_nm", len(names)),
    )
    wrench = maybe("wrench", 6)
    if reading.width_m is not None and not arm.has_gripper:
        raise ValueError("width_m is given, and the profile declares no gripper (robot.gripper)")
    if reading.width_m is None and math.isnan(asked_m):
        gripper = GripperState(None, moving=False, holding=False)
    else:
        width_m = asked_m if reading.width_m is None else reading.width_m
        gripper = GripperState(width_m, reading.moving, reading.holding)
        arm.check_width(width_m)
    arm.take(joints, stamp_ns)
    return arm.measurement(wrench, gripper)


class Fault:
    """Why the robot does not move: from a reading that reports a fault until one that does not."""

    def __init__(self) -> None:
        self.words = ""
        self._since_ns = 0

    def say(self, words: object, now_ns: int) -> bool:
        """Update from a reading's fault, empty or None if it has none; whether `words` changed."""
        before = self.words
        if words:
            self.words, self._since_ns = one_line(words, MAX_WORDS)[:MAX_WORDS], now_ns
        elif now_ns - self._since_ns >= FAULT_NS:
            self.words = ""
        return self.words != before
