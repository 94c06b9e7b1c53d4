"""Core of the command node: turns action chunks and settings into a bounded, smooth pose stream.

`Commander.step` is called once per tick with everything received since the last one. It has no
clock, no thread and no session; the same inputs give the same outputs, in a test, in lockstep with
a simulator and on the robot.

This module handles state and settings. `ChunkPlanner` makes plans of chunks, `MotionPipeline`
makes commands of plans, `Watchdog` and `JointMonitor` find reasons to brake.
"""

from __future__ import annotations

from dataclasses import replace

from vla_zenoh.control.chunk_planner import ChunkOutcome, ChunkPlanner
from vla_zenoh.control.chunk_validation import Lease, Rejection
from vla_zenoh.control.commander_io import (
    Inputs,
    Outputs,
    Setting,
    limit_events,
    make_event,
)
from vla_zenoh.control.gripper_arbiter import GripperArbiter
from vla_zenoh.control.joint_monitor import JOINT_PATIENCE_S, JointMonitor, joint_state_faults
from vla_zenoh.control.limits import Slowdown
from vla_zenoh.control.motion_pipeline import MotionPipeline
from vla_zenoh.control.plan_timeline import EpisodeProgress, Goal, Plan
from vla_zenoh.control.preflight import (
    CLOCK_TOLERANCE_S,
    PeerSnapshot,
    reasons_by_joints,
    reasons_not_to_activate,
)
from vla_zenoh.control.reachability import ReachabilityFilter
from vla_zenoh.control.states import DEACTIVATED, OBEYING, State, Trigger, after
from vla_zenoh.control.watchdog import Deadman, Watchdog
from vla_zenoh.errors import RecordError
from vla_zenoh.kinematics.so3 import Pose, held_pose, pose_of
from vla_zenoh.profile import Profile
from vla_zenoh.types import (
    MAX_TEXT,
    ActionChunk,
    GripperState,
    JointState,
    PoseState,
    Stamped,
    Task,
)

FUTURE_NS = round(CLOCK_TOLERANCE_S * 1e9)
"""A pose that is stamped later than it arrived by more than this says nothing about the past."""

LATE_NS = 10_000_000_000
"""A setting that was put before a stop arrives at most this long after it. Stamps that say so later
are those of a clock that was set."""

__all__ = ["Commander", "Inputs", "Outputs", "Setting"]


