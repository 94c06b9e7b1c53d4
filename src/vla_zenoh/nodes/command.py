"""The command node: owns clock and session around `vla_zenoh.control.commander`."""

from __future__ import annotations

import gc
import math
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import zenoh

from vla_zenoh import keys as key_names
from vla_zenoh.codec import records, settings
from vla_zenoh.codec.records import SMALL_BYTES
from vla_zenoh.control.arm import make_shadow
from vla_zenoh.control.commander import Commander, Inputs, Outputs, Setting
from vla_zenoh.control.so3 import quat_from_rotation
from vla_zenoh.control.states import State
from vla_zenoh.errors import CodecError
from vla_zenoh.keys import Kind
from vla_zenoh.nodes.clock import FixedRate, Tick, realtime_thread
from vla_zenoh.nodes.meter import Percentiles, RateMeter
from vla_zenoh.nodes.node import Node
from vla_zenoh.nodes.session import MAX_MESSAGE_BYTES
from vla_zenoh.nodes.slots import Arrival, Inbox, Mailbox
from vla_zenoh.nodes.speaker import Speaker
from vla_zenoh.nodes.surroundings import Neighbours
from vla_zenoh.profile import Profile
from vla_zenoh.types import (
    ActionChunk,
    Cause,
    GripperState,
    JointState,
    PoseState,
    Stamped,
)

