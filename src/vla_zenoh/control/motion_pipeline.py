"""From the goals on the timeline to commands: leash, smoothing, joints, braking, streaming."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from operator import is_
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from vla_zenoh.control.aggregate import PlanAggregator
from vla_zenoh.control.chunk_planner import LOOK_AHEAD, ChunkPlanner
from vla_zenoh.control.commander_io import MotionCommands, limit_events, make_event
from vla_zenoh.control.contact import Contact, Retreat
from vla_zenoh.control.gripper_arbiter import GripperArbiter
from vla_zenoh.control.joint_space import JointPath
from vla_zenoh.control.limits import (
    APPROACH,
    LimitHit,
    Slowdown,
    into_workspace,
    leash,
    slowest,
    workspace_corners,
)
from vla_zenoh.control.plan_timeline import Goal, GoalTimeline, Plan, joint_goal
from vla_zenoh.control.reachability import ReachabilityFilter
from vla_zenoh.control.smoothing import FULL, Motion, Shares, Smoother, motion_limits
from vla_zenoh.control.states import OBEYING, State
from vla_zenoh.control.step_timing import StepTiming
from vla_zenoh.errors import ProfileError
from vla_zenoh.kinematics.so3 import (
    Pose,
    exp3,
    held_pose,
    interpolate,
    pose_distance,
    pose_of,
    quat_from_rotation,
)
from vla_zenoh.profile import Profile
from vla_zenoh.types import (
    Cause,
    Event,
    FloatArray,
    GripperState,
    JointState,
    PoseCommand,
    PoseState,
    Stamped,
    Task,
    computed,
)

if TYPE_CHECKING:
    from vla_zenoh.control.pose_to_joint import PoseToJoint

LINGER_NS = 500_000_000
"""The stream continues for this long after the arm stands, so that its last pose is not lost."""
SAME_WIDTH_M = 0.005
"""A gripper this near to the width sent last has reached it."""
HELD_M, HELD_RAD = 0.002, 0.01
"""A robot that holds a pose this near to the stream follows it: the stream continues."""
HELD_JOINT_RAD = 0.004
HELD_LEAD_M, HELD_LEAD_RAD = 0.01, 0.02
"""The goal of an arm that another part holds up leads it by this much at most."""
SAME_POSE = 1e-6
"""m and rad: joints whose TCP is this near to a pose reach it."""
SETTLED, SETTLED_NS = 5e-4, 100_000_000
"""A robot that moves by less than this, in m and rad, for this long stands."""


class _Order(NamedTuple):
    """Where to go, from when on, and when the watchdog brakes unless a chunk arrives."""

    goal: Goal
    plan: Plan
    task: Task
    overdue_ns: int
    now_ns: int


class _Ahead(NamedTuple):
    """The motion to a goal, computed before the tick in which it is expected to begin.

    Args:
        of: what it depends on: objects that do not change,
        at: and numbers.
        timing: with the goal taken.
        mover: on its way to it.
        enough: the shares suffice.
    """

    of: tuple[object, ...]
    at: tuple[float, ...]
    timing: StepTiming
    mover: Smoother | JointPath
    enough: bool


class MotionPipeline:
    """Follows the goals of the timeline, or brakes, in a smooth command stream.

    Args:
        profile: limits, rate, and whether poses or joints are commanded.
        reach: see `Commander`.
        planner: bounds the goals that come due.

    Raises:
        ProfileError: joints are to be commanded and there are no kinematics.
    """

    def __init__(
        self, profile: Profile, reach: ReachabilityFilter | None, planner: ChunkPlanner
    ) -> None:
        self._limits = profile.limits
        self._dt_s = 1.0 / profile.timing.command_hz
        self._max_width_m = profile.robot.gripper.max_width_m
        self._reach, self._planner = reach, planner
        self._aggregator = PlanAggregator(profile.composition)
        self._joints: PoseToJoint | None = None
        if profile.robot.command == "joint":
            if reach is None:
                raise ProfileError("robot.command is joint, which needs the robot's kinematics")
            from vla_zenoh.control.pose_to_joint import PoseToJoint

            self._joints = PoseToJoint(profile, reach.kinematics, reach.barriers)
        self._path: JointPath | None = None
        if planner.joint_bounds is not None:
            self._path = JointPath(profile, planner.joint_bounds)
        self.in_joints = False
        """The arm moves in joints, by `_path`."""
        self._changing = False
        """It brakes, because the goals in force are joints and it moves in poses, or vice versa."""
        self._no_joints = ""
        self.gripper = GripperArbiter(profile.robot.gripper)
        self.timeline: GoalTimeline | None = None
        self.goal: Goal | None = None
        self.streaming = False
        self.speed = 1.0
        """Share of the speed limits on the way to the goal, without the speed override."""
        self.slower: Slowdown | None = None
        """What reduces it."""
        self._override, self._slowing = 1.0, False
        self.contact_slowdown: Slowdown | None = None
        self.joint_slowdown: Slowdown | None = None
        """Of the measured joints; both apply whatever the goal allows."""
        self.part_slowdown: Slowdown | None = None
        """Of the distance to another part of the robot."""
        self.held = False
        """The arm has to stand: another part is too near."""
        self.contact = Contact(profile.limits.contact)
        self.retreat = Retreat(profile.limits, self.contact)
        self._back: Pose | None = None
        self._slowed_by: set[str] = set()
        self._smoother: Smoother | None = None
        self._mover: Smoother | JointPath | None = None
        """What moves the arm: the smoother of poses, or of joints; None before any activation."""
        self._standing: tuple[Pose, FloatArray | None, int] | None = None
        self._measured: tuple[PoseState | None, JointState | None] = None, None
        self._measured_ns = 0
        self._timings: list[StepTiming] = []
        """Of poses, and of joints."""
        self._ahead: _Ahead | None = None
        self._cause: Cause | None = None
        self._rest_since_ns: int | None = None
        self._sent: PoseCommand | None = None
        self._made_of: tuple[Motion, Goal | None, State, Cause | None] | None = None
        """The pose command made last, and what it was made of."""

    # -- state --------------------------------------------------------------------------------
    @property
    def at_rest(self) -> bool:
        """The commanded motion stands still."""
        mover = self._mover
        still = self.in_joints or self._joints is None or self._joints.at_rest
        return mover is None or (mover.at_rest and still)

    @property
    def commanded(self) -> Pose | None:
        """The pose streamed last, None while nothing is streamed."""
        mover = self._mover
        return mover.motion.pose if mover is not None and self.streaming else None

    @property
    def joints_rad(self) -> FloatArray | None:
        """(n,) joints commanded, None where poses are."""
        if self._joints is None:
            return None
        mover = self._mover
        return mover.state.position if isinstance(mover, JointPath) else self._joints.position_rad

    def stopping_rad(self, ahead_s: float) -> list[FloatArray]:
        """(n,) each, commanded joints on the way to rest and at rest, from a brake in `ahead_s`."""
        assert self._joints is not None
        mover = self._mover
        if mover is None:
            return [self._joints.position_rad]
        if isinstance(mover, JointPath):
            return mover.stopping_rad(ahead_s)
        return self._joints.stopping_rad(mover, ahead_s)

    def wanted_rad(self, now_ns: int) -> FloatArray | None:
        """(n,) joints of the goal in force, None where it has none."""
        if self.timeline is None:
            return None
        goal = self.timeline.at(now_ns)
        if goal.joints_rad is not None or self._reach is None:
            return goal.joints_rad
        return self._reach.joints_at(goal.pose)

    @property
    def stuck(self) -> str:
        """Why the arm will not reach its goal, empty while it follows."""
        if self._joints is None or self.in_joints:
            return self._no_joints
        return self._no_joints or self._joints.stuck

    @property
    def failures(self) -> int:
        """Times Ruckig found no trajectory and the arm braked instead."""
        smoother, path = self._smoother, self._path
        return (smoother.failures if smoother else 0) + (path.failures if path else 0)

    # -- activation ---------------------------------------------------------------------------
    def anchor(
        self,
        measured: PoseState,
        gripper: GripperState,
        joint: JointState | None,
        now_ns: int,
        *,
        blocked: bool,
        in_joints: bool = False,
    ) -> None:
        """Start at the set-point of the robot's controller, so that nothing jumps.

        Args:
            measured: TCP pose, with the controller's set-point if the robot reports it.
            gripper: its width is kept.
            joint: newest joints.
            now_ns: time of this tick.
            blocked: the arm is far from its controller's set-point.
            in_joints: the actions are joints.
        """
        self._slowed_by.clear()
        self.joint_slowdown = None
        self.retreat.end()
        measured_rad: FloatArray | None = None
        if self._reach is not None and joint is not None:
            measured_rad = self._reach.kinematics.joints_of(joint)
            self._reach.reset(measured_rad)
        actual, start = pose_of(measured), held_pose(measured)
        standing = not self.streaming or self.at_rest
        if standing:
            self._enter(joints=False)
        self._no_joints, self._changing = "", False
        if self._smoother is None:
            # Commanded joints have distance constraints of their own.
            inside = workspace_corners(self._limits) if self._joints is None else None
            self._smoother = Smoother(start, self._dt_s, motion_limits(self._limits), inside)
            self._mover = self._smoother
            self._timings = [
                StepTiming(mover.box) for mover in (self._smoother, self._path) if mover
            ]
        elif standing and not (
            self.streaming and self._near(*pose_distance(self._smoother.motion.pose, start))
        ):
            self._smoother.reset(start)
        if self._joints is not None and joint is not None:
            held_rad = self._held_joints(joint)
            apart_rad = float(np.abs(held_rad - self._joints.position_rad).max())
            if standing and not (self.streaming and apart_rad <= HELD_JOINT_RAD):
                self._joints.restart(held_rad)
            self._joints.keep_elbow()
        if in_joints and standing:
            self._enter(joints=True)
        width_m = self._width_to_keep(gripper)
        self.gripper.restart(width_m)
        # The goal of a blocked arm is where it is. Otherwise a brake continues, and the goal is
        # where it ends.
        goal = self._resting_goal(actual, width_m)
        if blocked and goal.arm is None:
            goal = Goal(actual, width_m)
        elif blocked and self._path is not None and measured_rad is not None:
            goal = joint_goal(self._path.kinematics, measured_rad, width_m)
        self._restart_timing()
        if self.timeline is None:
            self.timeline = GoalTimeline(goal, now_ns)
        else:
            self.timeline.restart(goal, now_ns)
        self.goal = None if blocked else goal

    def _restart_timing(self) -> None:
        for timing in self._timings:
            timing.restart()

    def _enter(self, *, joints: bool) -> None:
        """Act in joints or in poses from now on; only while the arm stands."""
        path, smoother, reach = self._path, self._smoother, self._reach
        if joints is self.in_joints or path is None or smoother is None or reach is None:
            return
        self.goal = None
        if not joints:
            smoother.reset(path.motion.pose)
            if self._joints is not None:
                self._joints.restart(path.state.position)
        elif self._joints is not None:
            path.stand(self._joints.position_rad)
        else:
            pose = smoother.motion.pose
            path.stand(reach.joints_at(pose))
            apart = pose_distance(path.motion.pose, pose)
            if max(apart) > SAME_POSE:
                self._no_joints = (
                    f"no joints were found for the commanded pose: {apart[0]:.4f} m and "
                    f"{apart[1]:.4f} rad are left"
                )
                return
        self.in_joints, self._mover = joints, path if joints else smoother
        self._restart_timing()

    def _resting_goal(self, actual: Pose, width_m: float) -> Goal:
        """Where a brake will end, no further outside the box than the arm is."""
        mover = self._mover
        assert mover is not None
        if isinstance(mover, JointPath):
            return joint_goal(mover.kinematics, mover.braked(), width_m)
        rest, (low, high) = mover.resting_pose(), workspace_corners(self._limits)
        least, most = np.minimum(low, actual.position_m), np.maximum(high, actual.position_m)
        return Goal(Pose(np.clip(rest.position_m, least, most), rest.rotation), width_m)

    def measure(self, measured: PoseState, joint: JointState | None, received_ns: int) -> None:
        """Track whether the robot still moves while the stream stands.

        A record that is repeated does not show that the robot stands.
        """
        if not self.streaming or not self.at_rest:
            self._standing = None
            return
        before, self._measured = self._measured, (measured, joint)
        if self._standing is None or not all(map(is_, before, self._measured)):
            held = held_pose(measured)
            held_rad = None if self._joints is None or joint is None else self._held_joints(joint)
            if self._standing is None or max(_apart(held, held_rad, *self._standing[:2])) > SETTLED:
                self._standing = held, held_rad, received_ns
        self._measured_ns = received_ns

    def unsettled(self) -> list[str]:
        """Reasons against an activation now: the robot still moves to the end of the stream.

        A robot that has braked by itself stands elsewhere: a new stream begins there.
        """
        if self._standing is None or self._mover is None:
            return []
        held, held_rad, since_ns = self._standing
        apart = _apart(held, held_rad, self._mover.motion.pose, self.joints_rad)
        if self._near(*apart) or self._measured_ns - since_ns > SETTLED_NS:
            return []
        joints = "" if held_rad is None else f", its joints {apart[2]:.3f} rad"
        return [
            f"the robot is still {apart[0]:.3f} m and {apart[1]:.3f} rad from its last "
            f"command{joints}; activate again in {LINGER_NS / 1e9:g} s"
        ]

    @staticmethod
    def _near(apart_m: float, apart_rad: float, joint_rad: float = 0.0) -> bool:
        """The robot holds the streamed pose: to restart there would be a step in the stream."""
        return apart_m <= HELD_M and apart_rad <= HELD_RAD and joint_rad <= HELD_JOINT_RAD

    def _held_joints(self, joint: JointState) -> FloatArray:
        """Joint set-points of the robot's controller, or the measured joints."""
        assert self._reach is not None
        kinematics = self._reach.kinematics
        if joint.reference_rad is not None:
            return kinematics.ordered(joint.names, joint.reference_rad)
        return kinematics.joints_of(joint)

    def _width_to_keep(self, gripper: GripperState) -> float:
        """The width sent last while the gripper follows it: another one would end a grasp."""
        sent_m = self.gripper.sent_m
        if sent_m is not None and (
            abs(sent_m - gripper.width_m) < SAME_WIDTH_M
            or (gripper.holding and sent_m < gripper.width_m)
        ):
            return sent_m
        return min(max(gripper.width_m, 0.0), self._max_width_m)

    # -- one tick -----------------------------------------------------------------------------
    def look_ahead(self, now_ns: int) -> list[Event]:
        """Bound the steps after the one that is due, as far as the budget goes."""
        if self.timeline is None:
            return []
        plans = self._aggregator.plans(self.timeline, now_ns)
        return limit_events(self._planner.bound_due(plans, now_ns, LOOK_AHEAD))

    def advance(
        self, state: State, task: Task, overdue_ns: int, now_ns: int, ticks: int
    ) -> tuple[bool, list[Event]]:
        """Advance by `ticks` periods: follow the goal in force if active, else brake.

        Args:
            state: of the command node.
            task: its rate and speed override.
            overdue_ns: when the watchdog brakes unless a chunk arrives.
            now_ns: time of this tick.
            ticks: see `Commander.step`.

        Returns:
            whether a trajectory was found (if not, the arm brakes), and events.
        """
        if self._mover is None or self.timeline is None:
            return True, []
        self._set_override(task.speed, self.timeline, now_ns)
        if state is State.ACTIVE:
            self._cause = self.timeline.plan.cause
            events = self._follow(self.timeline, task, overdue_ns, now_ns, ticks)
        else:
            self._cause = None
            events = self._retreat_or_brake(self._mover, self.timeline, state, now_ns)
        went_on, self.streaming = self.streaming, self._must_stream(state, now_ns)
        if not self.streaming:
            return True, events
        failures, mover = self.failures, self._mover  # which may be another by now
        # A stream that begins must begin at rest: no ticks are made up for.
        for _ in range(ticks if went_on else 1):
            if self._joints is None or isinstance(mover, JointPath):
                mover.tick()
            else:
                active = state is State.ACTIVE and self._override > 0.0
                active = active and not self._changing and not self.held
                braking = not active and self._back is None
                self._joints.tick(mover, braking=braking, elbow=active)
        if isinstance(mover, JointPath):
            events += limit_events(mover.taken_hits())
        return self.failures == failures, events

    def commands(
        self, state: State, now_ns: int, gripper: Stamped[GripperState] | None
    ) -> MotionCommands:
        """The set-points of robot and gripper, while streaming."""
        mover = self._mover
        if not self.streaming or mover is None:
            return MotionCommands()
        pose = joint = width = None
        if self._joints is None:
            pose = self._pose_command(mover.motion, state)
        elif isinstance(mover, JointPath):
            joint = mover.command(state.value, self._cause)
        else:
            joint = self._joints.command(state.value, self._cause)
        if state is State.ACTIVE and self._override > 0.0:
            width = self.gripper.step(now_ns, gripper)
        return MotionCommands(pose, joint, width)

    def forget_plan(self, oldest_ns: int, now_ns: int) -> bool:
        """Stand where the arm is, if the plan's observation was taken before `oldest_ns`."""
        timeline, mover = self.timeline, self._mover
        if timeline is None or mover is None:
            return False
        cause = timeline.plan.cause
        if cause is None or cause.observation_stamp_ns >= oldest_ns:
            return False
        self._hold(timeline, mover.motion.pose, now_ns)
        return True

    def _hold(self, timeline: GoalTimeline, actual: Pose, now_ns: int) -> None:
        timeline.hold(self._resting_goal(actual, timeline.at(now_ns).width_m), now_ns)
        self._restart_timing()

    def _set_override(self, override: float, timeline: GoalTimeline, now_ns: int) -> None:
        """Let plan time pass at the speed override, and replan the motion to the goal."""
        if override != self._override or override != timeline.clock.override:
            self._override = override
            timeline.clock.set(override, now_ns)
            self.goal, self._slowing = None, override > 0.0

    def _follow(
        self, timeline: GoalTimeline, task: Task, overdue_ns: int, now_ns: int, ticks: int
    ) -> list[Event]:
        plans = self._aggregator.plans(timeline, now_ns)
        found = self._planner.bound_due(plans, now_ns)
        events = limit_events(found) if found else []
        goal = self._aggregator.goal(plans, now_ns)
        joints = goal.arm is not None
        if joints is not self.in_joints and self.at_rest:
            self._enter(joints=joints)
        self._changing = joints is not self.in_joints
        mover = self._mover
        assert mover is not None
        if self.held and not self._changing:
            self._cut_lead(mover, plans, goal, now_ns)
        if self._override == 0.0 or self._changing or self.held:
            self._pause(mover)
            return events
        slowed = self._slowing and _within(mover, self._override)
        short, hits = self._on_leash(mover, goal, ticks * self._dt_s)
        slower = self._slowest(goal)
        slowed |= (slower.share if slower else 1.0) != self.speed
        if goal is not self.goal or hits or slowed:
            if hits:
                if goal is not self.goal:
                    name, value, limit = hits[0][:3]
                    events.append(make_event("warning", "limit", name, "leash", value, limit))
                goal = self._shorten(plans, goal, short, now_ns)
            events += self._slow_down(slower)
            order = _Order(goal, timeline.plan, task, overdue_ns, now_ns)
            enough = self._set_out(mover, order)
            self._slowing &= not (enough and _within(mover, self._override))
            self.goal = goal
            self.gripper.request(goal.width_m)
        return events

    def plan_ahead(self, task: Task, overdue_ns: int, next_ns: int) -> bool:
        """Compute the motion to the goal that comes into force at the next tick, if one does.

        That tick takes it over if nothing that the motion depends on has changed by then.

        Args:
            task: its rate.
            overdue_ns: when the watchdog brakes unless a chunk arrives.
            next_ns: time of the next tick.
        """
        timeline, mover = self.timeline, self._mover
        self._ahead = None
        if timeline is None or mover is None or self.held or self._override == 0.0:
            return False
        plans = self._aggregator.plans(timeline, next_ns)
        if len(plans) > 1:  # their mix is another goal in every tick
            return False
        goal = self._aggregator.goal(plans, next_ns)
        if goal is self.goal or (goal.arm is not None) is not self.in_joints:
            return False
        if self._on_leash(mover, goal, self._dt_s)[1]:
            return False
        slower, speed = self._slowest(goal), self.speed
        self.speed = 1.0 if slower is None else slower.share
        self._ahead = self._motion_to(mover, _Order(goal, plans[0], task, overdue_ns, next_ns))
        self.speed = speed
        return True

    def forget_ahead(self) -> None:
        """Compute the motion to the next goal again: its bounds have changed."""
        self._ahead = None

    def _slowest(self, goal: Goal) -> Slowdown | None:
        others = self.contact_slowdown, self.joint_slowdown, self.part_slowdown
        return slowest(goal.slowdown, *others)

    def _set_out(self, mover: Smoother | JointPath, order: _Order) -> bool:
        """Carry out an order; whether the shares suffice."""
        ahead, self._ahead = self._ahead, None
        of, at = self._depends_on(mover, order)
        if ahead is None or ahead.at != at or not all(map(is_, ahead.of, of)):
            ahead = self._motion_to(mover, order)
        self._timings[self.in_joints] = ahead.timing
        mover.adopt(ahead.mover)  # pyright: ignore
        return ahead.enough

    def _depends_on(
        self, mover: Smoother | JointPath, order: _Order
    ) -> tuple[tuple[object, ...], tuple[float, ...]]:
        """The objects and numbers that the motion of an order depends on."""
        goal, plan, task, overdue_ns, now_ns = order
        index, shares = plan.index_at(now_ns), (self.speed, self._override, self._slowing)
        of = goal, plan, mover, mover.state
        return of, (now_ns, overdue_ns, task.rate_hz, index, *shares)

    def _motion_to(self, mover: Smoother | JointPath, order: _Order) -> _Ahead:
        """The motion of an order from the present state."""
        of, at = self._depends_on(mover, order)
        timing, mover = self._timings[self.in_joints].fork(), mover.fork()
        shares = self._shares(timing, mover, order)
        hard = self._slowing and (self._joints is None or self.in_joints)
        return _Ahead(of, at, timing, mover, _move(mover, order.goal, shares, hard=hard))

    def _on_leash(
        self, mover: Smoother | JointPath, goal: Goal, ahead_s: float
    ) -> tuple[Goal, list[LimitHit]]:
        """`goal`, or a nearer one that is no further ahead than the leash allows.

        The leash starts where the arm is in this tick: it may be moving away from the last goal.
        """
        if isinstance(mover, JointPath):
            return mover.leash(goal, ahead_s)
        if self._well_within_leash(mover.motion, goal.pose, ahead_s):
            return goal, []
        pose, hits = leash(self._limits, goal.pose, _ahead(mover.motion, ahead_s))
        return replace(goal, pose=pose, joints_rad=None) if hits else goal, hits

    def _well_within_leash(self, motion: Motion, goal: Pose, ahead_s: float) -> bool:
        """Whether the leash is long enough wherever the arm will be; cheaper than computing where.

        It moves no further than at its speed plus what the acceleration adds.
        """
        limits, (pose, twist, acceleration) = self._limits, motion
        apart_m, apart_rad = pose_distance(goal, pose)
        x, y, z, rx, ry, rz = map(abs, twist.tolist())
        ax, ay, az, arx, ary, arz = map(abs, acceleration.tolist())
        way_m = ahead_s * (x + y + z + ahead_s * (ax + ay + az))
        turn_rad = ahead_s * (rx + ry + rz + ahead_s * (arx + ary + arz))
        return apart_m + way_m <= limits.lead_m and apart_rad + turn_rad <= limits.lead_rad

    def _cut_lead(
        self, mover: Smoother | JointPath, plans: Sequence[Plan], goal: Goal, now_ns: int
    ) -> None:
        """Keep the goal of an arm that has to stand close to it, so that the arm can retreat."""
        if isinstance(mover, JointPath):
            assert goal.joints_rad is not None
            here_rad = mover.state.position
            way_rad = goal.joints_rad - here_rad
            share = HELD_LEAD_RAD / max(float(np.abs(way_rad).max()), HELD_LEAD_RAD)
            cut = joint_goal(mover.kinematics, here_rad + share * way_rad, goal.width_m)
        else:
            here = mover.motion.pose
            apart_m, apart_rad = pose_distance(here, goal.pose)
            share = 1 / max(apart_m / HELD_LEAD_M, apart_rad / HELD_LEAD_RAD, 1.0)
            cut = replace(goal, pose=interpolate(here, goal.pose, share), joints_rad=None)
        if share < 1.0:
            self._shorten(plans, goal, cut, now_ns)

    def _pause(self, mover: Smoother | JointPath) -> None:
        """Stop on the path, to continue from there later."""
        if self._joints is None or isinstance(mover, JointPath):
            mover.brake(FULL)
        else:
            self._joints.brake(mover)
        self.goal = None

    def _shares(self, timing: StepTiming, mover: Smoother | JointPath, order: _Order) -> Shares:
        """Shares of the limits that the arm has on the way to a goal."""
        goal, plan, task, overdue_ns, now_ns = order
        override, speed = self._override, self.speed * self._override
        if not plan.soonest:
            joints = isinstance(mover, JointPath)
            way = mover.way_to(goal) if joints else mover.way_to(goal.pose)
            velocity, _ = mover.axis_rates()
            index, left_s = plan.index_at(now_ns), (overdue_ns - now_ns) / 1e9
            share = timing.share(plan, index, now_ns, 1.0 / task.rate_hz, left_s, way, velocity)
            speed = min(speed, share)
        # The same motion in more time: acceleration scales with the square of the override, jerk
        # with the cube. Until a faster arm has slowed down it brakes as hard as it may.
        slow = _within(mover, override)
        most = Shares(1.0, override**2, override**3) if slow else FULL
        return self._followed(mover, goal, Shares(speed, most.acceleration, most.jerk))

    def _followed(self, mover: Smoother | JointPath, goal: Goal, shares: Shares) -> Shares:
        """`shares`, reduced to what commanded joints can follow, or the TCP of a joint motion."""
        if isinstance(mover, JointPath):
            return Shares(*map(min, mover.shares(goal), shares))
        if self._joints is None:
            return shares
        joints = self._joints.shares(mover.motion, goal.pose, mover.box)
        return Shares(*map(min, joints, shares))

    def _slow_down(self, slower: Slowdown | None) -> list[Event]:
        """Set the speed share; report each reason once per activation."""
        self.speed, self.slower = (1.0, None) if slower is None else (slower.share, slower)
        if slower is None or slower.name in (APPROACH, *self._slowed_by):
            return []
        self._slowed_by.add(slower.name)
        why = f"slower{slower.at}"
        return [make_event("info", "limit", slower.name, why, slower.value, slower.limit)]

    def _shorten(self, plans: Sequence[Plan], goal: Goal, cut: Goal, now_ns: int) -> Goal:
        """Shift all later goals by what the leash cut off, or the cut part would come back.

        A shifted goal lies between bounded goals.
        """
        if len(plans) == 1:
            plans[0].shift_rest(plans[0].index_at(now_ns), cut, self._limits)
            return cut
        for plan in plans:
            plan.shift(plan.index_at(now_ns), goal, cut, self._limits)
        return cut

    def _retreat_or_brake(
        self, mover: Smoother | JointPath, timeline: GoalTimeline, state: State, now_ns: int
    ) -> list[Event]:
        if state is not State.INACTIVE or self.held:
            self.retreat.end()
        back, event = self.retreat.step(mover.motion.pose, now_ns, at_rest=self.at_rest)
        if back is not None and isinstance(mover, JointPath) and self._smoother is not None:
            self._enter(joints=False)
            mover = self._smoother
        if back is None:
            self._brake(mover, timeline, now_ns)
        elif back is not self._back:
            # Whatever the speed override: an arm in contact has to come free.
            here_m = mover.motion.pose.position_m
            inside_m, _ = into_workspace(self._limits, back.position_m, here_m)
            inside = Goal(Pose(inside_m, back.rotation), 0.0)
            speed = self._followed(mover, inside, Shares(self.retreat.speed))
            _move(mover, inside, speed)
        self._back = back
        return [] if event is None else [event]

    def _brake(self, mover: Smoother | JointPath, timeline: GoalTimeline, now_ns: int) -> None:
        """Stop, and move the goal to where the arm stops, so that nothing pulls it further."""
        if isinstance(mover, JointPath):
            mover.brake(FULL)  # on the path, which is known to be free
        elif self._joints is None:
            mover.brake()
        else:
            self._joints.brake(mover)
        self.goal = None
        if timeline.plan.cause is not None and mover.at_rest:
            self._hold(timeline, mover.motion.pose, now_ns)

    def _must_stream(self, state: State, now_ns: int) -> bool:
        if state in OBEYING or self.retreat.busy or not self.at_rest:
            self._rest_since_ns = None
            return state in OBEYING or self.streaming
        if self._rest_since_ns is None:
            self._rest_since_ns = now_ns
        return self.streaming and now_ns - self._rest_since_ns < LINGER_NS

    def _pose_command(self, motion: Motion, state: State) -> PoseCommand:
        made_of = motion, self.goal, state, self._cause
        if self._made_of and self._sent and all(map(is_, made_of, self._made_of)):
            return self._sent  # the arm is at rest
        (position_m, rotation), twist, acceleration = motion
        goal, quat_xyzw = self.goal, quat_from_rotation(rotation)
        if goal is None:
            heads_m, heads_xyzw = position_m, quat_xyzw
        elif self._sent and self._made_of and goal is self._made_of[1]:
            heads_m, heads_xyzw = self._sent.goal_position_m, self._sent.goal_quat_xyzw
        else:
            heads_m, heads_xyzw = goal.pose.position_m, quat_from_rotation(goal.pose.rotation)
        self._made_of = made_of
        moves, heads = (position_m, quat_xyzw, twist, acceleration), (heads_m, heads_xyzw)
        self._sent = computed(PoseCommand, *moves, *heads, state.value, self._cause)
        return self._sent


