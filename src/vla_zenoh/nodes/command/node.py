"""The command node: clock, session, publishers and status of a `Commander`."""

from __future__ import annotations

import gc
import math
import sys
import threading
import time
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import zenoh

from vla_zenoh.bus.clock import FixedRate, Tick
from vla_zenoh.bus.metrics import Percentiles, RateMeter
from vla_zenoh.bus.node import Node
from vla_zenoh.codec import records, settings
from vla_zenoh.control.commanded_part import CommandedPart
from vla_zenoh.control.commander import Commander, Outputs, Setting
from vla_zenoh.control.reachability import ReachabilityFilter
from vla_zenoh.control.states import State
from vla_zenoh.errors import CodecError
from vla_zenoh.keys import Kind
from vla_zenoh.kinematics.so3 import quat_from_rotation
from vla_zenoh.nodes.command.inputs import CommandInputs
from vla_zenoh.profile import Profile
from vla_zenoh.runtime.kept_text import KeptText
from vla_zenoh.runtime.process import realtime_thread
from vla_zenoh.types import LATENCY_STAGES, Cause, Event

TASK_PERIOD_S = 0.2
HOLDS = "what the gripper holds"
BRAKE_BEFORE_EXIT_S = 1.0
SWITCH_INTERVAL_S = 5e-4
MAX_WHY, MAX_LIMIT = 2000, 200
CHORES_S = 0.05
"""Period of tasks that no motion depends on: status, clock queries, reading other nodes' status."""
PLANNING_NS = 1_500_000
"""A chunk is planned this long before the next tick, or at once if it arrives later. Its other
readers get it first: planning at a real-time priority keeps a processor from them. Where the period
is shorter, so that a tick would be missed, it is planned after the next tick."""
REST_S, REST_TIMEOUTS = 0.02, 5
"""Period of the ticks while the arm rests, and how many of them a command timeout has at least."""
REST_AFTER_NS = 100_000_000
LONGEST_PLAN_NS = 600_000_000_000
"""A step that is due later than this is due before the wall clock was set."""
ACTING_S = 1.0
"""Limits that shorten steps act once for each chunk."""
SPREAD_S = 8.0
"""Window of the distributions of tick cost and lateness in status."""
CHUNKS = 128
"""Chunks in the latencies of status: at 10 Hz those of the last 13 s."""


