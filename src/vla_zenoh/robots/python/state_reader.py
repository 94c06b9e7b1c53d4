"""What an arm of one's own says: readings, of which those count that hold, and faults."""

from __future__ import annotations

import operator
import time

from vla_zenoh.bus.metrics import RateMeter
from vla_zenoh.bus.node import Node
from vla_zenoh.interop.python_reading import MAX_WORDS, Fault, PythonReading, ValidReading
from vla_zenoh.kinematics.kinematics import Kinematics
from vla_zenoh.robot import Reading
from vla_zenoh.robots.python.driver_file import ArmFile
from vla_zenoh.sanitize import one_line
from vla_zenoh.types import Event

FUTURE_NS = 100_000_000


class ArmHearing:
    """See the module.

    Args:
        node: on whose behalf; what is refused is counted and told there.
        file: the robot.
        kinematics: of its arm.

    Attributes:
        newest: reading that held, None before the first.
        rate: of those.
    """

    def __init__(self, node: Node, file: ArmFile, kinematics: Kinematics) -> None:
        self._node, self._file = node, file
        self._reading = PythonReading(node.profile, kinematics)
        self._fault = Fault()
        self._measured_ns = 0
        self.newest: ValidReading | None = None
        self.rate = RateMeter()

    @property
    def fault(self) -> str:
        """Why the robot does not move, empty where it is well."""
        return self._fault.words

    @property
    def silent(self) -> bool:
        """Nothing that holds was read lately."""
        age_s = (time.monotonic_ns() - self._measured_ns) / 1e9
        return age_s > self._node.profile.timing.state_timeout_s

    def read(self, mono_ns: int, asked_m: float) -> ValidReading | None:
        """Ask the robot; None where it says nothing new, or nothing that holds.

        Args:
            mono_ns: now, on the monotonic clock.
            asked_m: width asked for last, see `PythonReading.take`.

        Raises:
            NodeError: its file raised something.
        """
        reading = self._file.read()
        if reading is None:
            return None
        # A robot in a fault often says nothing else that is new, or that holds.
        if self._fault.say(reading.fault, mono_ns) and self.fault:
            self._node.emit(Event("error", "fault", "robot_fault", self.fault))
        try:
            measured_ns = _measured_ns(reading)
            if measured_ns == self._measured_ns:
                return None  # the same again: the robot is slower than this loop
            taken = self._reading.take(reading, self._node.clock.wall_at(measured_ns), asked_m)
        except (TypeError, ValueError) as error:
            reason = getattr(error, "reason", "invalid")
            self._node.reject(reason, f"{self._file.name}: read: {one_line(error, MAX_WORDS)}")
            return None
        self.newest, self._measured_ns = taken, measured_ns
        self.rate.tick()
        return taken


def _measured_ns(reading: Reading) -> int:
    """When it was measured, on the monotonic clock.

    Raises:
        TypeError: it says so by no whole number.
        ValueError: it is yet to be.
    """
    now_ns = time.monotonic_ns()
    if reading.measured_ns is None:
        return now_ns
    measured_ns = operator.index(reading.measured_ns)
    if measured_ns > now_ns + FUTURE_NS:
        raise ValueError("measured_ns is yet to come; it is of time.monotonic_ns()")
    return measured_ns