def _apart(
    pose: Pose, joints_rad: FloatArray | None, other: Pose, others_rad: FloatArray | None
) -> tuple[float, float, float]:
    """Distance of two poses in m and rad, and of the joints in rad where both are known."""
    joint_rad = 0.0
    if joints_rad is not None and others_rad is not None:
        joint_rad = float(np.abs(joints_rad - others_rad).max())
    return *pose_distance(pose, other), joint_rad


def _ahead(motion: Motion, dt_s: float) -> Pose:
    """The pose of a motion `dt_s` later."""
    (position_m, rotation), twist, acceleration = motion
    way = dt_s * (twist + 0.5 * dt_s * acceleration)
    return Pose(position_m + way[:3], exp3(way[3:]).dot(rotation))


def _move(mover: Smoother | JointPath, goal: Goal, shares: Shares, *, hard: bool = False) -> bool:
    """Move to `goal`; whether the shares suffice."""
    if isinstance(mover, JointPath):
        return mover.target(goal, shares, all_to_stop=hard)
    return mover.target(goal.pose, shares, all_to_stop=hard)


def _within(mover: Smoother | JointPath, override: float) -> bool:
    """Whether the arm moves as slowly as it would at this override, and will continue so."""
    most = mover.box * override ** np.array([[1.0], [2.0], [3.0]])
    speed, change = (np.abs(rates) for rates in mover.axis_rates())
    return bool(
        (change <= most[1] * 1.001).all()
        and (speed + change**2 / (2 * most[2]) <= most[0] * 1.001).all()
    )