class CommandNode:
    """Runs a `Commander` at ``timing.command_hz`` between its subscriptions and publishers.

    While the arm rests and no step is due, it ticks every `REST_S`; a chunk ends that at once.

    Args:
        profile, session: the caller closes the session.
        dry_run: compute everything, publish no command.
        latch: file that exists while an emergency stop or a fault is latched, so that a restarted
            command node is stopped as well; beside it is a file of what each gripper holds.
    """

    def __init__(
        self,
        profile: Profile,
        session: zenoh.Session,
        *,
        dry_run: bool = False,
        latch: Path | None = None,
    ) -> None:
        parts = {name: profile.of_part(name) for name in profile.part_names}
        # Before the node is alive: this computes for long, without letting other threads run.
        reach = {name: ReachabilityFilter(part) for name, part in parts.items()}
        node = self.node = Node("command", profile, session)
        self.commander = Commander(profile, reach=reach, dry_run=dry_run)
        self._latch = KeptText(latch)
        before = self._latch.read()
        if before is not None:
            self.commander.latch(f"stopped before this node was started: {before}")
        self._holds = {
            name: KeptText(latch and latch.with_name(f"{latch.name}-holds{name}"), HOLDS)
            for name in parts
        }
        self._restored = [*self._held_before()]
        keys = node.keys
        self._inputs = CommandInputs(node)
        self._status = CommandStatus(node, self.commander)
        self._outs = {
            name: (
                node.declare_publisher(part.keys.command_pose, Kind.CONTROL),
                node.declare_publisher(part.keys.command_joint, Kind.CONTROL),
                node.declare_publisher(part.keys.command_gripper, Kind.ORDER),
            )
            for name, part in parts.items()
        }
        self._task_out = node.declare_publisher(keys.task, Kind.CONTROL)
        self._last_task = 0.0
        self._next_chores_ns = self._busy_ns = 0
        self._serve_settings()

    def _held_before(self) -> Iterator[Setting]:
        """What the grippers held when the node before this one ended."""
        for name, kept in self._holds.items():
            text = kept.read()
            try:
                box = settings.decode_held((text or "").encode())
            except CodecError as error:
                why = f"{HOLDS} is not known any more: {error}; put it again"
                self.node.emit(Event("error", "fault", "held", why))
                continue
            if box:
                yield Setting("held", box, part=name)

    def _keep_held(self) -> None:
        for part in self.commander.parts:
            self._holds[part.name].set(None if part.held is None else str(part.held))

    def _serve_settings(self) -> None:
        commander, keys = self.commander, self.node.keys
        for key, value in (
            (keys.prompt, lambda: commander.task.prompt),
            (keys.worker, lambda: commander.task.worker),
            (keys.rate, lambda: f"{commander.task.rate_hz:g}"),
            (keys.speed, lambda: f"{commander.task.speed_percent:g}"),
            (keys.active, lambda: "true" if commander.task.active else "false"),
        ):
            self.node.serve(key, lambda query, key=key, value=value: query.reply(key, value()))
        self.node.serve(
            keys.task, lambda query: query.reply(keys.task, records.encode(commander.task))
        )

    def run(self, stop: threading.Event) -> None:
        """Run until `stop` is set, then brake and exit.

        Raises:
            NodeError: another node of this name was there already.
        """
        sys.setswitchinterval(SWITCH_INTERVAL_S)
        gc.collect()
        gc.freeze()
        try:
            with realtime_thread() as self._status.realtime:
                self._loop(stop)
        finally:
            for kept in (self._latch, *self._holds.values()):
                kept.close()
            self.node.publish_end()
            self.node.close()
            gc.unfreeze()  # so that the interpreter frees everything at exit

    def _loop(self, stop: threading.Event) -> None:
        timing, arrival = self.node.profile.timing, self._inputs.chunk_arrival
        loop = FixedRate(timing.command_hz)
        rest_s = min(REST_S, timing.command_timeout_s / REST_TIMEOUTS)
        rest_periods = max(int(rest_s * timing.command_hz), 1)
        give_up = 0.0
        tick_first = PLANNING_NS * timing.command_hz > 1e9
        while True:
            arrived = loop.wait_for(arrival)
            if arrived:
                loop.resume()
                if not tick_first:
                    loop.wait_until(PLANNING_NS)
                    self._prepare(loop.next_ns)
            tick = loop.wait()
            if tick.periods > 1:
                self.node.counters["command.missed_ticks"] += tick.periods - 1
            extra: list[Setting] = []
            if tick.stall_s > timing.command_timeout_s:
                why = f"the command loop stood still for {tick.stall_s:.3f} s"
                why = f"{why}, {tick.computed_s:.3f} s of it computing"
                if tick.computed_s < tick.stall_s / 2:
                    why += ": this computer was too busy with something else, or suspended"
                extra = [Setting("lose", why)]
            if stop.is_set():
                give_up = give_up or time.monotonic() + BRAKE_BEFORE_EXIT_S
                extra.append(Setting("active", False))
                if not self.commander.streaming or time.monotonic() > give_up:
                    break
            plans = arrived and tick_first
            if self._on_tick(extra, tick, take_chunks=not plans):
                loop.skip(rest_periods)
            if plans:
                loop.resume()
                self._prepare(loop.next_ns)

    def _prepare(self, next_mono_ns: int) -> None:
        """Plan chunks that arrived, so that the next tick need not."""
        began = time.perf_counter()
        inputs = self._inputs.poll_streams()
        if inputs.chunks:
            self._busy_ns = next_mono_ns
        self.commander.prepare(inputs, self.node.clock.wall_at(next_mono_ns))
        self._status.chunk_us.add((time.perf_counter() - began) * 1e6)

    def _on_tick(self, extra: list[Setting], tick: Tick, *, take_chunks: bool) -> bool:
        """Returns whether the arm rests."""
        began = time.perf_counter()
        now_ns = self.node.clock.wall_at(tick.nominal_ns)
        chores = tick.nominal_ns >= self._next_chores_ns
        if chores:
            self._next_chores_ns = tick.nominal_ns + round(CHORES_S * 1e9)
        inputs = self._inputs.poll(now_ns, take_chunks=take_chunks)
        inputs.settings = [*self._restored, *inputs.settings, *extra]
        self._restored = []
        timing = self.node.profile.timing
        limit = max(1, int(timing.command_timeout_s * timing.command_hz))
        out = self.commander.step(inputs, now_ns, min(tick.periods, limit))
        self._command(out, now_ns)
        self._status.add_tick(now_ns, tick.stall_s, time.perf_counter() - began)
        self._report(out, now_ns)
        if any(event.kind == "transition" for event in out.events):
            latched = self.commander.state in (State.STOPPED, State.FAULT)
            self._latch.set(self.commander.why if latched else None)
        if any(event.what == "gripper_holds" for event in out.events):
            self._keep_held()
        if chores:
            self._inputs.read_news(now_ns)
        if chores or out.events or out.task_changed:
            for kept in (self._latch, *self._holds.values()):
                why = kept.failure()
                if why is None:
                    continue
                self.node.counters["command.latch_failed"] += 1
                self.node.emit(Event("error", "fault", "latch", why))
            self._status.publish(out, self._inputs.chunks.dropped)
        busy = inputs.chunks or inputs.settings or not self.commander.at_rest
        if busy or any(self._awaits(part, now_ns) for part in self.commander.parts):
            self._busy_ns = tick.nominal_ns
        return tick.nominal_ns - self._busy_ns > REST_AFTER_NS

    def _awaits(self, part: CommandedPart, now_ns: int) -> bool:
        """Whether a part at rest has a step or a chunk to come, or loads that a filter smooths."""
        if part.planner.waiting or (self.commander.state is State.ACTIVE and part.contact.known):
            return True
        timeline = part.motion.timeline
        if timeline is None or timeline.clock.override <= 0.0:
            return False
        return 0 < timeline.plan.end_ns - now_ns < LONGEST_PLAN_NS

    def _command(self, out: Outputs, now_ns: int) -> None:
        for name, (pose, joint, gripper) in self._outs.items():
            commands = out.of(name)
            if commands.pose is not None:
                pose.publish(commands.pose, stamp_wall_ns=now_ns)
            if commands.joint is not None:
                joint.publish(commands.joint, stamp_wall_ns=now_ns)
            if commands.gripper is not None:
                gripper.publish(commands.gripper)

    def _report(self, out: Outputs, now_ns: int) -> None:
        for rejection in out.rejections:
            kind = "skipped" if rejection.quiet else "refused"
            self.node.counters[f"{kind}.{rejection.reason}"] += 1
        for event in out.events:
            self.node.emit(event)
        if out.accepted is not None:
            self._status.add_chunk(out.accepted)
        due = time.monotonic() - self._last_task >= TASK_PERIOD_S
        if out.task_changed or due:
            self._last_task = time.monotonic()
            # Plan time runs at its speed override from this tick on.
            self._task_out.publish(self.commander.task, stamp_wall_ns=now_ns)