class Commander:
    """State machine, settings and one tick of the command node.

    Args:
        profile: limits, timing and initial settings.
        reach: bounds goals by the arm's kinematics; None: only the workspace box does, and joints
            cannot be commanded.
        dry_run: compute everything, stream nothing.

    Raises:
        ProfileError: joints are to be commanded and there is no `reach`.
    """

    def __init__(
        self, profile: Profile, *, reach: ReachabilityFilter | None = None, dry_run: bool = False
    ) -> None:
        self.profile = profile
        self.reach = reach
        self.dry_run = dry_run
        self.state = State.INACTIVE
        self.why = "not activated yet"
        self._ended = ""  # why the last activation did, if nobody ended it
        asked = profile.task
        self.task = Task(0, False, asked.prompt, asked.worker, asked.rate_hz, asked.speed_percent)
        self.pose: Stamped[PoseState] | None = None
        self._measured: Pose | None = None  # of it
        self.joint: Stamped[JointState] | None = None
        self.gripper_state: Stamped[GripperState] | None = None
        self.lease: Lease | None = None
        self.progress, self.deadman = EpisodeProgress(), Deadman()
        self._resumed_ns = 0
        self._peers = PeerSnapshot()
        self._latest: dict[str, Stamped[ActionChunk]] = {}
        self._planner = ChunkPlanner(profile, reach)
        self._motion = MotionPipeline(profile, reach, self._planner)
        self.contact, self._retreat = self._motion.contact, self._motion.retreat
        self._load_known = True
        self._watchdog = Watchdog(profile)
        self._joint_monitor = None if reach is None else JointMonitor(profile, reach)
        self._stop_put_ns = self._stop_came_ns = 0
        """Of the last emergency stop: when it was put, by the router's clock, and its tick."""
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
        self._update_states(inputs)
        self._planner.begin_tick()
        self._prepared = True
        for chunk in inputs.chunks:
            self._submit_chunk(chunk, next_ns)
        self._plan_chunks(next_ns)

    def look_ahead(self, now_ns: int) -> None:
        """Bound steps that are due later; to be called when the commands of a tick are published.

        Without it they are bounded when they are due. Its events are among the next outputs.
        """
        if self.state is State.ACTIVE:
            self._out.events += self._motion.look_ahead(now_ns)

    def step(self, inputs: Inputs, now_ns: int, ticks: int = 1) -> Outputs:
        """Process the inputs of one tick.

        Args:
            inputs: everything received since the last call.
            now_ns: nominal time of this tick on the wall clock of this node, which must not jump.
            ticks: periods since the last call. More than one after a late wake-up: the motion is a
                function of time, so the same trajectory is sampled later, no faster.
        """
        task_before, state_before = self.task, self.state
        self._update_states(inputs)
        stopped = any(setting.name == "stop" for setting in inputs.settings)
        if stopped:
            self._change(Trigger.STOP, "emergency stop")
            put_ns = [s.put_ns for s in inputs.settings if s.name == "stop" and s.put_ns]
            self._stop_put_ns, self._stop_came_ns = max(put_ns, default=0), now_ns
        for setting in inputs.settings:
            self._apply_setting(setting, now_ns, stopped)
        if not self._prepared:
            self._planner.begin_tick()
        self._prepared = False
        for chunk in inputs.chunks:
            self._submit_chunk(chunk, now_ns)
        self._plan_chunks(now_ns)
        self._supervise(now_ns)
        if not inputs.chunks or self._monitor_late(now_ns):  # planning them is work enough
            self._monitor_joints(now_ns)
        overdue_ns = self._watchdog.deadline_ns
        planned, events = self._motion.advance(self.state, self.task, overdue_ns, now_ns, ticks)
        self._out.events += events
        if not planned:
            self._change(Trigger.FAULT, "no trajectory could be computed; braked")
        if self.state is State.ACTIVE and self._motion.timeline is not None:
            self.progress.update(self._motion.timeline, self.task.episode, now_ns)
        if not self.dry_run:
            commands = self._motion.commands(self.state, now_ns, self.gripper_state)
            self._out.pose, self._out.joint, self._out.gripper = commands
        if self.state is not state_before and self.task.active != (self.state in OBEYING):
            self.task = replace(self.task, active=self.state in OBEYING)
        self._out.task_changed = self.task is not task_before and self.task != task_before
        out, self._out = self._out, Outputs()
        return out

    @property
    def goal(self) -> Goal | None:
        """The goal that the arm follows, None before the first activation."""
        return self._motion.goal

    @property
    def gripper(self) -> GripperArbiter:
        """The gripper's commands."""
        return self._motion.gripper

    @property
    def at_rest(self) -> bool:
        """The commanded motion stands still, and will."""
        return self._motion.at_rest and not self.retreating

    @property
    def streaming(self) -> bool:
        """Commands are being published."""
        return self._motion.streaming

    @property
    def retreating(self) -> bool:
        """The arm retreats from what blocked it."""
        return self._retreat.busy

    @property
    def speed(self) -> float:
        """Share of the speed limits in use; less than 1 near a bound."""
        return self._motion.speed

    @property
    def slower(self) -> Slowdown | None:
        """What slows the arm down near a bound; None: nothing, or it is not commanded."""
        return self._motion.slower if self._motion.streaming else None

    @property
    def smoothing_failures(self) -> int:
        """Times Ruckig found no trajectory and the arm braked instead."""
        return self._motion.failures

    @property
    def tracking_m(self) -> float:
        """Distance of the measured TCP from the commanded one."""
        return self._watchdog.tracking_m

    @property
    def tracking_rad(self) -> float:
        """Angle of the measured TCP from the commanded one."""
        return self._watchdog.tracking_rad

    @property
    def elbow_rad(self) -> float:
        """Greatest distance of a measured joint from where it is expected, see `JointMonitor`."""
        return 0.0 if self._joint_monitor is None else self._joint_monitor.elbow_rad

    # -- states and settings ------------------------------------------------------------------
    def _update_states(self, inputs: Inputs) -> None:
        if inputs.peers is not None:
            self._peers = inputs.peers
        if inputs.pose is not None:
            self.pose = inputs.pose
            self._planner.poses.add(inputs.pose, FUTURE_NS)
            self.contact.update_pose(inputs.pose)
            self._measured = pose_of(inputs.pose.record)
            self._retreat.measure(self._measured)
        if inputs.joint is not None:
            self.joint = inputs.joint
            self._planner.joints.add(inputs.joint, FUTURE_NS)
            self.contact.update_joints(inputs.joint)
        if inputs.gripper is not None:
            self.gripper_state = inputs.gripper
            faults, mode = inputs.gripper.record.faults, inputs.gripper.record.mode
            if faults:
                self._change(Trigger.FAULT, f"the robot reports: {'; '.join(faults)}")
            elif mode != "ready":
                self._change(Trigger.LOSE, f"the robot is not ready but {mode!r}")

    def _apply_setting(self, setting: Setting, now_ns: int, stopped: bool) -> None:
        name, value = setting.name, setting.value
        if name == "reset" or (name == "active" and value is not False):
            if stopped:
                # Their order within a tick is not known: the stop wins.
                self._reject_setting(name, ["an emergency stop came at the same time"])
                return
            overtaken = setting.put_ns is not None and setting.put_ns <= self._stop_put_ns
            if overtaken and 0 <= now_ns - self._stop_came_ns < LATE_NS:
                late = (
                    "it was put before the last emergency stop and arrived after it; put it again"
                )
                self._reject_setting(name, [late])
                return
        try:
            self._set(name, value, now_ns)
        except RecordError as error:
            self._reject_setting(name, [str(error)])

    def _set(self, name: str, value: str | bool | float | None, now_ns: int) -> None:
        if name == "prompt" and isinstance(value, str):
            if value != self.task.prompt:
                self._new_episode(now_ns, prompt=value)
        elif name == "worker" and isinstance(value, str):
            if value != self.task.worker:
                self._change_worker(value, now_ns)
        elif name == "rate" and isinstance(value, (int, float)):
            self.task = replace(self.task, rate_hz=value)
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
            self._retreat.end()
            self._change(Trigger.DEACTIVATE, DEACTIVATED)
        elif name == "reset":
            self._reset()
        elif name == "lose":
            self._change(Trigger.LOSE, str(value))
        elif name != "stop":
            raise RecordError(f"{name!r} cannot be set to {value!r}")

    def _new_episode(self, now_ns: int, **changes: str) -> None:
        # From the wall clock, so that a restarted node never reuses an episode number.
        episode = max(self.task.episode + 1, now_ns // 1_000_000)
        self.task = replace(self.task, episode=episode, **changes)  # pyright: ignore
        self.progress.begin()
        if changes:
            self._ended = ""
        if self.state in OBEYING:
            self._watchdog.expect_first(now_ns, self.task.rate_hz, self.task.speed)

    def _change_speed(self, percent: float, now_ns: int) -> None:
        before = self.task.speed
        self.task = replace(self.task, speed_percent=percent)
        self._watchdog.override_changed(now_ns, before, self.task.speed)
        # The scene may have changed during a pause: the rest of an old chunk is not carried out.
        oldest_ns = now_ns - int(self.profile.timing.max_observation_age_s * 1e9)
        paused = self.state in OBEYING and not before
        if paused and self._motion.forget_plan(oldest_ns, now_ns):
            self._resumed_ns = now_ns
            self._watchdog.expect_first(now_ns, self.task.rate_hz, self.task.speed)
            self._emit("info", "notice", "paused", "waits for a chunk that is newer than the pause")

    def _change_worker(self, worker: str, now_ns: int) -> None:
        if self.state in OBEYING:
            lease, reasons = self._preflight(worker, now_ns)
            if lease is None:
                self._reject_setting("worker", reasons)
                return
            self.lease = lease
        self._new_episode(now_ns, worker=worker)

    def _activate(self, now_ns: int, holder: str) -> None:
        if self.state in OBEYING:
            self._hold_as_well(holder)
            return
        if self.state is not State.INACTIVE:
            self._reject_setting(
                "activate",
                [
                    f"the state is {self.state.value} ({self.why}); clear it with `vla-zenoh "
                    "reset`, or put anything on the key reset"
                ],
            )
            return
        lease, reasons = self._preflight(self.task.worker, now_ns)
        reasons += self.deadman.reasons_against(holder, self._peers.holders)
        self._measure()
        reasons += self._motion.unsettled() + self.contact.missing
        if lease is None or self.pose is None or self.gripper_state is None or reasons:
            self._reject_setting("activate", reasons + self._ended_before())
            return
        self.lease = lease
        self.deadman.begin(holder)
        self.contact.begin()
        self._planner.restart(self.pose, self.joint)
        self._resumed_ns = 0
        measured, joint = self.pose.record, self.joint.record if self.joint else None
        blocked = self._watchdog.begin(held_pose(measured), pose_of(measured))
        self._motion.anchor(
            measured,
            self.gripper_state.record,
            joint,
            now_ns,
            blocked=blocked,
            in_joints=lease.spec.action.space == "joint",
        )
        held = f", while {holder!r} holds it" if holder else ""
        what = f"activated with worker {self.task.worker!r}{held}"
        self._change(Trigger.ACTIVATE, "; ".join([what, *self._ended_before()])[:MAX_TEXT])
        self._new_episode(now_ns)

    def _ended_before(self) -> list[str]:
        """Why the last activation ended; nothing of it may have changed."""
        return [f"the last activation ended: {self._ended}"] if self._ended else []

    def _hold_as_well(self, holder: str) -> None:
        """Add a deadman to an active arm; a present one cannot be replaced without a brake."""
        reasons = self.deadman.reasons_against(holder, self._peers.holders, obeying=True)
        if reasons:
            self._reject_setting("activate", reasons)
        elif holder not in ("", self.deadman.name):
            self.deadman.begin(holder)
            self._emit("info", "notice", "held", f"active from now on while {holder!r} holds it")

    def _preflight(self, worker: str, now_ns: int) -> tuple[Lease | None, list[str]]:
        chunk = self._latest.get(worker)
        reasons = reasons_not_to_activate(
            self.profile,
            worker,
            self.task.prompt,
            self._peers,
            self.pose,
            self.gripper_state,
            chunk,
            now_ns,
            self.task.rate_hz,
        )
        bounds = self._planner.joint_bounds
        if bounds is not None and self.pose is not None:
            reasons += joint_state_faults(
                self.profile, bounds.kinematics, self.joint, self.pose, now_ns
            )
            spec = self._peers.specs.get(worker)
            if spec is not None and chunk is not None and self.joint is not None:
                reasons += reasons_by_joints(
                    self.profile, worker, spec, chunk.record, bounds, self.joint
                )
        spec = self._peers.specs.get(worker)
        if self.reach is None and spec is not None and spec.action.space == "joint":
            reasons.append(
                f"worker {worker!r} acts in joints, which needs the robot's kinematics: set "
                "robot.description, robot.tcp_frame and robot.arm_joints in the profile"
            )
        if self.joint is not None and self.pose is not None:
            writers = {self.joint.header.source, self.pose.header.source}
            if len(writers) > 1:
                reasons.append(f"joints and pose have different writers: {', '.join(writers)}")
        if reasons or chunk is None:
            return None, reasons
        spec = self._peers.specs[worker]
        return Lease(spec, chunk.header.source, now_ns, chunk.header.seq), []

    def _reject_setting(self, what: str, reasons: list[str]) -> None:
        # Keep the reason for a stop: rejections that follow from it must not replace it.
        if self.state not in (State.STOPPED, State.FAULT):
            self.why = f"{what} rejected: {'; '.join(reasons)}"[:MAX_TEXT]
        for reason in reasons:
            self._emit("warning", "refusal", f"{what}_refused", reason)
            self._out.rejections.append(Rejection(f"{what}_refused", reason))

    def latch(self, why: str) -> None:
        """Start in STOPPED: an emergency stop outlives the process that received it."""
        self.state, self.why = State.STOPPED, why[:MAX_TEXT]

    def _reset(self) -> None:
        faults = self.gripper_state.record.faults if self.gripper_state else ()
        if self.state is State.FAULT and faults:
            self._reject_setting("reset", [f"the robot still reports: {'; '.join(faults)}"])
            return
        self._change(Trigger.RESET, "reset")

    def _change(self, trigger: Trigger, why: str) -> None:
        new = after(self.state, trigger)
        if new is self.state:
            return
        old, self.state, self.why = self.state, new, why
        if new not in OBEYING:
            self.contact.end()
            if old in OBEYING:
                self._ended = why if trigger is Trigger.LOSE else ""
        level = (
            "info"
            if new in OBEYING or trigger in (Trigger.DEACTIVATE, Trigger.RESET)
            else "warning"
        )
        self._emit(level, "transition", f"{old.value}->{new.value}", why)

    def _emit(
        self,
        level: str,
        kind: str,
        what: str,
        why: str,
        value: float | None = None,
        limit: float | None = None,
    ) -> None:
        self._out.events.append(make_event(level, kind, what, why, value, limit))

    # -- chunks -------------------------------------------------------------------------------
    def _submit_chunk(self, chunk: Stamped[ActionChunk], now_ns: int) -> None:
        worker = chunk.record.worker
        leased = self.state in OBEYING and worker == self.task.worker
        lease = self.lease if leased else None
        owner = self._peers.spec_sources.get(worker)
        outcome = self._planner.submit(chunk, owner, lease, self.task, now_ns)
        if outcome is not None:
            self._report_outcome(outcome)
        elif lease is None:
            self._latest[worker] = chunk

    def _plan_chunks(self, now_ns: int) -> None:
        timeline, lease = self._motion.timeline, self.lease
        if timeline is None or lease is None:
            return
        episode = self.task.episode if self.state in OBEYING else None
        resumed_ns = now_ns if self.state is State.HOLDING else self._resumed_ns
        action = lease.spec.action
        for outcome in self._planner.advance(timeline, action, episode, resumed_ns, now_ns):
            self._report_outcome(outcome)
            if outcome.plan is not None:
                self._resumed_ns = resumed_ns
                self._latest[outcome.chunk.record.worker] = outcome.chunk
                self._expect_next(outcome.plan, now_ns)
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
            self._emit("warning", "refusal", reason, why, value, limit)

    def _expect_next(self, plan: Plan, now_ns: int) -> None:
        rate_hz, speed = self.task.rate_hz, self.task.speed
        self._watchdog.expect_next(plan.left_ns(now_ns), now_ns, rate_hz, speed)

    # -- supervision --------------------------------------------------------------------------
    def _measure(self) -> None:
        if self.pose is not None:
            joint = self.joint.record if self.joint else None
            try:
                self._motion.measure(self.pose.record, joint, self.pose.received_ns)
            except RecordError as error:  # joints of another arm
                self._change(Trigger.LOSE, str(error))

    def _supervise(self, now_ns: int) -> None:
        if self._measured is not None:
            self._watchdog.measure(self._motion.commanded, self._measured)
        self._measure()
        if self._retreat.busy and (
            not self._may_retreat(now_ns) or self.deadman.lost(self._peers.holders)
        ):
            self._retreat.end()
        if self.state not in OBEYING:
            return
        assert self.pose is not None and self.gripper_state is not None and self.lease is not None
        self._motion.contact_slowdown = self.contact.slowdown()
        self._report_load_sensing()
        lost = self._watchdog.lost(
            self.pose, self.gripper_state, self._peers, self.task.worker, self.lease, now_ns
        )
        if not lost and self.streaming and not self.dry_run:
            lost = self._obstructed()
        lost = lost or self.contact.lost or self._motion.stuck or self._joints_lost(now_ns)
        if not lost and self._watchdog.given_up(now_ns):
            lost = f"held for {self.profile.timing.max_hold_s:g} s without a fresh chunk"
        lost = lost or self.deadman.lost(self._peers.holders)
        if lost:
            self._change(Trigger.LOSE, lost)
        elif self._watchdog.overdue(now_ns):
            self._change(Trigger.STARVE, "no fresh chunk within the watchdog")

    def _joints_lost(self, now_ns: int) -> str:
        """Why the measured joints, which are monitored, count as lost; empty while they arrive."""
        if self._joint_monitor is None or self.joint is None:
            return ""
        silent_s = (now_ns - self.joint.received_ns) / 1e9
        patience_s = self.profile.timing.state_timeout_s + JOINT_PATIENCE_S
        if silent_s <= patience_s:
            return ""
        return f"robot state lost: joints {silent_s:.3f} s old, at most {patience_s:g} s"

    def _monitor_late(self, now_ns: int) -> bool:
        return self._joint_monitor is not None and self._joint_monitor.late(now_ns)

    def _monitor_joints(self, now_ns: int) -> None:
        """Slow the arm down, or brake it, if its measured joints come too near to a bound."""
        monitor, reach, motion = self._joint_monitor, self.reach, self._motion
        if monitor is None or reach is None or self.joint is None:
            return
        if self.state not in OBEYING or not self.streaming:
            monitor.reset()
            return
        try:
            measured_rad = reach.kinematics.joints_of(self.joint.record)
        except RecordError as error:
            self._change(Trigger.LOSE, str(error))
            return
        commanded_rad = motion.joints_rad
        hit = monitor.update(measured_rad, commanded_rad, now_ns, in_joints=motion.in_joints)
        motion.joint_slowdown = monitor.slowdown
        reach.set_elbow(measured_rad if commanded_rad is None else commanded_rad)
        if hit is not None:
            self._emit("warning", "limit", hit.name, f"braked{hit.at}", hit.value, hit.limit)
            why = f"the measured arm is too near to a bound: {hit.name}{hit.at} is {hit.value:.3g}"
            self._change(Trigger.LOSE, f"{why}, the limit is {hit.limit:.3g}")

    def _obstructed(self) -> str:
        """Why the arm is blocked or in contact, empty otherwise; it then brakes and retreats."""
        commanded, overload = self._motion.commanded, self.contact.overload()
        if overload is None:
            why = self._watchdog.blocked()
            # An arm without contact is not blocked: its state is stuck, or it was slowed down.
            retreats = bool(why) and not (self.contact.known and self.contact.quiet)
        else:
            name, value, limit, unit = overload
            self._emit("warning", "limit", name, "stopped", value, limit)
            why = (
                f"something presses against the arm: {name} {value:.1f} {unit}, "
                f"at most {limit:g} {unit}; it is led back"
            )
            retreats = True
        if retreats and commanded is not None:
            self._retreat.begin(commanded)
        return why

    def _may_retreat(self, now_ns: int) -> bool:
        """The robot is alive and ready, without faults, and publishes its state."""
        pose, gripper = self.pose, self.gripper_state
        if pose is None or gripper is None or self._watchdog.state_lost(pose, gripper, now_ns):
            return False
        alive = self._peers.robot_node in self._peers.alive
        return alive and gripper.record.mode == "ready" and not gripper.record.faults

    def _report_load_sensing(self) -> None:
        if self.contact.known is self._load_known:
            return
        self._load_known = self.contact.known
        if self._load_known:
            self._emit("info", "notice", "contact_told", "the robot measures external loads")
        else:
            why = (
                "the robot measures no external wrench: limits.contact has no effect, and a "
                "blocked arm is detected by limits.tracking_m alone"
            )
            self._emit("warning", "notice", "contact_not_told", why)
