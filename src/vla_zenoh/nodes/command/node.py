"""The command node: owns clock and session around `vla_zenoh.control.commander`."""

from __future__ import annotations

import gc
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path

import zenoh

from vla_zenoh.bus.clock import FixedRate, Tick
from vla_zenoh.bus.node import Node
from vla_zenoh.codec import records
from vla_zenoh.control.commander import Commander, Outputs, Setting
from vla_zenoh.control.reachability import make_reachability_filter
from vla_zenoh.control.states import State
from vla_zenoh.keys import Kind
from vla_zenoh.nodes.command.inputs import CommandInputs
from vla_zenoh.nodes.command.status import CommandStatus
from vla_zenoh.profile import Profile
from vla_zenoh.runtime.estop_latch import EstopLatch
from vla_zenoh.runtime.scheduling import realtime_thread
from vla_zenoh.types import Event

TASK_PERIOD_S = 0.2
BRAKE_BEFORE_EXIT_S = 1.0
SWITCH_INTERVAL_S = 5e-4


class CommandNode:
    """See the module.

    Args:
        profile: limits, timing, first settings.
        session: open session.
        dry_run: compute everything, publish no command.
        latch: file that stands while an emergency stop or a fault is latched, so that a command
            node that is started again is stopped as well.
    """

    def __init__(
        self,
        profile: Profile,
        session: zenoh.Session,
        *,
        dry_run: bool = False,
        latch: Path | None = None,
    ) -> None:
        node = self.node = Node("command", profile, session)
        self.commander = Commander(
            profile, reach=make_reachability_filter(profile), dry_run=dry_run
        )
        self._latch = None if latch is None else EstopLatch(latch)
        before = None if self._latch is None else self._latch.read()
        if before is not None:
            self.commander.latch(f"stopped before this node was started: {before}")
        keys = node.keys
        self._inputs = CommandInputs(node)
        self._status = CommandStatus(node, self.commander)
        self._pose_out = node.declare_publisher(keys.command_pose, Kind.CONTROL)
        self._joint_out = node.declare_publisher(keys.command_joint, Kind.CONTROL)
        self._gripper_out = node.declare_publisher(keys.command_gripper, Kind.ORDER)
        self._task_out = node.declare_publisher(keys.task, Kind.CONTROL)
        self._last_task = 0.0
        self._answer_settings()

    def _answer_settings(self) -> None:
        task = self.commander
        keys = self.node.keys
        for key, value in (
            (keys.prompt, lambda: task.task.prompt),
            (keys.worker, lambda: task.task.worker),
            (keys.rate, lambda: f"{task.task.rate_hz:g}"),
            (keys.speed, lambda: f"{task.task.speed_percent:g}"),
            (keys.active, lambda: "true" if task.task.active else "false"),
        ):
            self.node.serve(key, self._text_reply(key, value))
        self.node.serve(keys.task, lambda query: query.reply(keys.task, records.encode(task.task)))

    @staticmethod
    def _text_reply(key: str, value: Callable[[], str]) -> Callable[[zenoh.Query], None]:
        return lambda query: query.reply(key, value().encode())

    # -- running ------------------------------------------------------------------------------
    def run(self, stop: threading.Event) -> None:
        """Command until `stop` is set, then brake, then end."""
        sys.setswitchinterval(SWITCH_INTERVAL_S)
        gc.collect()
        gc.freeze()
        with realtime_thread() as self._status.realtime:
            self._loop(stop)
        if self._latch is not None:
            self._latch.close()
        self.node.publish_status("stopped", now=True)
        self.node.close()

    def _loop(self, stop: threading.Event) -> None:
        loop = FixedRate(self.node.profile.timing.command_hz)
        give_up = 0.0
        while True:
            tick = loop.wait()
            if tick.periods > 1:
                self.node.counters["command.missed_ticks"] += tick.periods - 1
            extra = self._after_a_stall(tick)
            if stop.is_set():
                give_up = give_up or time.monotonic() + BRAKE_BEFORE_EXIT_S
                extra.append(Setting("active", False))
                if not self.commander.streaming or time.monotonic() > give_up:
                    break
            self._turn(extra, tick)

    def _after_a_stall(self, tick: Tick) -> list[Setting]:
        if tick.stall_s <= self.node.profile.timing.command_timeout_s:
            return []
        why = f"the command loop stood still for {tick.stall_s:.3f} s"
        return [Setting("lose", f"{why}, {tick.computed_s:.3f} s of it at work")]

    def _turn(self, extra: list[Setting], tick: Tick) -> None:
        began = time.perf_counter()
        now_ns = self.node.clock.wall_at(tick.nominal_ns)
        inputs = self._inputs.take(now_ns)
        inputs.settings = [*inputs.settings, *extra]
        limit = max(1, int(self.node.profile.timing.command_timeout_s * self._hz))
        out = self.commander.step(inputs, now_ns, min(tick.periods, limit))
        self._publish(out, now_ns)
        if any(event.kind == "transition" for event in out.events):
            self._keep_latch()
        self._tell_of_the_latch()
        self._status.ticked(now_ns, tick.stall_s, time.perf_counter() - began)
        self._status.report(out, self._inputs.chunks_dropped)

    def _keep_latch(self) -> None:
        if self._latch is None:
            return
        latched = self.commander.state in (State.STOPPED, State.FAULT)
        self._latch.set(self.commander.why if latched else None)

    def _tell_of_the_latch(self) -> None:
        why = None if self._latch is None else self._latch.failure()
        if why is not None:
            self.node.counters["command.latch_failed"] += 1
            self.node.emit(Event("error", "fault", "latch", why))

    @property
    def _hz(self) -> float:
        return self.node.profile.timing.command_hz

    def _publish(self, out: Outputs, now_ns: int) -> None:
        if out.pose is not None:
            self._pose_out.publish(out.pose, stamp_wall_ns=now_ns)
        if out.joint is not None:
            self._joint_out.publish(out.joint, stamp_wall_ns=now_ns)
        if out.gripper is not None:
            self._gripper_out.publish(out.gripper)
        for refusal in out.rejections:
            kind = "skipped" if refusal.quiet else "refused"
            self.node.counters[f"{kind}.{refusal.reason}"] += 1
        for event in out.events:
            self.node.emit(event)
        if out.accepted is not None:
            self._status.measure(out.accepted)
        due = time.monotonic() - self._last_task >= TASK_PERIOD_S
        if out.task_changed or due:
            self._last_task = time.monotonic()
            self._task_out.publish(self.commander.task)
