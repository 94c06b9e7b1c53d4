"""The robot node: one loop for every robot, whatever its driver.

Commands in, states out: a tick reads the robot, checks its command streams, moves it along them,
publishes its state and reports transitions. When the node ends, by a signal or an exception, it
brakes the arm first.
"""

from __future__ import annotations

import gc
import sys
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import zenoh

from vla_zenoh.bus.buffers import CallbackRing, ReceivedSample
from vla_zenoh.bus.clock import Tick
from vla_zenoh.bus.metrics import RateMeter
from vla_zenoh.bus.node import Node
from vla_zenoh.bus.session import MAX_MESSAGE_BYTES
from vla_zenoh.control.commander import LATE_NS
from vla_zenoh.control.lateness import Lateness
from vla_zenoh.errors import NodeError
from vla_zenoh.guard.arm_guard import max_braking_time_s
from vla_zenoh.robots.arm import Arm
from vla_zenoh.robots.driver import RobotDriver
from vla_zenoh.runtime.kept_text import KeptText
from vla_zenoh.runtime.process import realtime_thread
from vla_zenoh.sanitize import one_line
from vla_zenoh.types import Event

FAILURES = 3
"""After this many failed ticks in a row the arm counts as impossible to brake."""
LEAST_S, SLACK_S = 1.0, 0.2
"""The last brake may take this long at least, and this much longer than the limits allow."""
MAX_REASON = 300
CONNECTING_S = 0.2
REPLIES, REPLY_S = 20, 0.05
"""For so long another node of this name is looked for: after a router's restart it links again
within 0.5 s."""
WATCH_S = 0.05
HEARD = 8
"""Stops and resets buffered between two ticks."""


