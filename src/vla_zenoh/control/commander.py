"""Core of the command node: turns action chunks and settings into a bounded, smooth pose stream.

`Commander.step` is called once per tick with everything received since the last one. It has no
clock, no thread and no session; the same inputs give the same outputs, in a test, in lockstep with
a simulator and on the robot.

This module handles state and settings, which all parts of a robot have in common: one reason to
brake, of whichever part, and all of them brake in that tick. `CommandedPart` has what each arm has
of its own: `ChunkPlanner` makes plans of chunks, `MotionPipeline` makes commands of plans, and
each `Monitor` may find a reason to brake.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

from vla_zenoh.control.chunk_planner import ChunkOutcome
from vla_zenoh.control.commanded_part import CommandedPart
from vla_zenoh.control.commander_io import Inputs, Outputs, Setting, limit_events, make_event
from vla_zenoh.control.lateness import Lateness
from vla_zenoh.control.monitor import Brake, PartSnapshot, too_near
from vla_zenoh.control.part_spacing import PartSpacing
from vla_zenoh.control.plan_timeline import EpisodeProgress
from vla_zenoh.control.policy_check import Lease, Rejection, joints_by_pose
from vla_zenoh.control.preflight import (
    STOP_LATCHED,
    Passing,
    PeerSnapshot,
    reasons_of_worker,
    why_not_ready,
)
from vla_zenoh.control.reachability import ReachabilityFilter
from vla_zenoh.control.states import DEACTIVATED, OBEYING, State, Trigger
from vla_zenoh.control.watchdog import Deadman, Watchdog
from vla_zenoh.errors import RecordError
from vla_zenoh.profile import Profile
from vla_zenoh.types import MAX_TEXT, ActionChunk, GripperState, HeldBox, Stamped, Task

ANSWER_S, MAX_ANSWER_S = 1.0, 2.0
"""A worker answers a new prompt within this and one period of its rate; at most the latter, as
clients wait 3 s for an activation."""
EMERGENCY_STOP = "emergency stop"
"""Why the state is STOPPED, whether this node heard the stop or the robot node told of it first."""
LATE_NS = 10_000_000_000
"""A setting that was put before a stop arrives at most this long after it. Stamps that say so later
are those of a clock that was set."""


class Commander:
    """State machine, settings and one tick of the command node.

    Args:
        profile: limits, timing and initial settings.
        reach: bounds goals by the arm's kinematics, of a robot of parts one for each; None: only
            the workspace box does, and joints cannot be commanded.
        dry_run: compute everything, stream nothing.

    Raises:
        ProfileError: joints are to be commanded and there is no `reach`.
    """

    def __init__(
        self,
        profile: Profile,
        *,
        reach: ReachabilityFilter | Mapping[str, ReachabilityFilter] | None = None,
        dry_run: bool = False,
    ) -> None:
        self.profile = profile
        reaches = reach if isinstance(reach, Mapping) else {"": reach}
        self.parts: tuple[CommandedPart, ...] = tuple(
            CommandedPart(profile.of_part(name), reaches.get(name)) for name in profile.part_names
        )
        self.dry_run = dry_run
        self.state = State.INACTIVE
        self.why = "not activated yet"
        self._ended = ""  # why the last activation did, if not on request
        asked = profile.task
        self._awaited: str | None = None
        """Holder of an activation that waits until the worker has heard the newest prompt."""
        self._asked_ns = -(10**18)
        """When prompt or worker changed last."""
        self.task = Task(0, False, asked.prompt, asked.worker, asked.rate_hz, asked.speed_percent)
        self.lease: Lease | None = None
        self.progress, self.deadman = EpisodeProgress(), Deadman()
        self._resumed_ns = 0
        self._peers = PeerSnapshot()
        self._latest: dict[str, Stamped[ActionChunk]] = {}
        several = profile.parts and all(part.reach for part in self.parts)
        self.spacing = PartSpacing(profile, self.parts) if several else None
        first = self.parts[0]
        # All parts have the same chunks at the same time: one queue, one deadline.
        self._planner, self._motion = first.planner, first.motion
        self._watchdog = Watchdog(profile.timing)
        self._stop_put_ns = self._stop_came_ns = 0
        """Of the last emergency stop: when it was put, by the router's clock, and its tick."""
        self._lateness = Lateness(1.0 / profile.timing.command_hz)
        self._out = Outputs()
        self._prepared = False

    # -- one tick -----------------------------------------------------------------------------
    def prepare(self, inputs: Inputs, next_ns: int) -> None:
        """Plan chunks that came before the next tick, which has less to do then.

        The commands are those that `step` computes if it gets these inputs; events and rejections
        are among its outputs. At most once between two ticks.

        Args:
            inputs: chunks and states; settings and peers are left to `step`.
            next_ns: `now_ns` of the next call of `step`.
        """
        self._update(inputs)
        self._take_chunks(inputs.chunks, next_ns)
        self._prepared = True

    def step(self, inputs: Inputs, now_ns: int, ticks: int = 1) -> Outputs:
        """Process the inputs of one tick.

        Args:
            inputs: everything received since the last call.
            now_ns: nominal time of this tick on the wall clock of this node, which must not jump.
            ticks: periods since the last call. More than one after a late wake-up: the motion is a
                function of time, so the same trajectory is sampled later, no faster.
        """
        task_before, out, parts = self.task, self._out, self.parts
        self._lateness.add(ticks - 1, now_ns)
        self._update(inputs)
        self._apply_settings(inputs.settings, now_ns)
        self._take_chunks(inputs.chunks, now_ns)
        if self._awaited is not None:
            self._activate(now_ns, self._awaited)
        self._prepared = False
        self._supervise(now_ns)
        for part in parts:
            try:
                part.follow_elbow(obeying=self.state in OBEYING)
            except RecordError as error:
                self._change(Trigger.LOSE, part.says(str(error)))
        if self.spacing is not None:
            self._keep_apart(self.spacing, now_ns, ticks)
        overdue_ns, all_planned = self._watchdog.deadline_ns, True
        for part in parts:
            planned, events = part.motion.advance(self.state, self.task, overdue_ns, now_ns, ticks)
            out.events += part.tagged(events)
            all_planned = all_planned and planned
        if not all_planned:
            self._change(Trigger.FAULT, "no trajectory could be computed; braked")
        if self.state is State.ACTIVE and self._motion.timeline is not None:
            self.progress.update(self._motion.timeline, self.task.episode, now_ns)
        for part in parts if not self.dry_run else ():
            commands = part.commands(self.state, now_ns)
            if part.name:
                out.parts[part.name] = commands
            else:
                out.pose, out.joint, out.gripper = commands
        if self.task.active != (self.state in OBEYING):  # `prepare` may have changed the state
            self.task = replace(self.task, active=self.state in OBEYING)
        out.task_changed = self.task is not task_before and self.task != task_before
        self._out = Outputs()
        return out

    # -- state of the arms ---------------------------------------------------------------------
    @property
    def at_rest(self) -> bool:
        """The commanded motion stands still, and will."""
        return all(part.motion.at_rest for part in self.parts) and not self.retreating

    @property
    def streaming(self) -> bool:
        """Commands are being published."""
        return any(part.motion.streaming for part in self.parts)

    @property
    def retreating(self) -> bool:
        """An arm retreats from what blocked it."""
        return any(part.retreat.busy for part in self.parts)

    # -- states and settings ------------------------------------------------------------------
    def _update(self, inputs: Inputs) -> None:
        if inputs.peers is not None:
            self._peers = inputs.peers
        for part in self.parts:
            if self._peers.robot_node not in self._peers.alive:
                part.forget_states()
                continue
            states, before = inputs.of(part.name), part.gripper_state
            part.update(states)
            # Once, when it begins: after a reset the robot's last state may still say so.
            latched = _latched(states.gripper) and not _latched(before)
            if latched and self.state is not State.STOPPED:
                self._change(Trigger.STOP, EMERGENCY_STOP)
            if part.held is not None and part.let_go:
                self._hold(part, None)
            why = why_not_ready(states.gripper.record) if states.gripper else ""
            if states.gripper and why:
                faulty = states.gripper.record.faults
                self._change(Trigger.FAULT if faulty else Trigger.LOSE, part.says(why))

    def _apply_settings(self, settings: Sequence[Setting], now_ns: int) -> None:
        stops = [setting for setting in settings if setting.name == "stop"]
        if any(setting.name in ("stop", "reset", "active") for setting in settings):
            self._awaited = None
        if stops:
            self._change(Trigger.STOP, EMERGENCY_STOP)
            put_ns = max(stop.put_ns or 0 for stop in stops)
            if 0 <= now_ns - self._stop_came_ns < LATE_NS:  # it may be the older one
                put_ns = max(put_ns, self._stop_put_ns)
            self._stop_put_ns, self._stop_came_ns = put_ns, now_ns
        for setting in settings:
            try:
                self._set(setting, now_ns, stopped=bool(stops))
            except RecordError as error:
                self._reject_setting(setting.name, [str(error)])

    def _set(self, setting: Setting, now_ns: int, *, stopped: bool) -> None:
        name, value, put_ns, of_part = setting
        if name == "reset" or (name == "active" and value is not False):
            if stopped:  # their order within a tick is not known: the stop wins
                raise RecordError("an emergency stop came at the same time")
            overtaken = put_ns is not None and put_ns <= self._stop_put_ns
            if overtaken and 0 <= now_ns - self._stop_came_ns < LATE_NS:
                late = "it was put before the last emergency stop and arrived after it"
                raise RecordError(f"{late}; put it again")
        if name == "prompt" and isinstance(value, str):
            if value != self.task.prompt:
                self._new_episode(now_ns, prompt=value)
        elif name == "worker" and isinstance(value, str):
            if value != self.task.worker:
                self._change_worker(value, now_ns)
        elif name == "rate" and isinstance(value, (int, float)):
            before_hz = self.task.rate_hz
            self.task = replace(self.task, rate_hz=value)
            self._watchdog.rate_changed(now_ns, before_hz, self.task)
        elif name in ("speed", "slower") and isinstance(value, (int, float)):
            if name == "slower" and value > self.task.speed_percent:
                now = f"the {self.task.speed_percent:g} % in force"
                raise RecordError(
                    f"{value:g} % is more than {now}; use the setting speed to go faster"
                )
            if value != self.task.speed_percent:
                self._change_speed(value, now_ns)
        elif name == "active" and (value is True or isinstance(value, str)):
            self._activate(now_ns, "" if value is True else value)
        elif name == "active" and value is False:
            for part in self.parts:
                part.stay()
            self._change(Trigger.DEACTIVATE, DEACTIVATED)
        elif name == "held":
            box = value if isinstance(value, HeldBox) else None
            parts = {part.name: part for part in self.parts}
            if of_part not in parts:
                raise RecordError(f"no part {of_part!r}; known: {', '.join(parts) or 'none'}")
            self._hold(parts[of_part], box)
        elif name == "reset":
            grippers = [part.gripper_state.record for part in self.parts if part.gripper_state]
            faults = [fault for gripper in grippers for fault in gripper.faults]
            if self.state is State.FAULT and faults:
                raise RecordError(f"the robot still reports: {'; '.join(faults)}")
            self._change(Trigger.RESET, "reset")
        elif name == "lose":
            for part in self.parts:
                part.stay()
            self._change(Trigger.LOSE, str(value))
        elif name != "stop":
            raise RecordError(f"{name!r} cannot be set to {value!r}")

    def _hold(self, part: CommandedPart, box: HeldBox | None) -> None:
        if box == part.held:
            return
        part.hold(box)
        if self.spacing is not None:
            self.spacing.place()
        holds = "nothing" if box is None else f"a box of {box} m"
        self._emit("info", "notice", "gripper_holds", part.says(f"the gripper holds {holds}"))

    def _new_episode(self, now_ns: int, **changes: str) -> None:
        # From the wall clock, so that a restarted node never reuses an episode number.
        episode = max(self.task.episode + 1, now_ns // 1_000_000)
        self.task = replace(self.task, episode=episode, **changes)  # pyright: ignore
        self.progress = EpisodeProgress()
        if changes:
            self._ended, self._asked_ns = "", now_ns
        if self.state in OBEYING:
            self._watchdog.expect(None, now_ns, self.task, carries_on=bool(changes))

    def _change_speed(self, percent: float, now_ns: int) -> None:
        before = self.task.speed
        self.task = replace(self.task, speed_percent=percent)
        self._watchdog.override_changed(now_ns, before, self.task.speed)
        # The scene may have changed during a pause: the rest of an old chunk is not executed.
        oldest_ns = now_ns - int(self.profile.timing.max_observation_age_s * 1e9)
        paused = self.state in OBEYING and not before
        forgotten = False
        for part in self.parts if paused else ():
            dropped = part.motion.forget_plan(oldest_ns, now_ns)
            if dropped is not None:
                forgotten = True
                self._out.events += part.tagged(dropped)
        if forgotten:
            self._resumed_ns = now_ns
            self._watchdog.expect(None, now_ns, self.task)
            self._emit("info", "notice", "paused", "waits for a chunk that is newer than the pause")

    def _change_worker(self, worker: str, now_ns: int) -> None:
        if self.state in OBEYING:
            lease, of_parts, of_worker = self._preflight(worker, now_ns)
            if lease is None:
                self._reject_setting("worker", of_parts + of_worker)
                return
            self.lease = lease
        self._new_episode(now_ns, worker=worker)

    def _activate(self, now_ns: int, holder: str) -> None:
        self._awaited = None
        if self.state in OBEYING:
            self._hold_as_well(holder)
            return
        if self.state is not State.INACTIVE:
            why = (
                f"the state is {self.state.value} ({self.why}); clear it with `vla-zenoh "
                "reset`, or put anything on the key reset"
            )
            self._reject_setting("activate", [why])
            return
        lease, of_parts, of_worker = self._preflight(self.task.worker, now_ns)
        reasons = of_parts + of_worker
        if of_worker and not of_parts and self._is_answer_due(now_ns):
            self._awaited = holder
            self.why = f"activation waits for worker {self.task.worker!r}: {'; '.join(reasons)}"[
                :MAX_TEXT
            ]
            return
        reasons += self.deadman.reasons_against(holder, self._peers.holders)
        self._measure()
        for part in self.parts:
            reasons += map(part.says, part.motion.unsettled())
        known = all(part.pose and part.gripper_state for part in self.parts)
        if lease is None or not known or reasons:
            passing = bool(reasons) and all(isinstance(why, Passing) for why in reasons)
            reasons += self._ended_before()
            self._reject_setting("activate", reasons, passing=passing)
            return
        self.lease = lease
        self.deadman.name = holder
        self._resumed_ns = 0
        for part in self.parts:
            self._out.events += part.tagged(part.activate(lease, now_ns))
        held = f", while {holder!r} holds it" if holder else ""
        what = f"activated with worker {self.task.worker!r}{held}"
        self._change(Trigger.ACTIVATE, "; ".join([what, *self._ended_before()])[:MAX_TEXT])
        if why := joints_by_pose(self.profile, lease.spec.action):
            self._emit("warning", "notice", "joints_by_pose", why)
        self._new_episode(now_ns)

    def _is_answer_due(self, now_ns: int) -> bool:
        """Whether the worker may not have heard the newest prompt yet."""
        patience_s = min(ANSWER_S + 1.0 / self.task.rate_hz, MAX_ANSWER_S)
        return 0 <= now_ns - self._asked_ns < patience_s * 1e9

    def _ended_before(self) -> list[str]:
        """Why the last activation ended; nothing of it may have changed."""
        return [f"the last activation ended: {self._ended}"] if self._ended else []

    def _hold_as_well(self, holder: str) -> None:
        """Add a deadman to an active arm; a present one cannot be replaced without a brake."""
        reasons = self.deadman.reasons_against(holder, self._peers.holders, obeying=True)
        if reasons:
            self._reject_setting("activate", reasons)
        elif holder not in ("", self.deadman.name):
            self.deadman.name = holder
            self._emit("info", "notice", "held", f"active from now on while {holder!r} holds it")

    def _preflight(self, worker: str, now_ns: int) -> tuple[Lease | None, list[str], list[str]]:
        """A lease for `worker`, or the reasons of the parts and those of the worker against it."""
        peers, task, chunk = self._peers, self.task, self._latest.get(worker)
        spec, of_parts = peers.specs.get(worker), list[str]()
        for part in self.parts:
            of_parts += part.reasons(self._snapshot(part, worker, now_ns))
            of_parts += part.reasons_by_worker(worker, spec, chunk)
        of_worker = reasons_of_worker(
            self.profile, worker, task.prompt, peers, chunk, now_ns, task.rate_hz
        )
        if of_parts or of_worker or chunk is None or spec is None:
            return None, of_parts, of_worker
        return Lease(spec, chunk.header.source, now_ns, chunk.header.seq), [], []

    def _reject_setting(self, what: str, reasons: list[str], *, passing: bool = False) -> None:
        """Reject a setting; `passing`: only because something is still starting."""
        # Keep the reason for a stop: rejections that follow from it must not replace it.
        if self.state not in (State.STOPPED, State.FAULT):
            self.why = f"{what} rejected: {'; '.join(reasons)}"[:MAX_TEXT]
        for reason in reasons:
            level = "info" if passing else "warning"
            self._emit(level, "refusal", f"{what}_refused", reason)
            self._out.rejections.append(Rejection(f"{what}_refused", reason, quiet=passing))

    def latch(self, why: str) -> None:
        """Start in STOPPED: an emergency stop outlives the process that received it."""
        self.state, self.why = State.STOPPED, why[:MAX_TEXT]

    def _change(self, trigger: Trigger, why: str) -> None:
        old, new = self.state, self.state.after(trigger)
        if new is old:
            return
        self.state, self.why = new, why
        if new not in OBEYING:
            for part in self.parts:
                part.contact.end()
            if old in OBEYING:
                self._ended = why if trigger is Trigger.LOSE else ""
        if old in OBEYING and new is not State.ACTIVE:
            for part in self.parts:
                part.brake(relieves=trigger is Trigger.LOSE)
        asked = new in OBEYING or trigger in (Trigger.DEACTIVATE, Trigger.RESET)
        self._emit("info" if asked else "warning", "transition", f"{old.value}->{new.value}", why)

    def _emit(self, level: str, kind: str, what: str, why: str) -> None:
        self._out.events.append(make_event(level, kind, what, why))

    # -- chunks -------------------------------------------------------------------------------
    def _take_chunks(self, chunks: Sequence[Stamped[ActionChunk]], now_ns: int) -> None:
        """Plan what is new; the planning budget begins with the first call for a tick."""
        if not self._prepared:
            for part in self.parts:
                part.planner.begin_tick()
        for chunk in chunks:
            worker = chunk.record.worker
            leased = self.state in OBEYING and worker == self.task.worker
            lease = self.lease if leased else None
            owner = self._peers.spec_sources.get(worker)
            outcome = self._planner.submit(chunk, owner, lease, self.task, now_ns)
            if outcome is not None:
                self._report_outcome(outcome)
            elif lease is None:
                self._latest[worker] = chunk
        timeline, lease = self._motion.timeline, self.lease
        if timeline is None or lease is None or not self._planner.waiting:
            return
        episode = self.task.episode if self.state in OBEYING else None
        resumed_ns = now_ns if self.state is State.HOLDING else self._resumed_ns
        action, others = lease.spec.action, self.parts[1:]
        beside = [(part.planner, part.motion.timeline) for part in others if part.motion.timeline]
        for outcome in self._planner.advance(timeline, action, episode, resumed_ns, now_ns, beside):
            self._report_outcome(outcome)
            if outcome.plan is not None:
                self._resumed_ns = resumed_ns
                self._latest[outcome.chunk.record.worker] = outcome.chunk
                self._watchdog.expect(outcome.plan.left_ns(now_ns), now_ns, self.task)
                self.progress.chunks += 1
                self._change(Trigger.FRESH, "fresh chunk")

    def _report_outcome(self, outcome: ChunkOutcome) -> None:
        rejection = outcome.rejection
        if rejection is None:
            self._out.accepted = outcome.plan.cause if outcome.plan else None
            self._out.events += limit_events(outcome.hits)
            return
        self._out.rejections.append(rejection)
        if not rejection.quiet:
            reason, why, value, limit, _ = rejection
            why = f"{outcome.chunk.record.worker}: {why}"
            event = make_event("warning", "refusal", reason, why, value, limit)
            self._out.events.append(event)

    # -- supervision --------------------------------------------------------------------------
    def _measure(self) -> None:
        for part in self.parts:
            why = part.measure()
            if why:  # joints of another arm
                self._change(Trigger.LOSE, part.says(why))

    def _snapshot(self, part: CommandedPart, worker: str, now_ns: int) -> PartSnapshot:
        lease = self.lease if self.state in OBEYING else None
        return part.snapshot(self._peers, worker, lease, now_ns, published=not self.dry_run)

    def _supervise(self, now_ns: int) -> None:
        self._measure()
        worker = self.task.worker
        unheld = self.deadman.lost(self._peers.holders)
        for part in self.parts:
            if not part.retreat.busy:
                continue
            why = unheld or part.keeps_from_retreat(self._snapshot(part, worker, now_ns))
            if why:
                part.retreat.end()
                self._emit("warning", "notice", "retreat", part.says(f"the retreat ends: {why}"))
        if self.state is not State.ACTIVE and not self.dry_run:
            stays = self.state is not State.INACTIVE or bool(unheld)
            for part in self.parts:
                if part.brakes:
                    event = part.relief(self._snapshot(part, worker, now_ns), stays=stays)
                    self._out.events += [] if event is None else part.tagged([event])
        if self.state not in OBEYING:
            return
        lost: dict[str, Brake] = {}
        for part in self.parts:
            brake, events = part.check(self._snapshot(part, worker, now_ns))
            self._out.events += part.tagged(events)
            if brake is not None:
                lost[part.says(brake.why)] = brake
        # What all parts have lost is said once.
        reasons = {brake.why for brake in lost.values()}
        same = len(lost) == len(self.parts) and len(reasons) == 1
        why = "; ".join(reasons if same else lost)[:MAX_TEXT]
        if not why and self._watchdog.given_up(now_ns):
            why = f"held for {self.profile.timing.max_hold_s:g} s without a fresh chunk"
            complaint = self._peers.worker_complaints.get(worker)
            why += f"; worker {worker!r} reports: {complaint}" if complaint else ""
        if why:
            busy = all(brake.late for brake in lost.values())
            self._change(Trigger.LOSE, why + (self._lateness.explains() if busy else ""))
            return
        if unheld:
            self._change(Trigger.LOSE, unheld)
            return
        moves = any(not part.motion.arrived for part in self.parts)
        overdue = self._watchdog.overdue(now_ns, moves=moves)
        if overdue:
            self._change(Trigger.STARVE, overdue + self._lateness.explains())

    def _keep_apart(self, spacing: PartSpacing, now_ns: int, ticks: int) -> None:
        """Slow the parts down, or let all of them stand, before they come too near; or brake."""
        if self.state in OBEYING and self._motion.streaming:
            measured = spacing.monitor(now_ns)
            if measured is not None:
                brake = too_near(measured)
                self._out.events += [brake.event] if brake.event else []
                self._change(Trigger.LOSE, brake.why)
        moves = self.state is State.ACTIVE or self.retreating
        ahead_s = ticks / self.profile.timing.command_hz
        slowdown, hit = spacing.look(now_ns, ahead_s, moves=moves)
        if hit is not None and not self._motion.must_pause:
            what, why = hit.name, f"stand{hit.at}"
            self._out.events.append(make_event("warning", "limit", what, why, hit.value, hit.limit))
        for part in self.parts:
            part.motion.scaling.part_slowdown, part.motion.must_pause = slowdown, hit is not None


def _latched(gripper: Stamped[GripperState] | None) -> bool:
    return gripper is not None and gripper.record.mode == STOP_LATCHED
