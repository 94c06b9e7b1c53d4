"""What a robot driver without a bus reports to, in place of a node."""

from __future__ import annotations

from collections import Counter
from typing import Any

from vla_zenoh.bus.clock import Clock
from vla_zenoh.robots.driver import RobotDriver
from vla_zenoh.types import Event


class Report:
    """Keeps what `driver` reports from now on."""

    def __init__(self, driver: RobotDriver) -> None:
        self.clock = Clock()
        self.counters: Counter[str] = Counter()
        self.events: list[Event] = []
        in_place_of_a_node: Any = self
        driver.report = in_place_of_a_node

    def emit(self, event: Event) -> None:
        self.events.append(event)

    def reject(self, reason: str, why: str, about: str = "") -> None:
        self.counters[f"refused.{reason}"] += 1
        self.emit(Event("warning", "refusal", reason, why))