class CommandStatus:
    """Collects tick costs and chunk latencies, and publishes the status of the command node."""

    def __init__(self, node: Node, commander: Commander) -> None:
        self._node, self._commander = node, commander
        ticks = round(SPREAD_S * node.profile.timing.command_hz)
        self._latency = {stage: Percentiles(CHUNKS) for stage in LATENCY_STAGES}
        self._cost_us, self._late_us = Percentiles(ticks), Percentiles(ticks)
        self._pose_age_ms = Percentiles(ticks)
        self.chunk_us = Percentiles(CHUNKS)
        """Cost of planning chunks between two ticks."""
        self._rate = RateMeter()
        self._was_at_rest = True
        self._limits: dict[str, tuple[str, float]] = {}
        simulated = node.profile.robot.driver == "sim"
        self._mode = "dry_run" if commander.dry_run else "sim" if simulated else "live"
        self.realtime = False

    def add_tick(self, now_ns: int, late_s: float, cost_s: float) -> None:
        """Add a tick for `now_ns` that started `late_s` late and took `cost_s`."""
        stamps_ns = [part.pose.header.stamp_wall_ns for part in self._commander.parts if part.pose]
        if stamps_ns:
            self._pose_age_ms.add((now_ns - min(stamps_ns)) / 1e6)
        self._late_us.add(late_s * 1e6)
        self._rate.tick()
        self._cost_us.add(cost_s * 1e6)

    def add_chunk(self, cause: Cause) -> None:
        """Add the latencies of a chunk that came into force."""
        published_ns = self._node.clock.wall_ns()
        for stage, duration_ms in cause.latency_ms(published_ns).items():
            self._latency[stage].add(duration_ms)

    def publish(self, out: Outputs, chunks_dropped: int) -> None:
        """Publish status when it is due, and at once after a change."""
        commander = self._commander
        for event in out.events:
            if event.kind == "limit":
                self._limits[event.what] = (event.why, time.monotonic())
        now = any(event.kind == "transition" for event in out.events) or out.task_changed
        now = now or commander.at_rest != self._was_at_rest
        self._was_at_rest = commander.at_rest
        if not now and not self._node.status_due(commander.state.value):
            return
        task = commander.task
        wall_ns = self._node.clock.wall_ns()
        ages_s = {
            f"{part.name}/{name}" if part.name else name: (wall_ns - stamped.received_ns) / 1e9
            for part in commander.parts
            for name, stamped in (("pose", part.pose), ("gripper", part.gripper_state))
            if stamped is not None
        }
        of_parts = {part.name: _part_detail(part) for part in commander.parts}
        several = of_parts.get("", {"parts": of_parts})
        if commander.spacing is not None:
            near = commander.spacing.nearest
            several["part_distance_m"] = round(near.distance_m, 4) if near.first else None
        latency = {name: meter.summary() for name, meter in self._latency.items()}
        self._node.counters["command.smoothing_failures"] = sum(
            part.motion.failures for part in commander.parts
        )
        self._node.counters["command.gripper_timeouts"] = sum(
            part.gripper.timeouts for part in commander.parts if part.gripper
        )
        self._node.counters["command.chunks_dropped"] = chunks_dropped
        self._node.publish_status(
            commander.state.value,
            detail={
                "why": commander.why[:MAX_WHY],
                "prompt": task.prompt,
                "worker": task.worker,
                "rate_hz": task.rate_hz,
                "speed_percent": task.speed_percent,
                "episode": task.episode,
                "accepted_chunks": commander.progress.chunks,
                "accepted_steps": commander.progress.steps,
                "policy_done": commander.progress.done,
                "held_by": commander.deadman.name if task.active else "",
                "at_rest": commander.at_rest,
                "streaming": commander.streaming,
                "speed_share": round(min(part.motion.scaling.share for part in commander.parts), 3),
                "tracking_mm": _most(part.tracking.apart_m for part in commander.parts),
                "tracking_mrad": _most(part.tracking.apart_rad for part in commander.parts),
                "elbow_mrad": _most(part.elbow_rad for part in commander.parts),
                "tick_us": self._cost_us.spread(),
                "chunk_us": self.chunk_us.spread(),
                "late_us": self._late_us.spread(),
                "pose_age_ms": self._pose_age_ms.spread(),
                "realtime": self.realtime,
                "mode": self._mode,
                "limits": self._acting_limits(),
                **several,
            },
            ages_s=ages_s,
            rates_hz={"loop": self._rate.rate_hz},
            latency_ms={name: values for name, values in latency.items() if values},
            now=now,
        )

    def _acting_limits(self) -> list[str]:
        """Limits that acted in the last `ACTING_S`, and what slows the arm down now."""
        oldest_s = time.monotonic() - ACTING_S
        self._limits = {name: hit for name, hit in self._limits.items() if hit[1] > oldest_s}
        acting = {name: why for name, (why, _) in self._limits.items()}
        for part in self._commander.parts:
            slower = part.motion.scaling.slower if part.motion.streaming else None
            if slower is not None:
                acting[slower.name] = part.says(f"{slower.share:.0%} of the speed{slower.at}")
        return [f"{name}: {why}"[:MAX_LIMIT] for name, why in sorted(acting.items())]


