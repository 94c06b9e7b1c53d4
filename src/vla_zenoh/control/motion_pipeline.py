"""From the goals on the timeline to commands: leash, smoothing, joints, braking, streaming."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from vla_zenoh.control.aggregate import PlanAggregator
from vla_zenoh.control.chunk_planner import ChunkPlanner
from vla_zenoh.control.commander_io import limit_events, make_event
from vla_zenoh.control.contact import Contact
from vla_zenoh.control.gripper_arbiter import GripperArbiter
from vla_zenoh.control.limits import (
    APPROACH,
    Slowdown,
    into_workspace,
    leash,
    slowest,
    workspace_corners,
)
from vla_zenoh.control.plan_timeline import Goal, GoalTimeline, Plan
from vla_zenoh.control.pose_to_joint import PoseToJoint
from vla_zenoh.control.reachability import ReachabilityFilter
from vla_zenoh.control.retreat import Retreat
from vla_zenoh.control.smoothing import FULL, Motion, Shares, Smoother, motion_limits
from vla_zenoh.control.states import OBEYING, State
from vla_zenoh.control.step_timing import StepTiming
from vla_zenoh.errors import ProfileError
from vla_zenoh.kinematics.so3 import (
    Pose,
    exp3,
    held_pose,
    log3,
    pose_distance,
    pose_of,
    quat_from_rotation,
)
from vla_zenoh.profile import Profile
from vla_zenoh.types import (
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

LINGER_NS = 500_000_000
"""The stream continues for this long after the arm stands, so that its last pose is not lost."""
SAME_WIDTH_M = 0.005
"""A gripper this near to the width sent last has reached it."""
HELD_M, HELD_RAD = 0.002, 0.01
"""A robot that holds a pose this near to the stream follows it: the stream continues."""
HELD_JOINT_RAD = 0.004
SETTLED, SETTLED_NS = 5e-4, 100_000_000
"""A robot that moves by less than this, in m and rad, for this long stands."""


class MotionCommands(NamedTuple):
    """Commands of one tick, each None where there is none."""

    pose: PoseCommand | None = None
    joint: JointCommand | None = None
    gripper: GripperCommand | None = None


class MotionPipeline:
    """Follows the goals of the timeline, or brakes, in a smooth command stream.

    Args:
        profile: limits, rate, and whether poses or joints are commanded.
        reach: see `Commander`.
        composer: bounds the goals that come due.

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
            self._joints = PoseToJoint(profile, reach.kinematics, reach.barriers)
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
        self.contact = Contact(profile.limits.contact)
        self.retreat = Retreat(profile.limits, self.contact)
        self._back: Pose | None = None
        self._slowed_by: set[str] = set()
        self._smoother: Smoother | None = None
        self._standing: tuple[Pose, FloatArray | None, int] | None = None
        self._measured_ns = 0
        self._timing: StepTiming | None = None
        self._cause: Cause | None = None
        self._rest_since_ns: int | None = None

    # -- state --------------------------------------------------------------------------------
    @property
    def at_rest(self) -> bool:
        """The commanded motion stands still."""
        still = self._joints is None or self._joints.at_rest
        return self._smoother is None or (self._smoother.at_rest and still)

    @property
    def commanded(self) -> Pose | None:
        """The pose streamed last, None while nothing is streamed."""
        return self._smoother.motion.pose if self._smoother and self.streaming else None

    @property
    def joints_rad(self) -> FloatArray | None:
        """(n,) joints commanded, None where poses are."""
        return None if self._joints is None else self._joints.position_rad

    @property
    def stuck(self) -> str:
        """Why commanded joints will not reach the pose, empty while they follow."""
        return "" if self._joints is None else self._joints.stuck

    @property
    def failures(self) -> int:
        """Times Ruckig found no trajectory and the arm braked instead."""
        return self._smoother.failures if self._smoother else 0

    # -- activation ---------------------------------------------------------------------------
    def anchor(
        self,
        measured: PoseState,
        gripper: GripperState,
        joint: JointState | None,
        now_ns: int,
        *,
        blocked: bool,
    ) -> None:
        """Start at the set-point of the robot's controller, so that nothing jumps.

        Args:
            measured: TCP pose, with the controller's set-point if the robot reports it.
            gripper: its width is kept.
            joint: newest joints.
            now_ns: time of this tick.
            blocked: the arm is far from its controller's set-point.
        """
        self._slowed_by.clear()
        self.joint_slowdown = None
        self.retreat.end()
        if self._reach is not None and joint is not None:
            self._reach.reset(self._reach.kinematics.joints_of(joint))
        actual, start = pose_of(measured), held_pose(measured)
        standing = not self.streaming or self.at_rest
        if self._smoother is None:
            # Commanded joints have distance constraints of their own.
            inside = workspace_corners(self._limits) if self._joints is None else None
            self._smoother = Smoother(start, self._dt_s, motion_limits(self._limits), inside)
            self._timing = StepTiming(self._smoother.box)
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
        width_m = self._width_to_keep(gripper)
        self.gripper.restart(width_m)
        # The goal of a blocked arm is where it is. Otherwise a brake continues, and the goal is
        # where it ends.
        goal = Goal(actual if blocked else self._resting_pose(self._smoother, actual), width_m)
        assert self._timing is not None
        self._timing.restart()
        if self.timeline is None:
            self.timeline = GoalTimeline(goal, now_ns)
        else:
            self.timeline.restart(goal, now_ns)
        self.goal = None if blocked else goal

    def _resting_pose(self, smoother: Smoother, actual: Pose) -> Pose:
        """Where a brake will end, inside the box or no further outside than the arm is."""
        rest, (low, high) = smoother.resting_pose(), workspace_corners(self._limits)
        least, most = np.minimum(low, actual.position_m), np.maximum(high, actual.position_m)
        return Pose(np.clip(rest.position_m, least, most), rest.rotation)

    def measure(self, measured: PoseState, joint: JointState | None, received_ns: int) -> None:
        """Track whether the robot still moves while the stream stands.

        A record that is repeated does not show that the robot stands.
        """
        if not self.streaming or not self.at_rest:
            self._standing = None
            return
        held = held_pose(measured)
        held_rad = None if self._joints is None or joint is None else self._held_joints(joint)
        if self._standing is None or max(_apart(held, held_rad, *self._standing[:2])) > SETTLED:
            self._standing = held, held_rad, received_ns
        self._measured_ns = received_ns

    def unsettled(self) -> list[str]:
        """Reasons against an activation now: the robot still moves to the end of the stream.

        A robot that has braked by itself stands elsewhere: a new stream begins there.
        """
        if self._standing is None or self._smoother is None:
            return []
        held, held_rad, since_ns = self._standing
        apart = _apart(held, held_rad, self._smoother.motion.pose, self.joints_rad)
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
        """The width sent last while the gripper obeys it: another one would end a grasp."""
        sent_m = self.gripper.sent_m
        if sent_m is not None and (
            abs(sent_m - gripper.width_m) < SAME_WIDTH_M
            or (gripper.holding and sent_m < gripper.width_m)
        ):
            return sent_m
        return min(max(gripper.width_m, 0.0), self._max_width_m)

    # -- one tick -----------------------------------------------------------------------------
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
        if self._smoother is None or self.timeline is None:
            return True, []
        self._set_override(task.speed, self.timeline, now_ns)
        if state is State.ACTIVE:
            self._cause = self.timeline.plan.cause
            events = self._follow(self._smoother, self.timeline, task, overdue_ns, now_ns, ticks)
        else:
            self._cause = None
            events = self._retreat_or_brake(self._smoother, self.timeline, state, now_ns)
        went_on, self.streaming = self.streaming, self._must_stream(state, now_ns)
        if not self.streaming:
            return True, events
        failures = self._smoother.failures
        # A stream that begins must begin at rest: no ticks are made up for.
        for _ in range(ticks if went_on else 1):
            if self._joints is None:
                self._smoother.tick()
            else:
                active = state is State.ACTIVE and self._override > 0.0
                braking = not active and self._back is None
                self._joints.tick(self._smoother, braking=braking, elbow=active)
        return self._smoother.failures == failures, events

    def commands(
        self, state: State, now_ns: int, gripper: Stamped[GripperState] | None
    ) -> MotionCommands:
        """The set-points of robot and gripper, while streaming."""
        if not self.streaming or self._smoother is None:
            return MotionCommands()
        pose = joint = width = None
        if self._joints is not None:
            joint = self._joints.command(state.value, self._cause)
        else:
            pose = self._pose_command(self._smoother.motion, state)
        if state is State.ACTIVE and self._override > 0.0:
            width = self.gripper.step(now_ns, gripper)
        return MotionCommands(pose, joint, width)

    def forget_plan(self, oldest_ns: int, now_ns: int) -> bool:
        """Stand where the arm is, if the plan's observation was taken before `oldest_ns`."""
        timeline, smoother = self.timeline, self._smoother
        if timeline is None or smoother is None:
            return False
        cause = timeline.plan.cause
        if cause is None or cause.observation_stamp_ns >= oldest_ns:
            return False
        self._hold(timeline, self._resting_pose(smoother, smoother.motion.pose), now_ns)
        return True

    def _hold(self, timeline: GoalTimeline, pose: Pose, now_ns: int) -> None:
        timeline.hold(Goal(pose, timeline.at(now_ns).width_m), now_ns)
        if self._timing is not None:
            self._timing.restart()

    def _set_override(self, override: float, timeline: GoalTimeline, now_ns: int) -> None:
        """Let plan time pass at the speed override, and replan the motion to the goal."""
        if override != self._override or override != timeline.clock.override:
            self._override = override
            timeline.clock.set(override, now_ns)
            self.goal, self._slowing = None, override > 0.0

    def _follow(
        self,
        smoother: Smoother,
        timeline: GoalTimeline,
        task: Task,
        overdue_ns: int,
        now_ns: int,
        ticks: int,
    ) -> list[Event]:
        plans = self._aggregator.plans(timeline, now_ns)
        events = limit_events(self._planner.bound_due(plans, now_ns))
        goal = self._aggregator.goal(plans, now_ns)
        if self._override == 0.0:
            self._pause(smoother)
            return events
        slowed = self._slowing and _within(smoother, self._override)
        # The leash starts at the pose of this tick: the arm may be moving away from the last one.
        pose, hits = leash(self._limits, goal.pose, _ahead(smoother.motion, ticks * self._dt_s))
        slower = slowest(goal.slowdown, self.contact_slowdown, self.joint_slowdown)
        slowed |= (slower.share if slower else 1.0) != self.speed
        if goal is not self.goal or hits or slowed:
            if hits:
                if goal is not self.goal:
                    name, value, limit = hits[0][:3]
                    events.append(make_event("warning", "limit", name, "leash", value, limit))
                goal = self._shorten(plans, goal, pose, now_ns)
            events += self._slow_down(slower)
            shares = self._shares(smoother, goal.pose, timeline.plan, task, overdue_ns, now_ns)
            hard = self._slowing and self._joints is None
            enough = smoother.target(goal.pose, shares, all_to_stop=hard)
            self._slowing &= not (enough and _within(smoother, self._override))
            self.goal = goal
            self.gripper.request(goal.width_m)
        return events

    def _pause(self, smoother: Smoother) -> None:
        """Stop on the path, to continue from there when the override allows it again."""
        if self._joints is None:
            smoother.brake(FULL)
        else:
            self._joints.brake(smoother)
        self.goal = None

    def _shares(
        self,
        smoother: Smoother,
        goal: Pose,
        plan: Plan,
        task: Task,
        overdue_ns: int,
        now_ns: int,
    ) -> Shares:
        """Shares of the limits that the arm has on the way to a goal."""
        override, speed = self._override, self.speed * self._override
        if not plan.soonest:
            assert self._timing is not None
            here, twist, _ = smoother.motion
            body = here.rotation.T
            way = np.concatenate([goal.position_m - here.position_m, log3(body @ goal.rotation)])
            velocity = np.concatenate([twist[:3], body @ twist[3:]])
            index, left_s = plan.index_at(now_ns), (overdue_ns - now_ns) / 1e9
            share = self._timing.share(
                plan, index, now_ns, 1.0 / task.rate_hz, left_s, way, velocity
            )
            speed = min(speed, share)
        # The same motion in more time: acceleration scales with the square of the override, jerk
        # with the cube. Until a faster arm has slowed down it brakes as hard as it may.
        slow = _within(smoother, override)
        most = Shares(1.0, override**2, override**3) if slow else FULL
        return self._within_joints(smoother, goal, Shares(speed, most.acceleration, most.jerk))

    def _within_joints(self, smoother: Smoother, goal: Pose, shares: Shares) -> Shares:
        """`shares`, reduced to what commanded joints can follow."""
        if self._joints is None:
            return shares
        joints = self._joints.shares(smoother.motion, goal, smoother.box)
        return Shares(*map(min, joints, shares))

    def _slow_down(self, slower: Slowdown | None) -> list[Event]:
        """Set the speed share; report each reason once per activation."""
        self.speed, self.slower = (1.0, None) if slower is None else (slower.share, slower)
        if slower is None or slower.name in (APPROACH, *self._slowed_by):
            return []
        self._slowed_by.add(slower.name)
        why = f"slower{slower.at}"
        return [make_event("info", "limit", slower.name, why, slower.value, slower.limit)]

    def _shorten(self, plans: Sequence[Plan], goal: Goal, pose: Pose, now_ns: int) -> Goal:
        """Shift all later goals by what the leash cut off, or the cut part would come back.

        A shifted goal lies between bounded goals.
        """
        cut = replace(goal, pose=pose, joints_rad=None)
        if len(plans) == 1:
            plans[0].shift_rest(plans[0].index_at(now_ns), cut, self._limits)
            return cut
        way_m = pose.position_m - goal.pose.position_m
        turn = goal.pose.rotation.T @ pose.rotation
        for plan in plans:
            plan.shift(plan.index_at(now_ns), way_m, turn, self._limits)
        return cut

    def _retreat_or_brake(
        self, smoother: Smoother, timeline: GoalTimeline, state: State, now_ns: int
    ) -> list[Event]:
        if state is not State.INACTIVE:
            self.retreat.end()
        back, event = self.retreat.step(smoother.motion.pose, now_ns, at_rest=self.at_rest)
        if back is None:
            self._brake(smoother, timeline, now_ns)
        elif back is not self._back:
            # Whatever the speed override: an arm in contact has to come free.
            inside_m, _ = into_workspace(
                self._limits, back.position_m, smoother.motion.pose.position_m
            )
            inside = Pose(inside_m, back.rotation)
            smoother.target(
                inside, self._within_joints(smoother, inside, Shares(self.retreat.speed))
            )
        self._back = back
        return [] if event is None else [event]

    def _brake(self, smoother: Smoother, timeline: GoalTimeline, now_ns: int) -> None:
        """Stop, and move the goal to where the arm stops, so that nothing pulls it further."""
        if self._joints is None:
            smoother.brake()
        else:
            self._joints.brake(smoother)
        self.goal = None
        if timeline.plan.cause is not None and smoother.at_rest:
            self._hold(timeline, smoother.motion.pose, now_ns)

    def _must_stream(self, state: State, now_ns: int) -> bool:
        if state in OBEYING or self.retreat.busy or not self.at_rest:
            self._rest_since_ns = None
            return state in OBEYING or self.streaming
        if self._rest_since_ns is None:
            self._rest_since_ns = now_ns
        return self.streaming and now_ns - self._rest_since_ns < LINGER_NS

    def _pose_command(self, motion: Motion, state: State) -> PoseCommand:
        goal = self.goal.pose if self.goal else motion.pose
        return PoseCommand(
            motion.pose.position_m,
            quat_from_rotation(motion.pose.rotation),
            motion.twist,
            motion.acceleration,
            goal.position_m,
            quat_from_rotation(goal.rotation),
            state.value,
            self._cause,
        )


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
    return Pose(position_m + way[:3], exp3(way[3:]) @ rotation)


def _within(smoother: Smoother, override: float) -> bool:
    """Whether the arm moves as slowly as it would at this override, and will continue so."""
    most = smoother.box * override ** np.array([[1.0], [2.0], [3.0]])
    (_, rotation), *motion = smoother.motion
    # The limits of rotation apply to axes that turn with the arm.
    speed, change = (np.abs(np.append(part[:3], rotation.T @ part[3:])) for part in motion)
    return bool(
        (change <= most[1] * 1.001).all()
        and (speed + change**2 / (2 * most[2]) <= most[0] * 1.001).all()
    )
