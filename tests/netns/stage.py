"""A lab with an arm at work in it, to which something is done in mid-motion, and a row about that.

`Stage` is the lab: the arm's host with router, simulator, cameras and command node, the host of the
model, and who else a layout has. `Stage.suffer` carries one `Fault` out and measures it by what the
simulator and the command node wrote down themselves (`netns.flight_log`).
"""

from __future__ import annotations

import json
import select
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np
from netns.flight_log import Flight, brake_s, read_flight
from netns.layouts import LAYOUTS, Layout
from netns.rows import Fault, Row
from netns.site import HERE, Site, secured_site

from vla_zenoh.profile import Profile, load_profile

RATE_HZ = 10.0
STEP_S, STEP_M = 0.1, 0.01
STEPS = 40
"""Of a motion that is to reach its goal: 0.4 m."""
MOVING_M_S = 0.05
UNDER_WAY_S = 0.8
ACCUSTOMED_S = 2.0
"""After which TCP has found out what a link is like."""
SEEN_S = 1.0
"""An arm that moves again is looked at for so long: it may stop once more."""
ANSWER_S = 200.0
RECOVERY_S = 60.0
GOAL_M = 0.001
MEASURED_SLACK, OWN_BRAKE_SLACK = 1.15, 2.0
"""Share of the acceleration limit that the measured arm may take; where the robot brakes alone."""
COMMANDED_SLACK = 1.001


