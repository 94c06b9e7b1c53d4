"""The command node's mind: chunks and settings in, a bounded smooth pose stream out.

`Commander.step` is called once a tick with everything that arrived since the last one. It has no
clock, no thread and no session; the same inputs give the same outputs, in a test, in lockstep with
a simulator and on the robot.

Here are states and settings. `composer` makes plans of chunks, `mover` makes commands of plans,
`watch` sees what is lost.
"""

from __future__ import annotations

from collections import deque
from dataclasses import replace

from vla_zenoh.control.acceptance import Lease, Refusal, refuse
from vla_zenoh.control.compose import Goal, Plan
from vla_zenoh.control.composer import ChunkPlan, Composer
from vla_zenoh.control.gripper import GripperArbiter
from vla_zenoh.control.holding import Holding
from vla_zenoh.control.joint_fit import JOINT_PATIENCE_S, reasons_joints_do_not_fit
from vla_zenoh.control.joint_watch import JointWatch
from vla_zenoh.control.mover import Mover
from vla_zenoh.control.ports import Inputs, Outputs, Setting
from vla_zenoh.control.preflight import Surroundings, reasons_not_to_activate
from vla_zenoh.control.progress import Progress
from vla_zenoh.control.reach import Shadow
from vla_zenoh.control.so3 import held_pose, pose_of
from vla_zenoh.control.states import DEACTIVATED, OBEYING, State, Trigger, after
from vla_zenoh.control.watch import Watch
from vla_zenoh.errors import RecordError
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

__all__ = ["Commander", "Inputs", "Outputs", "Setting"]

MOST_WAITING = 4
"""Of a heap of chunks the newest few; the newest of them that is no mistake is carried out."""


