"""An arm that is always where it was commanded to be, and writes down when it was where.

One row of float64 a command: the monotonic clock, which all hosts of a lab share, and its joints.
"""

from __future__ import annotations

import os
import time
from pathlib import Path

import numpy as np

from vla_zenoh.robot import Command, Reading
from vla_zenoh.types import JointCommand

FOLDER = "FLIGHT_FOLDER"
FILE = "arm.flight"


class LoggedArm:
    """A Panda, in joint positions."""

    def __init__(self) -> None:
        self._file = (Path(os.environ[FOLDER]) / FILE).open("ab", buffering=0)
        self._position_rad = np.array([0.0, -0.044, 0.0, -2.627, 0.0, 2.583, 0.785])

    def read(self) -> Reading:
        """The last set-point."""
        return Reading(position_rad=self._position_rad)

    def move(self, command: Command) -> None:
        """Be there, and write it down."""
        assert isinstance(command, JointCommand)
        self._position_rad = np.array(command.position_rad)
        self._file.write(np.array([time.monotonic(), *self._position_rad]).tobytes())

    def grip(self, width_m: float, speed_m_s: float, force_n: float) -> None:
        """Nothing: where its gripper is nobody asks."""
