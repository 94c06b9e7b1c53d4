"""A leader arm as a lab would write it, for tests: its first joint turns once a file is there."""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np

from vla_zenoh.robot import Command, Reading

JOINTS, RAD_S = 7, 0.15


class LeaderOfTests:
    """See the module.

    Args:
        go: path of the file; with ``gone`` in it the arm cannot be read any more.
    """

    def __init__(self, go: str) -> None:
        self._go, self._since_s = Path(go), 0.0

    def read(self) -> Reading:
        turned_rad = 0.0
        if self._go.exists():
            if self._go.read_text() == "gone":
                raise ConnectionError("the cable is out")
            self._since_s = self._since_s or time.monotonic()
            turned_rad = RAD_S * (time.monotonic() - self._since_s)
        # It stands elsewhere than the arm does.
        return Reading(np.array([turned_rad, -0.3, 0.1, -2.0, 0.1, 1.7, 0.5]), width_m=0.08)

    def move(self, command: Command) -> None:
        raise AssertionError("nobody moves a leader")