class Commander:
    """See the module.

    Args:
        profile: limits, timing and first settings.
        reach: the arm's kinematic shadow; None: only the workspace box bounds a goal, and joints
            cannot be commanded.
        dry_run: compute everything, stream nothing.

    Raises:
        ProfileError: joints are to be commanded and there is no `reach`.
    """

    def __init__(
        self, profile: Profile, *, reach: Shadow | None = None, dry_run: bool = False
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
        self.joint: Stamped[JointState] | None = None
        self.gripper_state: Stamped[GripperState] | None = None
        self.lease: Lease | None = None
        self.progress, self.holding = Progress(), Holding()
        self._resumed_ns = 0
        self._around = Surroundings()
        self._shadow: dict[str, Stamped[ActionChunk]] = {}
        self._composer = Composer(profile, reach)
        self._waiting: deque[Stamped[ActionChunk]] = deque()
        self._coming: tuple[Stamped[ActionChunk], ChunkPlan] | None = None
        self._mover = Mover(profile, reach, self._composer)
        self.contact, self._retreat = self._mover.contact, self._mover.retreat
        self._feels = True
        self._watch = Watch(profile)
        self._joint_watch = None if reach is None else JointWatch(profile, reach)
        self._speed_changed = False
        self._out = Outputs()

    # -- one tick -----------------------------------------------------------------------------
    def step(self, inputs: Inputs, now_ns: int, ticks: int = 1) -> Outputs:
        """Take in what arrived and say what to publish.

        Args:
            inputs: since the last call.
            now_ns: nominal time of this tick on the wall clock of this node, which must not jump.
            ticks: periods since the last call. More than one after a late wake-up: the motion is a
                function of time, so the same trajectory is sampled later, and nothing is hurried.
        """
        self._out = Outputs()
        task_before, state_before = self.task, self.state
        self._take_state(inputs)
        stopped = any(setting.name == "stop" for setting in inputs.settings)
        if stopped:
            self._change(Trigger.STOP, "emergency stop")
        for setting in inputs.settings:
            self._take_setting(setting, now_ns, stopped)
        self._composer.tick()
        for chunk in inputs.chunks:
            self._take_chunk(chunk, now_ns)
        self._compose(now_ns)
        self._look_around(now_ns)
        if not inputs.chunks:  # those cost enough in one tick
            self._look_at_joints(now_ns)
        if not self._mover.advance(
            self.state, self.task, self._watch.deadline_ns, now_ns, ticks, self._out
        ):
            self._change(Trigger.FAULT, "no trajectory could be computed; braked")
        if self._speed_changed and self._mover.timeline is not None:
            self._speed_changed = False
            self._expect_next(self._mover.timeline.plan, now_ns)
        if self.state is State.ACTIVE and self._mover.timeline is not None:
            self.progress.look(self._mover.timeline, self.task.episode, now_ns)
        if not self.dry_run:
            self._mover.command(self.state, now_ns, self.gripper_state, self._out)
        if self.state is not state_before and self.task.active != (self.state in OBEYING):
            self.task = replace(self.task, active=self.state in OBEYING)
        self._out.task_changed = self.task != task_before
        return self._out

    @property
    def goal(self) -> Goal | None:
        """Where the arm is heading, None before the first activation."""
        return self._mover.goal

    @property
    def gripper(self) -> GripperArbiter:
        """What decides when the gripper is commanded."""
        return self._mover.gripper

    @property
    def at_rest(self) -> bool:
        """What is commanded stands still."""
        return self._mover.at_rest

    @property
    def streaming(self) -> bool:
        """Commands are being published."""
        return self._mover.streaming

    @property
    def retreating(self) -> bool:
        """The arm is led back from what blocked it."""
        return self._retreat.busy

    @property
    def speed(self) -> float:
        """Share of the speed limits that the arm has now; less than 1 near a bound."""
        return self._mover.speed

    @property
    def smoothing_failures(self) -> int:
        """Times Ruckig found no way and the arm was braked instead."""
        return self._mover.failures

    @property
    def tracking_m(self) -> float:
        """How far the measured TCP is from the commanded one."""
        return self._watch.tracking_m

    @property
    def tracking_rad(self) -> float:
        """Likewise."""
        return self._watch.tracking_rad

    @property
    def elbow_rad(self) -> float:
        """How far the worst measured joint is from where the arm is believed to have it."""
        return 0.0 if self._joint_watch is None else self._joint_watch.elbow_rad

    # -- states and settings ------------------------------------------------------------------
    def _take_state(self, inputs: Inputs) -> None:
        if inputs.around is not None:
            self._around = inputs.around
        if inputs.pose is not None:
            self.pose = inputs.pose
            self.contact.take_pose(inputs.pose)
            self._retreat.see(pose_of(inputs.pose.record))
        if inputs.joint is not None:
            self.joint = inputs.joint
            self.contact.take_joints(inputs.joint)
        if inputs.gripper is not None:
            self.gripper_state = inputs.gripper
            faults, mode = inputs.gripper.record.faults, inputs.gripper.record.mode
            if faults:
                self._change(Trigger.FAULT, f"the robot reports: {'; '.join(faults)}")
            elif mode != "ready":
                self._change(Trigger.LOSE, f"the robot is not ready but {mode!r}")

    def _take_setting(self, setting: Setting, now_ns: int, stopped: bool) -> None:
        name, value = setting.name, setting.value
        if stopped and (name == "reset" or (name == "active" and value is not False)):
            # Which of them was put first cannot be told within a tick: the stop wins.
            self._refuse_setting(name, ["an emergency stop came at the same time"])
            return
        try:
            self._set(name, value, now_ns)
        except RecordError as error:
            self._refuse_setting(name, [str(error)])

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
                raise RecordError(f"{value:g} % is more than {now}; put it on speed to go faster")
            self.task = replace(self.task, speed_percent=value)
            self._speed_changed = True
        elif name == "active" and (value is True or isinstance(value, str)):
            self._activate(now_ns, "" if value is True else value)
        elif name == "active" and value is False:
            self._change(Trigger.DEACTIVATE, DEACTIVATED)
        elif name == "reset":
            self._reset()
        elif name == "lose":
            self._change(Trigger.LOSE, str(value))
        elif name != "stop":
            raise RecordError(f"{value!r} is nothing that {name!r} can be set to")

    def _new_episode(self, now_ns: int, **changes: str) -> None:
        # The wall clock, so that an episode number never comes again after a restart.
        episode = max(self.task.episode + 1, now_ns // 1_000_000)
        self.task = replace(self.task, episode=episode, **changes)  # pyright: ignore
        self.progress.begin()
        if changes:
            self._ended = ""
        if self.state in OBEYING:
            self._watch.expect_first(now_ns, self.task.rate_hz, self.task.speed)

    def _change_worker(self, worker: str, now_ns: int) -> None:
        if self.state in OBEYING:
            lease, reasons = self._preflight(worker, now_ns)
            if lease is None:
                self._refuse_setting("worker", reasons)
                return
            self.lease = lease
        self._new_episode(now_ns, worker=worker)

    def _activate(self, now_ns: int, holder: str) -> None:
        if self.state in OBEYING:
            self._hold_as_well(holder)
            return
        if self.state is not State.INACTIVE:
            self._refuse_setting(
                "activate", [f"the state is {self.state.value} ({self.why}); put anything on reset"]
            )
            return
        lease, reasons = self._preflight(self.task.worker, now_ns)
        reasons += self.holding.refused(holder, self._around.holders)
        reasons += self._mover.unsettled(now_ns)
        if lease is None or self.pose is None or self.gripper_state is None or reasons:
            self._refuse_setting("activate", reasons + self._ended_before())
            return
        self.lease = lease
        self.holding.begin(holder)
        self.contact.begin()
        self._resumed_ns = 0
        measured, joint = self.pose.record, self.joint.record if self.joint else None
        blocked = self._watch.begin(held_pose(measured), pose_of(measured))
        self._mover.anchor(measured, self.gripper_state.record, joint, now_ns, blocked=blocked)
        held = f", while {holder!r} holds it" if holder else ""
        what = f"activated with worker {self.task.worker!r}{held}"
        self._change(Trigger.ACTIVATE, "; ".join([what, *self._ended_before()])[:MAX_TEXT])
        self._new_episode(now_ns)

    def _ended_before(self) -> list[str]:
        """Why the last activation ended; nothing of it may have changed."""
        return [f"the last activation ended: {self._ended}"] if self._ended else []

    def _hold_as_well(self, holder: str) -> None:
        """An arm that obeys already is held by one; nobody takes that away without a brake."""
        reasons = self.holding.refused(holder, self._around.holders, obeying=True)
        if reasons:
            self._refuse_setting("activate", reasons)
        elif holder not in ("", self.holding.name):
            self.holding.begin(holder)
            self._out.tell("info", "notice", "held", f"obeys from now on while {holder!r} holds it")

    def _preflight(self, worker: str, now_ns: int) -> tuple[Lease | None, list[str]]:
        chunk = self._shadow.get(worker)
        reasons = reasons_not_to_activate(
            self.profile,
            worker,
            self.task.prompt,
            self._around,
            self.pose,
            self.gripper_state,
            chunk,
            now_ns,
            self.task.rate_hz,
        )
        if self.reach is not None and self.pose is not None:
            reasons += reasons_joints_do_not_fit(
                self.profile, self.reach.kinematics, self.joint, self.pose, now_ns
            )
        if self.joint is not None and self.pose is not None:
            writers = {self.joint.header.source, self.pose.header.source}
            if len(writers) > 1:
                reasons.append(f"joints and pose are by different writers: {', '.join(writers)}")
        if reasons or chunk is None:
            return None, reasons
        spec = self._around.specs[worker]
        return Lease(spec, chunk.header.source, now_ns, chunk.header.seq), []

    def _refuse_setting(self, what: str, reasons: list[str]) -> None:
        # Why it stopped is not covered up by what was refused because of it.
        if self.state not in (State.STOPPED, State.FAULT):
            self.why = f"{what} refused: {'; '.join(reasons)}"[:MAX_TEXT]
        for reason in reasons:
            self._out.tell("warning", "refusal", f"{what}_refused", reason)
            self._out.refusals.append(Refusal(f"{what}_refused", reason))

    def latch(self, why: str) -> None:
        """Begin stopped: an emergency stop outlives the process that heard it."""
        self.state, self.why = State.STOPPED, why[:MAX_TEXT]

    def _reset(self) -> None:
        faults = self.gripper_state.record.faults if self.gripper_state else ()
        if self.state is State.FAULT and faults:
            self._refuse_setting("reset", [f"the robot still reports: {'; '.join(faults)}"])
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
        self._out.tell(level, "transition", f"{old.value}->{new.value}", why)

    # -- chunks -------------------------------------------------------------------------------
    def _take_chunk(self, chunk: Stamped[ActionChunk], now_ns: int) -> None:
        worker = chunk.record.worker
        owner = self._around.spec_sources.get(worker)
        if owner is None:
            unknown = Refusal("unknown_worker", "its spec is not known yet", quiet=True)
            self._out.refuse(unknown, worker)
            return
        if chunk.header.source != owner:
            why = f"a chunk by {chunk.header.source[:60]!r}, who did not publish this worker's spec"
            self._out.refuse(Refusal("foreign", why), worker)
            return
        if self.state not in OBEYING or worker != self.task.worker or self.lease is None:
            self._shadow[worker] = chunk
            return
        timing = self.profile.timing
        refusal = refuse(chunk, self.lease, self.task, timing.max_observation_age_s, now_ns)
        if refusal is not None:
            self._out.refuse(refusal, worker)
            return
        self.lease.last_observation_ns = chunk.record.observation_stamp_ns
        if len(self._waiting) == MOST_WAITING:
            self._overtaken(self._waiting.popleft())
        self._waiting.append(chunk)

    def _compose(self, now_ns: int) -> None:
        """Go on with the chunk that becomes a plan, then with the newest that waits.

        One that came meanwhile stands on it, so it is begun when that is in force.
        """
        if self._coming is not None:
            self._go_on(*self._coming, now_ns)
        while self._coming is None and self._waiting:
            self._begin(self._waiting.pop(), now_ns)

    def _expect_next(self, plan: Plan, now_ns: int) -> None:
        rate_hz, speed = self.task.rate_hz, self.task.speed
        self._watch.expect_next(max(plan.end_ns, now_ns), rate_hz, now_ns, speed)

    def _begin(self, chunk: Stamped[ActionChunk], now_ns: int) -> None:
        timeline, lease = self._mover.timeline, self.lease
        if timeline is None or lease is None or self._superseded(chunk):
            return
        plan = self._composer.begin(chunk, lease.spec.action, timeline)
        if isinstance(plan, Refusal):
            self._out.refuse(plan, chunk.record.worker)
            return
        while self._waiting:
            self._overtaken(self._waiting.popleft())
        self._coming = chunk, plan
        self._go_on(chunk, plan, now_ns)

    def _go_on(self, chunk: Stamped[ActionChunk], plan: ChunkPlan, now_ns: int) -> None:
        timeline, worker = self._mover.timeline, chunk.record.worker
        if timeline is None or self._superseded(chunk):
            self._coming = None
            return
        ready = self._composer.go_on(plan, now_ns)
        if ready is False:
            return
        self._coming = None
        if isinstance(ready, Refusal):
            self._out.refuse(ready, worker)
            return
        if self.state is State.HOLDING:
            self._resumed_ns = now_ns
        # Until then the arm stood, and what was seen of it stands on that: chunks that come in a
        # heap after a pause replace each other.
        plan.effective_ns = max(plan.effective_ns, self._resumed_ns)
        timeline.add(plan, now_ns)
        self._expect_next(plan, now_ns)
        self._out.accepted = plan.cause
        self._out.shortened(plan.news())
        self._shadow[worker] = chunk
        self.progress.chunks += 1
        self._change(Trigger.FRESH, "fresh chunk")

    def _superseded(self, chunk: Stamped[ActionChunk]) -> bool:
        """The arm was stopped, or is told something else, since it came."""
        if self.state in OBEYING and chunk.record.episode == self.task.episode:
            return False
        why = "the arm was stopped or told something else meanwhile"
        self._out.refuse(Refusal("superseded", why, quiet=True), chunk.record.worker)
        return True

    def _overtaken(self, chunk: Stamped[ActionChunk]) -> None:
        why = "a newer one came before it was begun"
        self._out.refuse(Refusal("overtaken", why, quiet=True), chunk.record.worker)

    # -- watching -----------------------------------------------------------------------------
    def _look_around(self, now_ns: int) -> None:
        if self.pose is not None:
            self._watch.measure(self._mover.commanded, pose_of(self.pose.record))
            self._mover.look_at(self.pose.record, now_ns)
        if self._retreat.busy and not self._may_retreat(now_ns):
            self._retreat.end()
        if self.state not in OBEYING:
            return
        assert self.pose is not None and self.gripper_state is not None and self.lease is not None
        self._mover.pressed = self.contact.slowdown()
        self._tell_whether_it_feels()
        lost = self._watch.lost(
            self.pose, self.gripper_state, self._around, self.task.worker, self.lease, now_ns
        )
        if not lost and self.streaming and not self.dry_run:
            lost = self._obstructed()
        lost = lost or self._mover.stuck or self._joints_lost(now_ns)
        if not lost and self._watch.forsaken(now_ns):
            lost = f"held for {self.profile.timing.max_hold_s:g} s, no fresh chunk came"
        lost = lost or self.holding.lost(self._around.holders)
        if lost:
            self._change(Trigger.LOSE, lost)
        elif self._watch.starved(now_ns):
            self._change(Trigger.STARVE, "no fresh chunk within the watchdog")

    def _joints_lost(self, now_ns: int) -> str:
        """That the measured joints, which are watched, are not heard any more."""
        if self._joint_watch is None or self.joint is None:
            return ""
        silent_s = (now_ns - self.joint.received_ns) / 1e9
        patience_s = self.profile.timing.state_timeout_s + JOINT_PATIENCE_S
        if silent_s <= patience_s:
            return ""
        return f"robot state lost: joints {silent_s:.3f} s old, at most {patience_s:g} s"

    def _look_at_joints(self, now_ns: int) -> None:
        """Hold the arm back, or brake it, where its measured joints come too near to something."""
        watch, reach, mover = self._joint_watch, self.reach, self._mover
        if watch is None or reach is None or self.joint is None:
            return
        if self.state not in OBEYING or not self.streaming:
            watch.forget()
            return
        try:
            measured_rad = reach.kinematics.joints_of(self.joint.record)
        except RecordError as error:
            self._change(Trigger.LOSE, str(error))
            return
        commanded_rad = mover.joints_rad
        hit = watch.look(measured_rad, commanded_rad, now_ns)
        mover.hold_back(watch.slowdown)
        reach.reseat(measured_rad if commanded_rad is None else commanded_rad)
        if hit is not None:
            at = f" at {hit.where}" if hit.where else ""
            self._out.tell("warning", "limit", hit.name, f"braked{at}", hit.value, hit.limit)
            why = f"the measured arm is too near to a bound: {hit.name}{at} is {hit.value:.3g}"
            self._change(Trigger.LOSE, f"{why}, the limit is {hit.limit:.3g}")

    def _obstructed(self) -> str:
        """Why the arm cannot go on, empty when it can; then it brakes and is led back."""
        commanded, pressed = self._mover.commanded, self.contact.pressed()
        if pressed is None:
            why = self._watch.blocked()
            # Who feels nothing is not blocked: its state is stuck, or it was made slow.
            leads_back = bool(why) and not (self.contact.told and self.contact.quiet)
        else:
            name, value, limit, unit = pressed
            self._out.tell("warning", "limit", name, "stopped", value, limit)
            why = (
                f"something presses against the arm: {name} {value:.1f} {unit}, "
                f"at most {limit:g} {unit}; it is led back"
            )
            leads_back = True
        if leads_back and commanded is not None:
            self._retreat.begin(commanded)
        return why

    def _may_retreat(self, now_ns: int) -> bool:
        """The robot is there, well, and says where the arm is."""
        pose, gripper = self.pose, self.gripper_state
        if pose is None or gripper is None or self._watch.unheard(pose, gripper, now_ns):
            return False
        there = self._around.robot_node in self._around.alive
        return there and gripper.record.mode == "ready" and not gripper.record.faults

    def _tell_whether_it_feels(self) -> None:
        if self.contact.told is self._feels:
            return
        self._feels = self.contact.told
        if self._feels:
            self._out.tell("info", "notice", "contact_told", "the robot tells external forces")
        else:
            why = (
                "the robot tells no external wrench: limits.contact has nothing to look at, and an "
                "arm that is blocked is noticed by limits.tracking_m alone"
            )
            self._out.tell("warning", "notice", "contact_not_told", why)
