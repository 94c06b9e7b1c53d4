"""trossen-arm-sim's controller and the maker's client, as processes: trossen_process.py."""

from __future__ import annotations

import json
import os
import time
from pathlib import Path
from typing import Any

import numpy as np
from physicalai_rig import Process

VARIABLE = "TROSSEN_PYTHON"
"""Environment variable with the Python that has trossen-arm-sim and trossen_arm."""
SCRIPT = Path(__file__).with_name("trossen_process.py")
HOME = [0.0, 1.2, 1.0, -0.4, 0.0, 0.0, 0.02]
"""Joints, and travel of a finger: where the maker's client brings the arm before a test."""
HOME_S, AT_HOME_RAD = 2.0, 0.02
STANDS_S, STANDS_RAD, LATEST_S = 0.5, 1e-3, 6.0


class TrossenProcess(Process):
    """One role of trossen_process.py; its first line is in `begins`."""

    def __init__(self, *given: str) -> None:
        super().__init__(*given, python=os.environ[VARIABLE], script=SCRIPT)
        self.begins = json.loads(self.line())


class Controller(TrossenProcess):
    """The simulated controller, and what it knows of its arm."""

    def __init__(self) -> None:
        super().__init__("controller")

    def joints_rad(self) -> np.ndarray:
        """Where the arm is, (7,) with the travel of a finger."""
        return np.array(self.ask(since=time.monotonic() - 0.1)["rows"][-1][1])

    def stood(self, since_s: float) -> tuple[float, float]:
        """After which time from `since_s` on the arm stands, and how far a joint went on."""
        end_s = time.monotonic() + LATEST_S
        while time.monotonic() < end_s:
            time.sleep(0.2)
            rows = self.ask(since=since_s)["rows"]
            times_s = np.array([at_s for at_s, _ in rows])
            joints_rad = np.array([joints for _, joints in rows])[:, :6]
            apart_rad = np.abs(joints_rad - joints_rad[-1]).max(axis=1)
            moving = np.flatnonzero(apart_rad > STANDS_RAD)
            stands_s = times_s[moving[-1]] if len(moving) else times_s[0]
            if times_s[-1] - stands_s > STANDS_S:
                return float(stands_s - since_s), float(apart_rad[0])
        raise AssertionError("it went on and on")


def bring_home() -> dict[str, Any]:
    """The maker's client moves the arm to `HOME` and leaves; what it said last."""
    with TrossenProcess("client") as client:
        assert client.begins == {"ready": True}
        told = client.ask(to=HOME, **{"in": HOME_S})
        time.sleep(0.3)
        return client.ask() or told