@dataclass
class Stage:
    """See the module."""

    site: Site
    layout: Layout
    profile: Profile
    _probe: Any = None

    # -- the operator on the robot's host -----------------------------------------------------
    def start_probe(self) -> None:
        words = (sys.executable, str(HERE / "probe.py"), str(self.site.profile("robot")))
        self._probe = self.site.hosts["robot"].talk(*words)
        assert self._hear().get("listening")

    def ask(self, do: str, **named: Any) -> dict[str, Any]:
        """Give the operator an order; the answer."""
        self._probe.stdin.write(json.dumps({"do": do, **named}) + "\n")
        self._probe.stdin.flush()
        return self._hear()

    def _hear(self) -> dict[str, Any]:
        ready, _, _ = select.select([self._probe.stdout], [], [], ANSWER_S)
        line = self._probe.stdout.readline() if ready else ""
        assert line, f"the operator says nothing\n{self.site.logs()}"
        return json.loads(line)

    def flight(self, node: str) -> Flight:
        """What a node wrote down of itself."""
        return read_flight(self.site.folder / f"{node}.flight")

    # -- a fault ------------------------------------------------------------------------------
    def suffer(self, fault: Fault) -> Row:
        """Move the arm, let the fault happen, and measure.

        Raises:
            AssertionError: the arm does not come up at all.
        """
        row = Row(fault.name, fault.about)
        if fault.ever:
            fault.inject(self)
            time.sleep(ACCUSTOMED_S)
        ready = self.ask("ready", rate_hz=RATE_HZ)
        assert ready["ready"], f"{ready}\n{self.site.logs()}"
        time.sleep(0.5)
        before = self.ask("count")
        moving = self.ask("move", count=STEPS if fault.seconds is None else 0)
        assert moving["moving"], f"{moving}\n{self.site.logs()}"
        time.sleep(UNDER_WAY_S)
        began_s = time.monotonic()
        if not fault.ever:
            self.ask("count")  # what happened until now is no news
            began_s = fault.inject(self) or began_s
        if fault.seconds is None:
            finished = self.ask("finish", patience_s=3.0 * STEPS / RATE_HZ)
            ended_s = time.monotonic()
            fault.clear(self)
        else:
            finished = {}
            time.sleep(max(0.0, fault.seconds - (time.monotonic() - began_s)))
            ended_s = time.monotonic()
            fault.clear(self)
        recovered: dict[str, Any] = {}
        if not finished.get("done"):
            recovered = self.ask("recover", patience_s=RECOVERY_S)
        time.sleep(SEEN_S)
        rest_s = time.monotonic()
        self.ask("rest")
        time.sleep(1.2)  # status comes twice a second
        after = self.ask("count")
        self._measure_motion(row, fault, began_s, rest_s)
        stood_s = began_s + (row.stood_s or 0.0)
        since_s = began_s if fault.from_fault else ended_s
        self._measure_recovery(row, fault, recovered, since_s, stood_s)
        self._measure_goal(row, moving, finished)
        self._count(row, before, after)
        self._tell(row, fault, finished, recovered, after["news"])
        self._judge(row, fault, finished, recovered)
        return row

    def _measure_motion(self, row: Row, fault: Fault, began_s: float, rest_s: float) -> None:
        profile, limits = self.profile, self.profile.limits.translation
        measured, commanded = self.flight("sim"), self.flight("command")
        # A motion that comes to its goal stands there, too: only who stops on the way was braked.
        stood_s = measured.stood_at_s(began_s, rest_s)
        if stood_s is not None and fault.seconds is not None:
            row.stood_s = stood_s - began_s
            way = measured.between(began_s, stood_s).position_m
            row.way_mm = float(np.linalg.norm(way[-1] - way[0])) * 1e3
            since_s = began_s
            if not fault.alone:  # who goes on hearing chunks goes on
                since_s = max(began_s, commanded.last_asked_s(stood_s) or began_s)
            row.braked_s = stood_s - since_s
            row.braked_bound_s = self._bound_s(fault, commanded, since_s)
        row.acceleration = measured.between(began_s - 0.2).hardest_m_s2() / limits.acceleration_m_s2
        period_s = 1.0 / profile.timing.command_hz
        row.jerk = commanded.between(began_s - 0.2).jerk_m_s3(period_s) / limits.jerk_m_s3

    def _bound_s(self, fault: Fault, commanded: Flight, began_s: float) -> float:
        timing = self.profile.timing
        around = commanded.between(began_s - 0.1, began_s + 0.1)
        brake = max(
            brake_s(self.profile, twist[:3], change)
            for twist, change in zip(around.twist[::5], around.last[::5], strict=True)
        )
        if fault.alone:
            return timing.command_timeout_s + brake
        return STEP_S + 1.0 / RATE_HZ + timing.watchdog_s + brake

    def _measure_recovery(
        self,
        row: Row,
        fault: Fault,
        recovered: dict[str, Any],
        since_s: float,
        stood_s: float,
    ) -> None:
        if fault.seconds is None and not recovered:
            return
        measured = self.flight("sim")
        row.activated = recovered.get("activated_s") is not None
        begun_s = recovered.get("activated_s") or since_s
        moved_s = measured.moved_at_s(max(begun_s, since_s, stood_s), MOVING_M_S)
        if recovered.get("moves") and moved_s is not None:
            row.recovered_s = moved_s - since_s

    @staticmethod
    def _measure_goal(row: Row, moving: dict[str, Any], finished: dict[str, Any]) -> None:
        if finished.get("done"):
            way = np.subtract(finished["end_m"], moving["start_m"])
            asked = np.array([0.0, 0.0, moving["sign"] * STEPS * STEP_M])
            row.off_mm = float(np.linalg.norm(way - asked)) * 1e3

    @staticmethod
    def _count(row: Row, before: dict[str, Any], after: dict[str, Any]) -> None:
        for what in ("lost", "refused"):
            more = {name: count - before[what].get(name, 0) for name, count in after[what].items()}
            setattr(row, what, {name: count for name, count in more.items() if count > 0})

    def _tell(
        self,
        row: Row,
        fault: Fault,
        finished: dict[str, Any],
        recovered: dict[str, Any],
        news: list[Any],
    ) -> None:
        whats = [what for node, what, _ in news if node == "command"]
        if finished.get("done"):
            held = whats.count("active->holding")
            row.did = "went on to its goal" + (f", held {held} times on the way" if held else "")
        elif row.stood_s is None and fault.seconds is not None and recovered.get("moves"):
            row.did = "went on"
        elif recovered.get("moves") and not row.activated:
            row.did = "stood, then went on by itself"
        elif recovered.get("moves"):
            ended = (why for _, what, why in news if what.endswith("->inactive"))
            why = next((why for why in ended if why != "deactivated"), "")  # that was we
            row.did = "stood until it was activated" + (f" ({why})" if why else "")
        else:
            row.did = f"did not come back: {recovered.get('why', '')[:300]}"

    def _judge(
        self, row: Row, fault: Fault, finished: dict[str, Any], recovered: dict[str, Any]
    ) -> None:
        took_s, bound_s = row.braked_s, row.braked_bound_s
        if took_s is not None and bound_s is not None and took_s > bound_s:
            row.wrong.append(f"stood after {took_s:.3f} s, allowed {bound_s:.3f} s")
        slack = OWN_BRAKE_SLACK if fault.alone else MEASURED_SLACK
        if row.acceleration > slack:
            row.wrong.append(f"acceleration {row.acceleration:.2f} of its limit")
        if row.jerk > COMMANDED_SLACK:
            row.wrong.append(f"commanded jerk {row.jerk:.3f} of its limit")
        if recovered and not recovered.get("moves"):
            row.wrong.append("did not come back")
        if fault.goes_on and fault.seconds is None:
            if not finished.get("done"):
                row.wrong.append("did not reach its goal")
            elif (row.off_mm or 0.0) > GOAL_M * 1e3:
                row.wrong.append(f"{row.off_mm:.2f} mm beside its goal")


@contextmanager
def stage(name: str) -> Iterator[Stage]:
    """A lab of this layout with certificates, everything up, the operator at the keyboard."""
    layout = LAYOUTS[name]
    with secured_site(layout.plain, layout.hosts, layout.routers, layout.shaped) as site:
        profile = load_profile(str(site.secured))
        robot = site.hosts["robot"]
        robot.environment["FLIGHT_FOLDER"] = str(site.folder)
        robot.python_folders.append(str(HERE / "flight"))
        for host in layout.clocks:
            site.own_clock(host)
        parts = [host for host in layout.hosts if host in profile.hosts]
        site.equip(*parts)
        site.up(*layout.routers, *(host for host in parts if host not in layout.routers))
        found = Stage(site, layout, profile)
        found.start_probe()
        yield found
