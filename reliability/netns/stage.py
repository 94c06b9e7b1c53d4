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
from netns.flight_log import Flight, read_flight
from netns.layouts import LAYOUTS, Layout
from netns.measure import RATE_HZ, STEP_M, STEPS, Span, judge, measure_motion
from netns.rows import Fault, Row
from netns.site import HERE, Site, secured_site
from netns.wire import Shape

from vla_zenoh.profile import Profile, load_profile

MOVING_M_S = 0.05
POLL_S = 0.1
UNDER_WAY_S = 0.8
ACCUSTOMED_S = 2.0
"""After which TCP has found out what a link is like."""
SEEN_S = 1.0
"""An arm that moves again is looked at for so long: it may stop once more."""
ANSWER_S = 200.0
RECOVERY_S = 60.0
OVER_S = 120.0
"""By then a fault that ends by itself has ended."""


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
            while not fault.over(self) and time.monotonic() - began_s < OVER_S:
                time.sleep(POLL_S)
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
        row.news = after["news"]
        measure_motion(
            row,
            fault,
            self.profile,
            self.flight("sim"),
            self.flight("command"),
            Span(began_s, ended_s, rest_s),
            done=bool(finished.get("done")),
        )
        stood_s = began_s + (row.stood_s or 0.0)
        since_s = began_s if fault.from_fault else ended_s
        self._measure_recovery(row, fault, recovered, since_s, stood_s)
        self._measure_goal(row, moving, finished)
        self._count(row, before, after)
        self._tell(row, finished, recovered)
        judge(row, fault, finished, recovered)
        if missing := fault.missing(self):
            row.wrong.append(missing)
        return row

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
        finished: dict[str, Any],
        recovered: dict[str, Any],
    ) -> None:
        whats = [what for node, what, _ in row.news if node == "command"]
        if finished.get("done"):
            held = whats.count("active->holding")
            row.did = "went on to its goal" + (f", held {held} times on the way" if held else "")
        elif row.stood_s is None and recovered.get("moves"):
            row.did = "went on"
        elif recovered.get("moves") and not row.activated:
            row.did = "stood, then went on by itself"
        elif recovered.get("moves"):
            ended = (why for _, what, why in row.news if what.endswith("->inactive"))
            why = next((why for why in ended if why != "deactivated"), "")  # that was we
            row.did = "stood until it was activated" + (f" ({why})" if why else "")
        else:
            row.did = f"did not come back: {recovered.get('why', '')[:300]}"


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
        if layout.mtu:
            for host in layout.hosts:
                site.hosts.set_mtu(host, layout.mtu)
            for host in layout.shaped:  # larger ones would not come through
                site.hosts.shape(host, Shape(mtu=layout.mtu))
        site.equip(*parts)
        site.up(*layout.routers, *(host for host in parts if host not in layout.routers))
        found = Stage(site, layout, profile)
        found.start_probe()
        yield found