STATES = 16
"""States kept between two looks; room for the robot's own beside a stranger's."""
ANYTHING = MAX_MESSAGE_BYTES
"""A stop is obeyed whatever it says, and never read."""
WORDS = settings.MAX_SETTING_BYTES
MAX_WHY = 2000
TASK_PERIOD_S = 0.2
CLOCK_PERIOD_S = 0.1
BRAKE_BEFORE_EXIT_S = 1.0
SWITCH_INTERVAL_S = 5e-4
SPREAD_S = 8.0
"""Status tells how cost and lateness of ticks were spread over so long."""
STAGES = ("capture_to_worker", "inference", "worker_to_command", "command_to_pose", "end_to_end")


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
        self.commander = Commander(profile, reach=make_shadow(profile), dry_run=dry_run)
        self._latch = latch
        if latch is not None and latch.exists():
            self.commander.latch(f"stopped before this node was started: {latch.read_text()}")
        keys = node.keys
        self._neighbours = Neighbours(node)
        self._chunks = node.listen(keys.all_deltas, Inbox(64))
        self._pose_slot = node.listen(keys.state_pose, Inbox(STATES, SMALL_BYTES))
        self._gripper_slot = node.listen(keys.state_gripper, Inbox(STATES, SMALL_BYTES))
        self._joint_slot = node.listen(keys.state_joint, Inbox(STATES, SMALL_BYTES))
        self._settings: list[tuple[str, Mailbox, Callable[[bytes], Any]]] = [
            ("stop", node.listen(keys.stop, Mailbox(8, ANYTHING)), lambda _: None),
            ("reset", node.listen(keys.reset, Mailbox(8, ANYTHING)), lambda _: None),
            ("prompt", node.listen(keys.prompt, Mailbox(16, WORDS)), settings.decode_text),
            ("worker", node.listen(keys.worker, Mailbox(16, WORDS)), settings.decode_name),
            ("rate", node.listen(keys.rate, Mailbox(16, WORDS)), settings.decode_rate),
            ("active", node.listen(keys.active, Mailbox(16, WORDS)), settings.decode_bool),
        ]
        self._pose_out = node.stream(keys.command_pose, Kind.CONTROL)
        self._joint_out = node.stream(keys.command_joint, Kind.CONTROL)
        self._gripper_out = node.stream(keys.command_gripper, Kind.ORDER)
        self._task_out = node.stream(keys.task, Kind.CONTROL)
        self._speakers = {
            kind: Speaker(profile.timing.state_timeout_s)
            for kind in (PoseState, JointState, GripperState)
        }
        self._latency = {stage: Percentiles() for stage in STAGES}
        ticks = round(SPREAD_S * profile.timing.command_hz)
        self._cost_us, self._late_us = Percentiles(ticks), Percentiles(ticks)
        self._rate = RateMeter()
        self._last_task = self._last_clock = 0.0
        self._realtime = False
        self._was_at_rest = True
        self._answer_settings()

    def _answer_settings(self) -> None:
        task = self.commander
        keys = self.node.keys
        for key, value in (
            (keys.prompt, lambda: task.task.prompt),
            (keys.worker, lambda: task.task.worker),
            (keys.rate, lambda: f"{task.task.rate_hz:g}"),
            (keys.active, lambda: "true" if task.task.active else "false"),
        ):
            self.node.answer(key, self._text_reply(key, value))
        self.node.answer(keys.task, lambda query: query.reply(keys.task, records.encode(task.task)))

    @staticmethod
    def _text_reply(key: str, value: Callable[[], str]) -> Callable[[zenoh.Query], None]:
        return lambda query: query.reply(key, value().encode())

    # -- running ------------------------------------------------------------------------------
    def run(self, stop: threading.Event) -> None:
        """Command until `stop` is set, then brake, then end."""
        sys.setswitchinterval(SWITCH_INTERVAL_S)
        gc.collect()
        gc.freeze()
        with realtime_thread() as self._realtime:
            self._loop(stop)
        self.node.report("stopped", now=True)
        self.node.close()

    def _loop(self, stop: threading.Event) -> None:
        loop = FixedRate(self.node.profile.timing.command_hz)
        give_up = 0.0
        while True:
            tick = loop.wait()
            self._late_us.add(tick.stall_s * 1e6)
            extra: list[Setting] = []
            if tick.periods > 1:
                self.node.counters["command.missed_ticks"] += tick.periods - 1
                extra += self._after_a_stall(tick)
            if stop.is_set():
                give_up = give_up or time.monotonic() + BRAKE_BEFORE_EXIT_S
                extra.append(Setting("active", False))
                if not self.commander.streaming or time.monotonic() > give_up:
                    break
            self._turn(extra, tick.periods, tick.nominal_ns)

    def _after_a_stall(self, tick: Tick) -> list[Setting]:
        if tick.stall_s <= self.node.profile.timing.command_timeout_s:
            return []
        why = f"the command loop stood still for {tick.stall_s:.3f} s"
        return [Setting("lose", f"{why}, {tick.computed_s:.3f} s of it at work")]

    def _turn(self, extra: list[Setting], periods: int, nominal_ns: int) -> None:
        began = time.perf_counter()
        now_ns = self.node.clock.wall_at(nominal_ns)
        inputs = self._gather(now_ns)
        inputs.settings = [*inputs.settings, *extra]
        limit = max(1, int(self.node.profile.timing.command_timeout_s * self._hz))
        out = self.commander.step(inputs, now_ns, min(periods, limit))
        self._publish(out, now_ns)
        if any(event.kind == "transition" for event in out.events):
            self._keep_latch()
        self._rate.tick()
        self._cost_us.add((time.perf_counter() - began) * 1e6)
        self._report(out)

    def _keep_latch(self) -> None:
        if self._latch is None:
            return
        if self.commander.state in (State.STOPPED, State.FAULT):
            self._latch.write_text(self.commander.why)
        else:
            self._latch.unlink(missing_ok=True)

    @property
    def _hz(self) -> float:
        return self.node.profile.timing.command_hz

    # -- in -----------------------------------------------------------------------------------
    def _gather(self, now_ns: int) -> Inputs:
        put = self._settings_put()
        around = self._neighbours.look(now_ns)
        chunks = [self._chunk(arrival) for arrival in self._chunks.take_all()]
        clock = self._check_clock()
        return Inputs(
            settings=[*put, *clock],
            chunks=[chunk for chunk in chunks if chunk is not None],
            pose=self._state(PoseState, self._pose_slot),
            joint=self._joints(put),
            gripper=self._state(GripperState, self._gripper_slot),
            around=around,
        )

    def _settings_put(self) -> list[Setting]:
        """What was put since the last tick, in the order in which the router saw it.

        Each setting has a mailbox of its own, so that a flood of one does not push out another.
        Between peers without a router nobody stamps samples: each key's own order is kept then.
        """
        arrivals = [
            (name, decode, arrival)
            for name, inbox, decode in self._settings
            for arrival in inbox.take_all()
        ]
        stamps = [
            stamp.get_time() for *_, arrival in arrivals if (stamp := arrival.sample.timestamp)
        ]
        if len(stamps) == len(arrivals):
            order = sorted(range(len(arrivals)), key=stamps.__getitem__)
            arrivals = [arrivals[index] for index in order]
        put: list[Setting] = []
        for name, decode, arrival in arrivals:
            if name in ("stop", "reset"):
                put.append(Setting(name))
                continue
            value = self.node.read_text(decode, arrival)
            if value is not None:
                put.append(Setting(name, value))
        return put

    def _chunk(self, arrival: Arrival) -> Stamped[ActionChunk] | None:
        """A chunk by the worker whose key it came on, None for any other."""
        worker = key_names.last(str(arrival.sample.key_expr))
        owner = self._neighbours.owner(worker)
        try:
            source = self.node.header(arrival).source
        except CodecError as error:
            self.node.refuse(error.reason, f"delta/{worker}: {error}")
            return None
        if owner is not None and source != owner:  # before its payload is looked at: it may be many
            self.node.refuse(
                "foreign", f"delta/{worker} by {source[:60]!r}, the worker is {owner[:60]!r}"
            )
            return None
        chunk = self.node.read(ActionChunk, arrival)
        if chunk is not None and chunk.record.worker != worker:
            self.node.refuse("foreign", "a chunk on another worker's delta key")
            return None
        return chunk

    def _state(self, kind: type[Any], slot: Inbox) -> Stamped[Any] | None:
        """The newest state by the writer that speaks for the robot, whoever else writes."""
        newest: Stamped[Any] | None = None
        for arrival in slot.take_all():
            newest = self.node.read(kind, arrival, self._speakers[kind]) or newest
        return newest

    def _joints(self, put: list[Setting]) -> Stamped[JointState] | None:
        """Joints are looked at when the arm is given to somebody; decoding them costs."""
        if not any(setting.name in ("active", "worker") for setting in put):
            return None
        return self._state(JointState, self._joint_slot)

    def _check_clock(self) -> list[Setting]:
        if time.monotonic() - self._last_clock < CLOCK_PERIOD_S:
            return []
        self._last_clock = time.monotonic()
        step_s = self.node.clock.follow()
        if abs(step_s) <= self.node.profile.timing.max_clock_step_s:
            return []
        self.node.refuse("clock_step", f"the wall clock was set by {step_s:+.3f} s")
        return [Setting("lose", f"the wall clock was set by {step_s:+.3f} s")]

    # -- out ----------------------------------------------------------------------------------
    def _publish(self, out: Outputs, now_ns: int) -> None:
        if out.pose is not None:
            self._pose_out.put(out.pose, stamp_wall_ns=now_ns)
        if out.joint is not None:
            self._joint_out.put(out.joint, stamp_wall_ns=now_ns)
        if out.gripper is not None:
            self._gripper_out.put(out.gripper)
        for refusal in out.refusals:
            kind = "skipped" if refusal.quiet else "refused"
            self.node.counters[f"{kind}.{refusal.reason}"] += 1
        for event in out.events:
            self.node.tell(event)
        if out.accepted is not None:
            self._measure(out.accepted)
        due = time.monotonic() - self._last_task >= TASK_PERIOD_S
        if out.task_changed or due:
            self._last_task = time.monotonic()
            self._task_out.put(self.commander.task)

    def _measure(self, cause: Cause) -> None:
        published_ns = self.node.clock.wall_ns()
        steps_ms = (
            cause.observed_ns - cause.observation_stamp_ns,
            cause.inference_end_ns - cause.inference_start_ns,
            cause.received_ns - cause.published_ns,
            published_ns - cause.received_ns,
            published_ns - cause.observation_stamp_ns,
        )
        for stage, nanoseconds in zip(STAGES, steps_ms, strict=True):
            self._latency[stage].add(nanoseconds / 1e6)

    def _report(self, out: Outputs) -> None:
        mind = self.commander
        # An event is news of a change, so status says the same at once.
        now = any(event.kind == "transition" for event in out.events) or out.task_changed
        now = now or mind.at_rest != self._was_at_rest
        self._was_at_rest = mind.at_rest
        if not now and not self.node.report_due(mind.state.value):
            return
        task = mind.task
        wall_ns = self.node.clock.wall_ns()
        ages_s = {
            name: (wall_ns - stamped.received_ns) / 1e9
            for name, stamped in (("pose", mind.pose), ("gripper", mind.gripper_state))
            if stamped is not None
        }
        latency = {name: meter.summary() for name, meter in self._latency.items()}
        self.node.counters["command.smoothing_failures"] = mind.smoothing_failures
        self.node.counters["command.gripper_timeouts"] = mind.gripper.timeouts
        self.node.counters["command.chunks_dropped"] = self._chunks.dropped
        self.node.report(
            mind.state.value,
            detail={
                "why": mind.why[:MAX_WHY],
                "prompt": task.prompt,
                "worker": task.worker,
                "rate_hz": task.rate_hz,
                "episode": task.episode,
                "accepted_chunks": mind.accepted_chunks,
                "accepted_steps": mind.accepted_steps,
                "policy_done": mind.policy_done,
                "at_rest": mind.at_rest,
                "streaming": mind.streaming,
                "speed_share": round(mind.speed, 3),
                "tracking_mm": round(mind.tracking_m * 1e3, 3),
                "tracking_mrad": round(mind.tracking_rad * 1e3, 3),
                "tick_us": self._cost_us.spread(),
                "late_us": self._late_us.spread(),
                "realtime": self._realtime,
                "dry_run": mind.dry_run,
                **self._goal(),
                **self._margins(),
            },
            ages_s=ages_s,
            rates_hz={"loop": self._rate.rate_hz},
            latency_ms={name: values for name, values in latency.items() if values},
            now=now,
        )

    def _goal(self) -> dict[str, Any]:
        goal = self.commander.goal
        if goal is None:
            return {}
        return {
            "goal_m": [round(float(value), 6) for value in goal.pose.position_m],
            "goal_quat_xyzw": [round(float(v), 6) for v in quat_from_rotation(goal.pose.rotation)],
            "goal_width_m": round(goal.width_m, 5),
        }

    def _margins(self) -> dict[str, Any]:
        """Room the arm has at its goal."""
        reach = self.commander.reach
        if reach is None or self.commander.goal is None:
            return {}
        room = reach.margins
        return {
            "joint_margin_rad": round(room.joint_rad, 4),
            "joint_margin_of": room.joint,
            "singular_value": round(room.singular_value, 4),
            "self_distance_m": round(room.self_m, 4) if math.isfinite(room.self_m) else None,
            "table_distance_m": round(room.table_m, 4) if math.isfinite(room.table_m) else None,
        }
