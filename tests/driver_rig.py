"""A robot driver without its node: a test reads it as the node does, until something is so."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from driver_report import Report

from vla_zenoh.profile import load_profile
from vla_zenoh.robots.python_driver import PythonDriver

TICK_S = 0.004


class DriverRig:
    """A driver, what it measured last, and what it reported.

    Args:
        folder: where its profile is written.
        profile: YAML.
    """

    soon_s = 10.0

    def __init__(self, folder: Path, profile: str) -> None:
        path = folder / "lab.yaml"
        path.write_text(profile)
        self.profile = load_profile(str(path))
        self.driver = PythonDriver(self.profile)
        self.report = Report(self.driver)
        self.newest: Any = None

    def tick(self) -> None:
        """Read it once, and keep what it measured."""
        measured = self.driver.read(time.monotonic_ns())
        self.newest = self.newest if measured is None else measured
        time.sleep(TICK_S)

    def until(self, what: Callable[[], bool], within_s: float | None = None) -> None:
        """Read it until something is so; fails after `within_s`, usually `soon_s`."""
        end_s = time.monotonic() + (self.soon_s if within_s is None else within_s)
        while not what():
            assert time.monotonic() < end_s, (self.driver.fault, self.driver.status())
            self.tick()

    def ready(self) -> None:
        """Until it measures and its arm is there."""
        self.until(lambda: self.newest is not None and self.driver.away == "")
