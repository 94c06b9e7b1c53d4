"""The command node's mind: chunks and settings in, a bounded smooth pose stream out.

`Commander.step` is called once a tick with everything that arrived since the last one. It has no
clock, no thread and no session; the same inputs give the same outputs, in a test, in lockstep with
a simulator and on the robot.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

from vla_zenoh.control import limits as bounds
from vla_zenoh.control.acceptance import Lease, Refusal, refuse
from vla_zenoh.control.actions import step_pose, step_width
from vla_zenoh.control.compose import Goal, GoalTimeline, Plan
from vla_zenoh.control.gripper import GripperArbiter
from vla_zenoh.control.joint_stage import JointStage
from vla_zenoh.control.names import worker_node
from vla_zenoh.control.preflight import (
    CLOCK_TOLERANCE_S,
    Surroundings,
    reasons_not_to_activate,
)
from vla_zenoh.control.reach import Shadow
from vla_zenoh.control.smoothing import Motion, Smoother, motion_limits
from vla_zenoh.control.so3 import (
    Pose,
    angle_between,
    norm3,
    quat_from_rotation,
    rotation_from_quat,
)
from vla_zenoh.control.states import OBEYING, State, Trigger, after
from vla_zenoh.errors import ProfileError, RecordError, VlaZenohError
from vla_zenoh.profile import Profile
from vla_zenoh.types import (
    MAX_TEXT,
    ActionChunk,
    Cause,
    Event,
    FloatArray,
    GripperCommand,
    GripperState,
    JointCommand,
    JointState,
    PoseCommand,
    PoseState,
    Stamped,
    Task,
)

FIRST_CHUNK_PATIENCE_S = 1.0
"""After activation a new observation, an inference and a chunk have to happen first."""
BOUND_AHEAD = 8
"""Steps of a chunk that are checked against the arm at once; the rest when they come due."""
JOINT_PATIENCE_S = 0.1
SAME_TCP_M, SAME_TCP_RAD = 0.005, 0.02
"""Kinematics and the robot's own word on its TCP may differ by this much."""
LINGER_NS = 500_000_000
"""The stream goes on for this long after the arm stands, so that its last pose is not lost."""
SAME_WIDTH_M = 0.005
"""A gripper this near to the width last sent has reached it."""
BACK_OFF_M, BACK_OFF_RAD = 0.005, 0.02
"""A blocked arm that is led back may stray by this much more before it counts as blocked again."""


class Setting(NamedTuple):
    """Somebody put a setting. `name`: prompt, active, worker, rate, stop, reset or lose."""

    name: str
    value: str | bool | float | None = None


@dataclass(slots=True)
class Inputs:
    """Everything that arrived since the last tick, oldest first.

    Args:
        settings: in the order they were put.
        chunks: of all workers.
        pose: newest TCP pose, or None when none came since.
        gripper: likewise.
        around: the nodes around; None: unchanged.
        joint: newest joints, looked at when the arm is activated.
    """

    settings: Sequence[Setting] = ()
    chunks: Sequence[Stamped[ActionChunk]] = ()
    pose: Stamped[PoseState] | None = None
    gripper: Stamped[GripperState] | None = None
    around: Surroundings | None = None
    joint: Stamped[JointState] | None = None


@dataclass(slots=True)
class Outputs:
    """What to publish.

    Args:
        pose: None while nothing is streamed, or where joints are commanded.
        joint: None while nothing is streamed, or where poses are commanded.
        gripper: None unless a new width is to be sent.
        task_changed: `Commander.task` differs from the last tick's.
        events: what happened.
        refusals: counted by reason by the caller.
        accepted: the chunk that came in force with this tick, for latencies.
    """

    pose: PoseCommand | None = None
    joint: JointCommand | None = None
    gripper: GripperCommand | None = None
    task_changed: bool = False
    events: list[Event] = field(default_factory=list)
    refusals: list[Refusal] = field(default_factory=list)
    accepted: Cause | None = None


