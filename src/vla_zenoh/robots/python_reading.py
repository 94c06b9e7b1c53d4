"""Validates the readings of a Python robot, and converts them to our records."""

from __future__ import annotations

from vla_zenoh.kinematics.kinematics import Kinematics
from vla_zenoh.profile import Profile
from vla_zenoh.robot import Reading, numbers
from vla_zenoh.robots.driver import Measurement
from vla_zenoh.robots.joint_reading import JointReading, pose_state
from vla_zenoh.ros2.samples import Joints
from vla_zenoh.sanitize import one_line
from vla_zenoh.types import FloatArray, GripperState

MAX_WORDS = 300
FAULT_NS = 200_000_000
"""A fault lasts at least this long: only the newest state is used, and a single one could be
missed."""


class PythonReading:
    """Validates the readings of one arm.

    Args:
        profile: of the robot.
        kinematics: of that robot.
    """

    def __init__(self, profile: Profile, kinematics: Kinematics) -> None:
        self._names = profile.robot.arm_joints
        self._state = JointReading(profile, kinematics)

    def take(self, reading: Reading, stamp_ns: int, asked_m: float) -> Measurement:
        """Convert a reading; one invalid value rejects all of it.

        Args:
            reading: as the robot returned it.
            stamp_ns: when it was measured, wall clock.
            asked_m: last commanded width, used if the reading has none.

        Raises:
            ValueError: a value is not a number, or impossible for this arm.
        """
        count = len(self._names)

        def maybe(name: str, size: int) -> FloatArray | None:
            given = getattr(reading, name)
            return None if given is None else numbers(name, given, size)

        joints = Joints(
            stamp_ns,
            self._names,
            numbers("position_rad", reading.position_rad, count),
            maybe("velocity_rad_s", count),
            maybe("effort_nm", count),
        )
        wrench = maybe("wrench", 6)
        width_m = asked_m if reading.width_m is None else reading.width_m
        gripper = GripperState(width_m, reading.moving, reading.holding)
        taken = self._state.take(joints, stamp_ns)
        assert taken is not None
        tcp, twist = self._state.tcp()
        return Measurement(stamp_ns, taken, tcp, pose_state(tcp, twist, wrench, None), gripper)


class Fault:
    """Why the robot does not move: from a reading that reports a fault until one that does not."""

    def __init__(self) -> None:
        self.words = ""
        self._since_ns = 0

    def say(self, words: object, now_ns: int) -> bool:
        """Update from a reading; returns whether `words` changed.

        Args:
            words: the reading's fault; empty or None: no fault.
            now_ns: on the monotonic clock.
        """
        before = self.words
        if words:
            self.words, self._since_ns = one_line(words, MAX_WORDS)[:MAX_WORDS], now_ns
        elif now_ns - self._since_ns >= FAULT_NS:
            self.words = ""
        return self.words != before