class RobotNode:
    """A robot on the bus, with name and profile of its `driver`; the owner closes the `session`.

    It hears an emergency stop itself, brakes without a command node, and stays stopped until a
    reset. `latch` is the file that exists meanwhile, so that a restarted node is stopped as well.

    Raises:
        NodeError: a node of this name is alive already.
    """

    def __init__(
        self, driver: RobotDriver, session: zenoh.Session, *, latch: Path | None = None
    ) -> None:
        self.driver = driver
        node = self.node = Node(driver.name, driver.profile, session)
        parts = driver.parts if driver.has_arm else {}
        self.arms = {name: Arm(node, part) for name, part in parts.items()}
        self.arm = next(iter(self.arms.values()), None)
        driver.attach(node, self.arm)
        for name, part in parts.items():
            if part is not driver:
                part.attach(node, self.arms[name])
        keys = node.keys
        self._stops = node.subscribe(keys.stop, CallbackRing(HEARD, MAX_MESSAGE_BYTES))
        self._resets = node.subscribe(keys.reset, CallbackRing(HEARD, MAX_MESSAGE_BYTES))
        self._stop_put_ns = self._stop_came_ns = 0
        self._latch = KeptText(latch)
        if self._latch.read() is not None:
            for arm in self.arms.values():
                arm.latch_stop()
        self._rate = RateMeter()
        self._lateness = Lateness(driver.period_s, f"node {driver.name!r}")
        self._busy = ""
        self._realtime = False
        self._watched_s = 0.0
        self._brake_until_ns = 0

    # -- running ------------------------------------------------------------------------------
    def run(self, stop: threading.Event) -> None:
        """Drive the robot until `stop` is set; a `NodeError` if the driver failed."""
        driver = self.driver
        sys.setswitchinterval(driver.switch_interval_s)
        try:
            self._connect()
            gc.collect()
            gc.freeze()
            if driver.lockstep:
                driver.serve_lockstep(self, stop)
                return
            with realtime_thread() as self._realtime:
                self._loop(driver.pace(), stop)
        finally:
            self._close()
            gc.unfreeze()  # so that the interpreter frees everything at exit

    def _connect(self) -> None:
        """Connect the driver, publishing the status meanwhile: else the node counts as hung."""
        self.node.publish_status("connecting", now=True)
        if not self.driver.simulated:  # another node may move the arm, which has one client
            for _ in range(REPLIES):
                time.sleep(REPLY_S)
                self.node.publish_status("connecting")
        done = threading.Event()

        def report() -> None:
            while not done.wait(CONNECTING_S):
                with suppress(NodeError):  # the loop ends by it
                    self.node.publish_status("connecting")

        reporter = threading.Thread(target=report, name="connecting", daemon=True)
        reporter.start()
        try:
            self.driver.connect()
        finally:
            done.set()
            reporter.join()

    def _close(self) -> None:
        try:
            self.driver.close()
        except NodeError as error:  # an exception before this one matters more
            self.node.reject("robot_failed", str(error))
        finally:
            if self._stops.drain():
                self._latch.set("emergency stop")
            self._latch.close()
            self.node.publish_end()
            self.node.close()

    def _loop(self, wait: Callable[[], Tick], stop: threading.Event) -> None:
        try:
            while True:
                tick = wait()
                if stop.is_set() and self._may_end(tick.nominal_ns):
                    return
                self.step(tick)
        except Exception as error:
            how = "ends"
            if self.arms and not self.driver.simulated:
                braked = self._brake_to_stop(wait)
                how = "braked, and ends" if braked else "not braked, and ends"
            if isinstance(error, NodeError):
                self.node.reject("robot_failed", str(error))
            else:
                why = f"{one_line(repr(error), MAX_REASON)}: {how}"
                self.node.emit(Event("error", "fault", "broken", why))
            raise

    def step(self, tick: Tick) -> None:
        """Run one tick."""
        if tick.periods > 1:
            self.node.counters[f"{self.node.name}.missed_ticks"] += tick.periods - 1
        mono_ns = tick.nominal_ns
        self._lateness.add(tick.periods - 1, mono_ns)
        self._hear_stop()
        self.driver.poll(mono_ns)
        now_ns = mono_ns if self.driver.lockstep else self.node.clock.wall_at(mono_ns)
        for arm in self.arms.values():
            arm.begin_step(now_ns, mono_ns, tick.stall_s)
        for arm in self.arms.values():
            arm.end_step(mono_ns)
        self._rate.tick()
        self._watch()

    def _hear_stop(self) -> None:
        stops, resets = self._stops.drain(), self._resets.drain()
        for stop in stops:
            put_ns = stop.put_ns or 0
            if stop.mono_ns - self._stop_came_ns < LATE_NS:  # it may be older, of a slow client
                put_ns = max(put_ns, self._stop_put_ns)
            self._stop_put_ns, self._stop_came_ns = put_ns, stop.mono_ns
        if stops:
            for arm in self.arms.values():
                arm.latch_stop()
            self._latch.set("emergency stop")
        valid = [reset for reset in resets if not self._overtaken(reset)]
        if resets and (stops or not valid):  # within a tick their order is not known
            why = "a reset was put before the last emergency stop, or with it; put it again"
            self.node.reject("reset_refused", why)
        elif valid:
            for arm in self.arms.values():
                arm.stop_latched = False
            self._latch.set(None)
            if self.driver.recovers:
                self.driver.recover()

    def _overtaken(self, reset: ReceivedSample) -> bool:
        """Whether a reset was put before the last stop, which arrived first."""
        late = reset.mono_ns - self._stop_came_ns < LATE_NS
        return late and reset.put_ns is not None and reset.put_ns <= self._stop_put_ns

    # -- the last brake -----------------------------------------------------------------------
    def _may_end(self, mono_ns: int) -> bool:
        """Whether the node may end at this tick; commands are rejected from the first call on."""
        if not self.arms or self.driver.simulated:
            return True
        for arm in self.arms.values():
            arm.accepting = False
        if not self._moving:
            return True
        patience_s = max(LEAST_S, max_braking_time_s(self.node.profile) + SLACK_S)
        self._brake_until_ns = self._brake_until_ns or mono_ns + round(patience_s * 1e9)
        if mono_ns < self._brake_until_ns:
            return False
        self._emit_not_braked(
            f"after {patience_s:.1f} s the arm is still braking; giving up, because the "
            "loop was late too often"
        )
        return True

    @property
    def _moving(self) -> bool:
        """Whether one of the arms moves."""
        return any(arm.guard.moving for arm in self.arms.values())

    def _brake_to_stop(self, wait: Callable[[], Tick]) -> bool:
        """Brake after an exception, tolerating single failures; whether all arms came to rest."""
        failures = dict.fromkeys(self.arms, 0)
        for arm in self.arms.values():
            arm.accepting = False
        while self._moving:
            tick = wait()
            now_ns = self.node.clock.wall_at(tick.nominal_ns)
            for name, arm in self.arms.items():
                try:
                    arm.begin_step(now_ns, tick.nominal_ns, tick.stall_s, reading=False)
                    failures[name] = 0
                except Exception as error:
                    failures[name] += 1
                    if failures[name] == FAILURES:
                        self._emit_not_braked(f"it cannot be braked: {one_line(error, MAX_REASON)}")
            if all(count >= FAILURES for count in failures.values()):
                return False
            if self._may_end(tick.nominal_ns):
                break
        return not self._moving

    def _emit_not_braked(self, why: str) -> None:
        self.node.emit(Event("error", "fault", "not_braked", why))

    # -- status -------------------------------------------------------------------------------
    @property
    def state(self) -> str:
        """State of the node, one word; of several parts that of the first that does not run."""
        states = [arm.state for arm in self.arms.values()]
        return next((state for state in states if state != "running"), "running")

    def _watch(self) -> None:
        changed = self.driver.status_changed()
        for arm in self.arms.values():
            changed = arm.changed() or changed
        if not changed and time.monotonic() - self._watched_s < WATCH_S:
            return
        self._watched_s = time.monotonic()
        before, self._busy = self._busy, self._lateness.sentence()
        if self._busy and not before:
            self.node.emit(Event("warning", "notice", "busy", self._busy))
        self.watch(now=changed)

    def watch(self, *, now: bool = False) -> None:
        """Follow the system's clock, and publish the status when it is due, or `now`."""
        node, driver = self.node, self.driver
        node.adopt_system_time()
        if not (node.status_due(self.state) or now):
            return
        why = self._latch.failure()
        if why is not None:
            node.emit(Event("error", "fault", "latch", why))
        found = driver.status()
        detail = {**found.detail, "realtime": self._realtime, "busy": self._busy}
        arms = self.arms.values()
        if arms:
            guards = [arm.guard for arm in arms]
            if driver.profile.robot.no_gripper and not driver.profile.parts:
                detail["gripper"] = "no gripper"
            detail["stop_latched"] = any(arm.stop_latched for arm in arms)
            detail["following"] = all(guard.following for guard in guards)
            node.counters[f"{node.name}.stream_silences"] = sum(one.silences for one in guards)
            if not driver.simulated:
                node.counters[f"{node.name}.stalls"] = sum(arm.stalls for arm in arms)
        if len(arms) > 1:
            detail["parts"] = {name: arm.state for name, arm in self.arms.items()}
        node.publish_status(
            self.state,
            detail=detail,
            ages_s=found.ages_s,
            rates_hz={driver.loop: self._rate.rate_hz, **found.rates_hz},
            latency_ms=found.latency_ms,
            now=now,
        )