class Commander:
    """See the module.

    Args:
        profile: limits, timing and first settings.
        reach: the arm's kinematic shadow; None: only the workspace box bounds a goal, and joints
            cannot be commanded.
        dry_run: compute everything, stream nothing.
    """

    def __init__(
        self, profile: Profile, *, reach: Shadow | None = None, dry_run: bool = False
    ) -> None:
        self.profile = profile
        self.reach = reach
        self._joints: JointStage | None = None
        if profile.robot.command == "joint":
            if reach is None:
                raise ProfileError("robot.command is joint, which needs the robot's kinematics")
            self._joints = JointStage(profile, reach.kinematics)
        self.dry_run = dry_run
        self.state = State.INACTIVE
        self.why = "not activated yet"
        self.task = Task(0, False, profile.task.prompt, profile.task.worker, profile.task.rate_hz)
        self.pose: Stamped[PoseState] | None = None
        self.joint: Stamped[JointState] | None = None
        self.gripper_state: Stamped[GripperState] | None = None
        self.gripper = GripperArbiter(profile.robot.gripper)
        self.lease: Lease | None = None
        self.accepted_chunks = 0
        self.accepted_steps = 0
        self.policy_done = False
        self.tracking_m = 0.0
        self.tracking_rad = 0.0
        self._around = Surroundings()
        self._shadow: dict[str, Stamped[ActionChunk]] = {}
        self._smoother: Smoother | None = None
        self._timeline: GoalTimeline | None = None
        self._deadline_ns = 0
        self._excused = (0.0, 0.0)
        self._rest_since_ns: int | None = None
        self._streaming = False
        self._target: Goal | None = None
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
        for chunk in inputs.chunks:
            self._take_chunk(chunk, now_ns)
        self._watch(now_ns)
        self._move(now_ns, ticks)
        if self.state is not state_before and self.task.active != (self.state in OBEYING):
            self.task = replace(self.task, active=self.state in OBEYING)
        self._out.task_changed = self.task != task_before
        return self._out

    @property
    def goal(self) -> Goal | None:
        """Where the arm is heading, None before the first activation."""
        return self._target

    @property
    def at_rest(self) -> bool:
        """What is commanded stands still."""
        still = self._joints is None or self._joints.at_rest
        return self._smoother is None or (self._smoother.at_rest and still)

    @property
    def streaming(self) -> bool:
        """Poses are being published."""
        return self._streaming

    @property
    def smoothing_failures(self) -> int:
        """Times Ruckig found no way and the arm was braked instead."""
        return self._smoother.failures if self._smoother else 0

    # -- inputs -------------------------------------------------------------------------------
    def _take_state(self, inputs: Inputs) -> None:
        if inputs.around is not None:
            self._around = inputs.around
        if inputs.pose is not None:
            self.pose = inputs.pose
        if inputs.joint is not None:
            self.joint = inputs.joint
        if inputs.gripper is not None:
            self.gripper_state = inputs.gripper
            faults, mode = inputs.gripper.record.faults, inputs.gripper.record.mode
            if faults:
                self._change(Trigger.FAULT, f"the robot reports: {'; '.join(faults)}")
            elif mode != "ready":
                self._change(Trigger.LOSE, f"the robot is not ready but {mode!r}")

    def _take_setting(self, setting: Setting, now_ns: int, stopped: bool) -> None:
        name, value = setting.name, setting.value
        if stopped and (name == "reset" or (name == "active" and value is True)):
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
        elif name == "active" and value is True:
            self._activate(now_ns)
        elif name == "active" and value is False:
            self._change(Trigger.DEACTIVATE, "deactivated")
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
        self.accepted_chunks = self.accepted_steps = 0
        self.policy_done = False
        if self.state in OBEYING:
            self._deadline_ns = now_ns + self._patience_ns(FIRST_CHUNK_PATIENCE_S)

    def _change_worker(self, worker: str, now_ns: int) -> None:
        if self.state in OBEYING:
            lease, reasons = self._preflight(worker, now_ns)
            if lease is None:
                self._refuse_setting("worker", reasons)
                return
            self.lease = lease
        self._new_episode(now_ns, worker=worker)

    def _activate(self, now_ns: int) -> None:
        if self.state in OBEYING:
            return
        if self.state is not State.INACTIVE:
            self._refuse_setting(
                "activate", [f"the state is {self.state.value} ({self.why}); put anything on reset"]
            )
            return
        lease, reasons = self._preflight(self.task.worker, now_ns)
        if lease is None or self.pose is None or self.gripper_state is None:
            self._refuse_setting("activate", reasons)
            return
        self.lease = lease
        self._anchor(self.pose.record, self.gripper_state.record, now_ns)
        self._change(Trigger.ACTIVATE, f"activated with worker {self.task.worker!r}")
        self._new_episode(now_ns)

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
        reasons += self._why_joints_do_not_fit(now_ns)
        if reasons or chunk is None:
            return None, reasons
        spec = self._around.specs[worker]
        return Lease(spec, chunk.header.source, now_ns, chunk.header.seq), []

    def _why_joints_do_not_fit(self, now_ns: int) -> list[str]:
        """Whether the kinematics know this robot: joints heard, and their TCP where it is said."""
        if self.reach is None or self.pose is None:
            return []
        if self.joint is None:
            return ["the joints are not known: nothing was heard on state/joint"]
        age_s = (now_ns - self.joint.received_ns) / 1e9
        if age_s > self.profile.timing.state_timeout_s + JOINT_PATIENCE_S:
            return [f"the joint state is {age_s:.2f} s old"]
        measured = Pose(self.pose.record.position_m, rotation_from_quat(self.pose.record.quat_xyzw))
        kinematics = self.reach.kinematics
        try:
            joints_rad = kinematics.joints_of(self.joint.record)
        except VlaZenohError as error:
            return [str(error)]
        apart_m, apart_rad = _distance(kinematics.forward(joints_rad), measured)
        if apart_m > SAME_TCP_M or apart_rad > SAME_TCP_RAD:
            return [
                f"the joints put the TCP {apart_m * 1e3:.1f} mm and {apart_rad:.3f} rad from where "
                "the robot says it is: robot.description or robot.tcp_frame is another robot's"
            ]
        return []

    def _refuse_setting(self, what: str, reasons: list[str]) -> None:
        self.why = f"{what} refused: {'; '.join(reasons)}"
        for reason in reasons:
            self._tell("warning", "refusal", f"{what}_refused", reason)
            self._out.refusals.append(Refusal(f"{what}_refused", reason))

    def _anchor(self, measured: PoseState, gripper: GripperState, now_ns: int) -> None:
        """Begin where the robot's own controller stands, so that nothing jumps."""
        if self.reach is not None and self.joint is not None:
            self.reach.reset(self.reach.kinematics.joints_of(self.joint.record))
        actual = Pose(measured.position_m, rotation_from_quat(measured.quat_xyzw))
        start = actual
        if measured.reference_position_m is not None and measured.reference_quat_xyzw is not None:
            start = Pose(
                measured.reference_position_m, rotation_from_quat(measured.reference_quat_xyzw)
            )
        apart_m, apart_rad = _distance(start, actual)
        limits = self.profile.limits
        blocked = apart_m > limits.tracking_m or apart_rad > limits.tracking_rad
        self._excused = (apart_m, apart_rad) if blocked else (0.0, 0.0)
        if self._smoother is None:
            self._smoother = Smoother(
                start, 1.0 / self.profile.timing.command_hz, motion_limits(limits)
            )
        elif not self._streaming:
            self._smoother.reset(start)
        if self._joints is not None and not self._streaming:
            self._joints.restart(self._held_joints())
        width_m = self._width_to_keep(gripper)
        self.gripper.restart(width_m)
        # A blocked arm's controller is led back to where the arm is. Otherwise a brake under way
        # goes on to its end, and the goal is where it ends.
        resting = self._smoother.resting_pose()
        goal = Goal(actual if blocked else resting, width_m)
        if self._timeline is None:
            self._timeline = GoalTimeline(goal, now_ns)
        else:
            self._timeline.restart(goal, now_ns)
        self._target = None if blocked else goal
        self._deadline_ns = now_ns + self._patience_ns(FIRST_CHUNK_PATIENCE_S)

    def _held_joints(self) -> FloatArray:
        """Joints the robot's controller holds, or where they are."""
        assert self.reach is not None and self.joint is not None
        state, kinematics = self.joint.record, self.reach.kinematics
        if state.reference_rad is not None:
            return kinematics.ordered(state.names, state.reference_rad)
        return kinematics.joints_of(state)

    def _width_to_keep(self, gripper: GripperState) -> float:
        """The width last sent while the gripper obeys it, because a grip ends with another."""
        sent_m, max_m = self.gripper.sent_m, self.gripper_max_m
        if sent_m is not None and (
            abs(sent_m - gripper.width_m) < SAME_WIDTH_M
            or (gripper.holding and sent_m < gripper.width_m)
        ):
            return sent_m
        return min(max(gripper.width_m, 0.0), max_m)

    def _reset(self) -> None:
        faults = self.gripper_state.record.faults if self.gripper_state else ()
        if self.state is State.FAULT and faults:
            self._refuse_setting("reset", [f"the robot still reports: {'; '.join(faults)}"])
            return
        self._change(Trigger.RESET, "reset")

    def _take_chunk(self, chunk: Stamped[ActionChunk], now_ns: int) -> None:
        worker = chunk.record.worker
        owner = self._around.spec_sources.get(worker)
        if owner is None:
            self._refuse(Refusal("unknown_worker", "its spec is not known yet", quiet=True), worker)
            return
        if chunk.header.source != owner:
            self._refuse(
                Refusal(
                    "foreign",
                    f"a chunk by {chunk.header.source[:60]!r}, who did not publish this worker's "
                    "spec",
                ),
                worker,
            )
            return
        if self.state not in OBEYING or worker != self.task.worker or self.lease is None:
            self._shadow[worker] = chunk
            return
        refusal = refuse(
            chunk, self.lease, self.task, self.profile.timing.max_observation_age_s, now_ns
        )
        if refusal is None:
            refusal = self._compose(chunk, now_ns)
        if refusal is not None:
            self._refuse(refusal, worker)
            return
        self._shadow[worker] = chunk
        self.lease.last_observation_ns = chunk.record.observation_stamp_ns
        self.accepted_chunks += 1
        if not self.policy_done:  # what comes after that only keeps the arm where it is
            self.accepted_steps += len(chunk.record.steps)
        self.policy_done = chunk.record.done
        self._change(Trigger.FRESH, "fresh chunk")

    def _compose(self, chunk: Stamped[ActionChunk], now_ns: int) -> Refusal | None:
        assert self.lease is not None and self._timeline is not None
        action, record = self.lease.spec.action, chunk.record
        before = self._timeline.at(record.observation_stamp_ns)
        refusing = self.profile.limits.out_of_bounds == "refuse"
        goals: list[Goal] = []
        hits: list[bounds.LimitHit] = []
        for step in record.steps:
            try:
                asked = step_pose(action, step, before.pose)
                width_m = step_width(action, step, before.width_m, self.gripper_max_m)
            except RecordError as error:
                return Refusal("meaning", str(error))
            pose, acted = bounds.bound_step(self.profile.limits, before.pose, asked)
            for hit in acted:
                if hit.fatal:
                    return Refusal(
                        hit.name,
                        f"a step of {hit.value:.4g} is over {bounds.REFUSE_FACTOR:g} times its "
                        "limit; is its unit right?",
                        hit.value,
                        hit.limit,
                    )
            joints_rad = None
            if self.reach is not None and (len(goals) < BOUND_AHEAD or refusing):
                pose, cut = self.reach.bound(before.pose, pose, action.dt_s, before.joints_rad)
                acted = [*acted, *cut]
                joints_rad = self.reach.joints_rad
            if acted and refusing:
                return Refusal(
                    acted[0].name, "out of bounds, and the profile says refuse", *acted[0][1:3]
                )
            hits += acted
            before = Goal(pose, before.width_m if width_m is None else width_m, joints_rad)
            goals.append(before)
        self._tell_shortened(hits)
        cause = Cause(
            record.worker,
            chunk.header.seq,
            record.observation_stamp_ns,
            record.observed_ns,
            record.inference_start_ns,
            record.inference_end_ns,
            chunk.header.stamp_wall_ns,
            chunk.received_ns,
        )
        plan = Plan(
            max(chunk.header.stamp_wall_ns, record.observation_stamp_ns),
            record.observation_stamp_ns,
            max(int(action.dt_s * 1e9), 1),
            goals,
            cause,
            len(goals) if self.reach is None or refusing else min(len(goals), BOUND_AHEAD),
        )
        self._timeline.add(plan, now_ns)
        self._deadline_ns = max(plan.end_ns, now_ns) + self._patience_ns(0.0)
        self._out.accepted = cause
        return None

    @property
    def gripper_max_m(self) -> float:
        """Widest opening."""
        return self.profile.robot.gripper.max_width_m

    def _refuse(self, refusal: Refusal, worker: str) -> None:
        self._out.refusals.append(refusal)
        if not refusal.quiet:
            self._tell(
                "warning",
                "refusal",
                refusal.reason,
                f"{worker}: {refusal.why}",
                refusal.value,
                refusal.limit,
            )

    # -- watching -----------------------------------------------------------------------------
    def _patience_ns(self, extra_s: float) -> int:
        """How long to wait for the next chunk: one period at the asked rate, and the watchdog."""
        return int((1.0 / self.task.rate_hz + self.profile.timing.watchdog_s + extra_s) * 1e9)

    def _watch(self, now_ns: int) -> None:
        if self.pose is not None:
            self._measure_tracking(self.pose.record)
        if self.state not in OBEYING:
            return
        lost = self._what_is_lost(now_ns)
        if lost:
            self._change(Trigger.LOSE, lost)
        elif now_ns > self._deadline_ns:
            self._change(Trigger.STARVE, "no fresh chunk within the watchdog")

    def _measure_tracking(self, measured: PoseState) -> None:
        reference = self._smoother.motion.pose if self._smoother and self._streaming else None
        if reference is None:
            self.tracking_m = self.tracking_rad = 0.0
            return
        actual = Pose(measured.position_m, rotation_from_quat(measured.quat_xyzw))
        self.tracking_m, self.tracking_rad = _distance(reference, actual)

    def _what_is_lost(self, now_ns: int) -> str:
        assert self.pose is not None and self.gripper_state is not None and self.lease is not None
        patience_s = self.profile.timing.state_timeout_s
        for what, state in (("pose", self.pose), ("gripper", self.gripper_state)):
            silent_s = (now_ns - state.received_ns) / 1e9
            if silent_s > patience_s:
                return f"robot state lost: {what} {silent_s:.3f} s old, at most {patience_s:g} s"
            late_s = (now_ns - state.header.stamp_wall_ns) / 1e9 - CLOCK_TOLERANCE_S
            if late_s > patience_s:
                return f"robot state comes late: {what} by {late_s:.3f} s, at most {patience_s:g} s"
        worker = self.task.worker
        needed = [self._around.robot_node, worker_node(worker)]
        needed += [
            self._around.camera_nodes.get(camera.camera, "camera")
            for camera in self.lease.spec.observation.cameras
        ]
        for node in needed:
            if node not in self._around.alive:
                return f"node {node!r} is gone"
        if self._around.spec_sources.get(worker) != self.lease.source:
            return f"worker {worker!r} was started anew"
        return "" if self.dry_run else self._blocked()

    def _blocked(self) -> str:
        if not self._streaming:
            return ""
        limits = self.profile.limits
        for apart, limit, excused, back_off, unit in (
            (self.tracking_m, limits.tracking_m, self._excused[0], BACK_OFF_M, "m"),
            (self.tracking_rad, limits.tracking_rad, self._excused[1], BACK_OFF_RAD, "rad"),
        ):
            allowed = max(limit, excused + back_off if excused else 0.0)
            if apart > allowed:
                return (
                    f"the arm does not follow: {apart:.3f} {unit} from its command, "
                    f"at most {allowed:.3g} {unit} (is it blocked?)"
                )
        # What was won back on the way out of a blockade is not given away again.
        self._excused = (
            min(self._excused[0], self.tracking_m),
            min(self._excused[1], self.tracking_rad),
        )
        return ""

    def _change(self, trigger: Trigger, why: str) -> None:
        new = after(self.state, trigger)
        if new is self.state:
            return
        old, self.state, self.why = self.state, new, why
        level = (
            "info"
            if new in OBEYING or trigger in (Trigger.DEACTIVATE, Trigger.RESET)
            else "warning"
        )
        self._tell(level, "transition", f"{old.value}->{new.value}", why)

    def _tell(
        self,
        level: str,
        kind: str,
        what: str,
        why: str,
        value: float | None = None,
        limit: float | None = None,
    ) -> None:
        if value is not None and not math.isfinite(value):
            value = None
        self._out.events.append(Event(level, kind, what, why[:MAX_TEXT], value, limit))

    # -- motion -------------------------------------------------------------------------------
    def _move(self, now_ns: int, ticks: int) -> None:
        if self._smoother is None or self._timeline is None:
            return
        cause: Cause | None = None
        if self.state is State.ACTIVE:
            cause = self._follow(self._smoother, self._timeline, now_ns)
        else:
            self._brake(self._smoother, self._timeline, now_ns)
        if not self._must_stream(now_ns):
            self._streaming = False
            return
        self._streaming = True
        failures = self._smoother.failures
        motion = self._smoother.motion
        for _ in range(ticks):
            motion = self._smoother.tick()
            if self._joints is not None:
                self._joints.tick(motion)
        if self._smoother.failures > failures:
            self._change(Trigger.FAULT, "no trajectory could be computed; braked")
        if not self.dry_run and self._joints is not None:
            self._out.joint = self._joints.command(self.state.value, cause)
        elif not self.dry_run:
            self._out.pose = self._command(motion, cause)
        if self.state is State.ACTIVE and not self.dry_run:
            self._out.gripper = self.gripper.step(now_ns, self.gripper_state)

    def _follow(self, smoother: Smoother, timeline: GoalTimeline, now_ns: int) -> Cause | None:
        plan = timeline.plan
        index = plan.index_at(now_ns)
        goal = plan.goals[index]
        if self.reach is not None and plan.cause is not None and index >= plan.bounded:
            self._bound_until(plan, timeline, index)
            goal = plan.goals[index]
        if goal is not self._target:
            pose, hits = bounds.leash(self.profile.limits, goal.pose, smoother.motion.pose)
            if hits:
                goal = Goal(pose, goal.width_m)  # between two goals that were bounded
                timeline.shift_rest(index, goal, self.profile.limits)
                self._tell("warning", "limit", hits[0].name, "leash", hits[0].value, hits[0].limit)
            smoother.target(goal.pose)
            self._target = goal
            self.gripper.want(goal.width_m)
        return plan.cause

    def _bound_until(self, plan: Plan, timeline: GoalTimeline, index: int) -> None:
        """Bound the goals that a long chunk left for when they come due."""
        assert self.reach is not None
        for due in range(plan.bounded, index + 1):
            before, asked = plan.goals[due - 1], plan.goals[due]
            pose, cut = self.reach.bound(
                before.pose, asked.pose, plan.dt_ns / 1e9, before.joints_rad
            )
            goal = Goal(pose, asked.width_m, self.reach.joints_rad)
            if cut:
                timeline.shift_rest(due, goal, self.profile.limits)
                self._tell_shortened(cut)
            else:
                plan.goals[due] = goal
        plan.bounded = index + 1

    def _tell_shortened(self, hits: Sequence[bounds.LimitHit]) -> None:
        """The last bound that acted on a chunk: what stands in the way now."""
        for hit in hits[-1:]:
            where = f" at {hit.where}" if hit.where else ""
            self._tell("warning", "limit", hit.name, f"shortened{where}", hit.value, hit.limit)

    def _brake(self, smoother: Smoother, timeline: GoalTimeline, now_ns: int) -> None:
        """Stop, and let the goal be where the arm stops, so that nothing pulls it further."""
        smoother.brake()
        self._target = None
        if timeline.plan.cause is not None and smoother.at_rest:
            timeline.hold(Goal(smoother.motion.pose, timeline.at(now_ns).width_m), now_ns)

    def _must_stream(self, now_ns: int) -> bool:
        if self.state in OBEYING or not self.at_rest:
            self._rest_since_ns = None
            return self.state in OBEYING or self._streaming
        if self._rest_since_ns is None:
            self._rest_since_ns = now_ns
        return self._streaming and now_ns - self._rest_since_ns < LINGER_NS

    def _command(self, motion: Motion, cause: Cause | None) -> PoseCommand:
        goal = self._target.pose if self._target else motion.pose
        return PoseCommand(
            motion.pose.position_m,
            quat_from_rotation(motion.pose.rotation),
            motion.twist,
            motion.acceleration,
            goal.position_m,
            quat_from_rotation(goal.rotation),
            self.state.value,
            cause,
        )


def _distance(a: Pose, b: Pose) -> tuple[float, float]:
    return (
        norm3(a.position_m - b.position_m),
        angle_between(a.rotation, b.rotation),
    )