def _most(values: Iterable[float]) -> float:
    """The largest value, in thousandths of its unit."""
    return round(max(values) * 1e3, 3)


def _part_detail(part: CommandedPart) -> dict[str, Any]:
    """Goal, margins and external load of a part; None where a load is not measured."""
    detail: dict[str, Any] = {}
    goal, reach, contact = part.motion.goal, part.reach, part.contact
    if part.held is not None:
        detail["gripper_holds"] = str(part.held)
    if goal is not None:
        quat_xyzw = quat_from_rotation(goal.pose.rotation)
        detail["goal_m"] = [round(float(value), 6) for value in goal.pose.position_m]
        detail["goal_quat_xyzw"] = [round(float(value), 6) for value in quat_xyzw]
        if part.gripper is not None:
            detail["goal_width_m"] = round(goal.width_m, 5)
    if reach is not None and goal is not None:
        room = reach.margins
        detail["joint_margin_of"] = room.joint
        detail["singular_value"] = round(room.singular_value, 4)
        for name, room_left in (
            ("joint_margin_rad", room.joint_rad),
            ("self_distance_m", room.self_m),
            ("table_distance_m", room.table_m),
            ("keep_out_distance_m", room.keep_out_m),
        ):
            detail[name] = round(room_left, 4) if math.isfinite(room_left) else None
    force_n, torque_nm = contact.force_n, contact.torque_nm
    detail["external_force_n"] = None if force_n is None else round(force_n, 2)
    detail["external_torque_nm"] = None if torque_nm is None else round(torque_nm, 2)
    return detail
