"""From the goals on the timeline to commands: leash, smoothing, joints, braking, streaming."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from vla_zenoh.control.chunk_planner import LOOK_AHEAD_NS, ChunkPlanner
from vla_zenoh.control.commander_io import limit_events, make_event
from vla_zenoh.control.contact import Contact, Retreat
from vla_zenoh.control.joint_space import JointPath
from vla_zenoh.control.limits import BEGIN_JOINT, LimitHit, Shares, into_workspace
from vla_zenoh.control.plan_timeline import (
    Goal,
    GoalTimeline,
    JointGoal,
    Plan,
    PlanAggregator,
    joint_goal,
)
from vla_zenoh.control.pose_to_joint import FollowedPath, PoseToJoint
from vla_zenoh.control.preflight import LINGER_NS, Settling, follows, held_joints
from vla_zenoh.control.reachability import ReachabilityFilter
from vla_zenoh.control.smoothing import PosePath
from vla_zenoh.control.states import OBEYING, MotionMode, State
from vla_zenoh.control.step_timing import Mover, SpeedScaling, TimedGoal
from vla_zenoh.errors import ProfileError
from vla_zenoh.kinematics.so3 import Pose, held_pose, interpolate, pose_distance, pose_of
from vla_zenoh.profile import Profile
from vla_zenoh.types import (
    Event,
    FloatArray,
    JointCommand,
    JointState,
    PoseCommand,
    PoseState,
    Task,
)

PIECE_M, PIECE_RAD, PIECE_S = 0.02, 0.1, 0.5
"""A way that is no step of a plan is bounded in pieces of this length, each in this time."""
TRIES = 3
"""Ticks in a row without a trajectory, after which it is a fault; the arm brakes meanwhile."""
DROPPED = 1e-5
"""m and rad: less of a chunk that is not executed is rounding."""


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
        self._reach, self._planner = reach, planner
        self._aggregator = PlanAggregator(profile.composition)
        self._joints: PoseToJoint | None = None
        self._path: JointPath | None = None
        """Of commanded joints. Commanded poses follow the TCP of goals that are joints."""
        self._poses = PosePath(profile)
        if profile.robot.command == "joint":
            if reach is None or planner.joint_bounds is None:
                raise ProfileError("robot.command is joint, which needs the robot's kinematics")
            self._joints = PoseToJoint(profile, reach.kinematics, reach.barriers)
            self._path = JointPath(profile, planner.joint_bounds)
            self._poses = FollowedPath(profile, self._joints)
        self._mover: Mover = self._poses
        """What moves the arm: `_poses` or `_path`."""
        self.mode = MotionMode.BRAKE
        """Of the last tick."""
        self.timeline: GoalTimeline | None = None
        self.goal: Goal | None = None
        self.streaming = False
        self.scaling = SpeedScaling()
        self.must_pause = False
        """Another part is too near: the arm has to pause."""
        simulated = profile.robot.driver == "sim"
        self.contact = Contact(profile.limits.contact, simulated=simulated)
        self.retreat = Retreat(profile.limits, self.contact)
        self._back: Pose | None = None
        """Where it retreats to."""
        commanded = None if self._joints is None or reach is None else reach.kinematics
        self._settling = Settling(commanded)
        self._rest_since_ns: int | None = None
        self._tries = 0
        self._looks_ahead = True
        """Steps after the one that is due were bounded in the last tick."""

    # -- state --------------------------------------------------------------------------------
    @property
    def moves_in_joints(self) -> bool:
        """The arm moves in joints."""
        return isinstance(self._mover, JointPath)

    @property
    def joints_asked(self) -> bool:
        """The goals in force are joints, whichever way the arm moves to them."""
        return self.timeline is not None and isinstance(self.timeline.plan.goals[0], JointGoal)

    @property
    def at_rest(self) -> bool:
        """The commanded motion stands still."""
        return self._mover.stands

    @property
    def arrived(self) -> bool:
        """The motion to the goal is over; an elbow may still be on its way to its posture."""
        return self._mover.at_rest

    @property
    def commanded(self) -> Pose | None:
        """The pose streamed last, None while nothing is streamed."""
        return self._mover.motion.pose if self.streaming else None

    @property
    def joints_rad(self) -> FloatArray | None:
        """(n,) joints commanded, None where poses are."""
        return self._mover.joints_rad

    @property
    def strays_m(self) -> float:
        """How far beside these places, in the motion in progress, the arm may come to rest."""
        return self._mover.strays_m

    def stopping_rad(self, ahead_s: float) -> list[FloatArray]:
        """(n,) each, commanded joints on the way to rest and at rest, from a brake in `ahead_s`."""
        return self._mover.stopping_rad(ahead_s)

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
        return self._mover.stuck

    @property
    def failures(self) -> int:
        """Times Ruckig found no trajectory and the arm braked instead."""
        return self._poses.failures + (0 if self._path is None else self._path.failures)

    # -- activation ---------------------------------------------------------------------------
    def anchor(
        self,
        measured: PoseState,
        width_m: float,
        joint: JointState | None,
        now_ns: int,
        *,
        blocked: bool,
        joints_asked: bool = False,
    ) -> list[Event]:
        """Start at the set-point of the robot's controller, so that nothing jumps.

        Args:
            measured: TCP pose, with the controller's set-point if the robot reports it.
            width_m: of the gripper, which is kept.
            joint: newest joints.
            now_ns: time of this tick.
            blocked: the arm is far from its controller's set-point.
            joints_asked: the actions are joints.

        Returns:
            what is dropped of a chunk, while the brake of the last activation continues.
        """
        self.scaling.begin()
        self.retreat.end()
        measured_rad: FloatArray | None = None
        if self._reach is not None and joint is not None:
            measured_rad = self._reach.kinematics.joints_of(joint)
            self._reach.reset(measured_rad)
        actual, start = pose_of(measured), held_pose(measured)
        standing = not self.streaming or self.at_rest
        if standing:
            self._enter(joints=False)
        if standing and not (
            self.streaming and follows(*pose_distance(self._poses.motion.pose, start))
        ):
            self._poses.reset(start)
        if self._joints is not None and self._reach is not None and joint is not None:
            held_rad = held_joints(self._reach.kinematics, joint)
            apart_rad = np.abs(held_rad - self._joints.position_rad)
            near = (apart_rad <= BEGIN_JOINT.of(self._reach.kinematics.slides)).all()
            if standing and not (self.streaming and near):
                self._joints.restart(held_rad)
            self._joints.keep_elbow()
        if joints_asked and standing:
            self._enter(joints=True)
        # The goal of a blocked arm is where it is. Otherwise a brake continues, and the goal is
        # where it ends.
        goal = self._mover.resting_goal(actual, width_m)
        if blocked and not isinstance(goal, JointGoal):
            goal = Goal(self._within_reach(self._mover.motion.pose, actual)[0], width_m)
        elif blocked and self._path is not None and measured_rad is not None:
            goal = joint_goal(self._path.kinematics, measured_rad, width_m)
        self.scaling.stand()
        self.goal = None if blocked else goal
        if self.timeline is None:
            self.timeline = GoalTimeline(goal, now_ns)
            return []
        plan = self.timeline.plan
        self.timeline.restart(goal, now_ns)
        return _dropped(plan, goal)

    def _enter(self, *, joints: bool) -> None:
        """Act in joints or in poses from now on; only while the arm stands."""
        path, poses, follower = self._path, self._poses, self._joints
        if joints is self.moves_in_joints or path is None or follower is None:
            return
        self.goal = None
        if joints:
            path.stand(follower.position_rad)
        else:
            poses.reset(path.motion.pose)
            follower.restart(path.state.position)
        self._mover = path if joints else poses
        self.scaling.stand()

    def measure(self, measured: PoseState, joint: JointState | None, received_ns: int) -> None:
        """Track whether the robot still moves while the stream stands."""
        if self.streaming and self.at_rest:
            self._settling.measure(measured, joint, received_ns)
        else:
            self._settling.restart()

    def unsettled(self) -> list[str]:
        """Reasons against an activation now: the robot still moves to the end of the stream."""
        return self._settling.unsettled(self._mover.motion.pose, self.joints_rad)

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
            whether a trajectory was found (if not, the arm brakes) in one of the last `TRIES`
            ticks, and events.
        """
        if self.timeline is None:
            return True, []
        if task.speed != self.scaling.override or task.speed != self.timeline.clock.override:
            # Plan time passes at the override, and the motion to the goal is planned again.
            self.scaling.override, self.scaling.slowing = task.speed, task.speed > 0.0
            self.timeline.clock.set(task.speed, now_ns)
            self.goal = None
        failures = self.failures
        if state is State.ACTIVE:
            events = self._follow(self.timeline, task, overdue_ns, now_ns, ticks)
        else:
            events = self._retreat_or_brake(self._mover, self.timeline, state, now_ns)
        went_on, self.streaming = self.streaming, self._must_stream(state, now_ns)
        if not self.streaming:
            return True, events
        mover = self._mover  # which may be another by now
        # A stream that begins must begin at rest: no ticks are made up for.
        for _ in range(ticks if went_on else 1):
            mover.step(self.mode)
        events += limit_events(mover.taken_hits())
        if self.failures == failures:
            self._tries = 0
            return True, events
        self._tries += 1
        self.goal = None  # the next tick tries again, from the brake
        events.append(make_event("warning", "notice", "no_trajectory", mover.failure))
        return state is State.ACTIVE and self._tries < TRIES, events

    def command(self, state: State) -> PoseCommand | JointCommand | None:
        """The set-point of the robot, while streaming."""
        if not self.streaming:
            return None
        plan = None if self.timeline is None else self.timeline.plan
        cause = plan.cause if plan is not None and state is State.ACTIVE else None
        return self._mover.command(state.value, cause, self.goal)

    def forget_plan(self, oldest_ns: int, now_ns: int) -> list[Event] | None:
        """Stand where the arm is, if the plan's observation was taken before `oldest_ns`.

        Returns what of the plan is dropped; None: it is kept.
        """
        timeline, mover = self.timeline, self._mover
        if timeline is None:
            return None
        cause = timeline.plan.cause
        if cause is None or cause.observation_stamp_ns >= oldest_ns:
            return None
        return self._hold(mover, timeline, now_ns)

    def _hold(self, mover: Mover, timeline: GoalTimeline, now_ns: int) -> list[Event]:
        """Stand where the motion ends, and report what is dropped of the plan in force."""
        plan = timeline.plan
        # As the gripper was told: half way to it a gripper that shuts would let go.
        rest = mover.resting_goal(mover.tcp.pose, plan.goals[plan.index_at(now_ns)].width_m)
        timeline.hold(rest, now_ns)
        self.scaling.stand()
        return _dropped(plan, rest)

    def _follow(
        self, timeline: GoalTimeline, task: Task, overdue_ns: int, now_ns: int, ticks: int
    ) -> list[Event]:
        plans = self._aggregator.plans(timeline, now_ns)
        found = self._planner.bound_due(plans, now_ns)
        events = limit_events(found) if found else []
        goal = self._aggregator.goal(plans, now_ns)
        joints = isinstance(goal, JointGoal) and self._path is not None
        if joints is not self.moves_in_joints and self.at_rest:
            self._enter(joints=joints)
        self._back = None
        if joints is not self.moves_in_joints:
            self.mode = MotionMode.CHANGE
        elif self.must_pause or self.scaling.override == 0.0:
            self.mode = MotionMode.PAUSE
        else:
            self.mode = MotionMode.FOLLOW
        mover = self._mover
        if self.must_pause and self.mode is MotionMode.PAUSE:
            near = mover.near(goal)  # so that the arm can retreat
            if near is not goal:
                self._shorten(plans, goal, near, now_ns)
        if self.mode is not MotionMode.FOLLOW:
            mover.pause()
            self.goal = None
            return events
        # The leash starts where the arm is in this tick: it may be moving away from the last goal.
        short, hits = mover.leash(goal, ticks * self._dt_s)
        slower = self.scaling.slowest(goal)
        plans_motion = goal is not self.goal or bool(hits) or self.scaling.changes(mover, slower)
        if plans_motion:
            if hits:
                if goal is not self.goal:
                    name, value, limit = hits[0][:3]
                    events.append(make_event("warning", "limit", name, "leash", value, limit))
                goal = self._shorten(plans, goal, short, now_ns)
            timed = TimedGoal(goal, timeline.plan, task.rate_hz, overdue_ns, now_ns)
            events += self.scaling.go_to(mover, timed, slower)
            self.goal = goal
        # Later steps can wait for a tick that plans no motion, which takes as long as they do.
        self._looks_ahead = not (plans_motion and self._looks_ahead)
        if self._looks_ahead:
            events += limit_events(self._planner.bound_due(plans, now_ns, LOOK_AHEAD_NS))
        return events

    def _shorten(self, plans: Sequence[Plan], goal: Goal, cut: Goal, now_ns: int) -> Goal:
        """Shift all later goals by what the leash cut off, or the cut part would come back.

        A shifted goal lies between bounded goals.
        """
        if isinstance(goal, JointGoal) and not isinstance(cut, JointGoal):
            assert self._reach is not None
            joints_rad = self._reach.joints_near(cut.pose, goal.joints_rad)
            cut = joint_goal(goal.arm, joints_rad, cut.width_m, cut.slowdown)
        if len(plans) == 1:
            plans[0].shift_rest(plans[0].index_at(now_ns), cut, self._limits)
            return cut
        for plan in plans:
            plan.shift(plan.index_at(now_ns), goal, cut, self._limits)
        return cut

    def _retreat_or_brake(
        self, mover: Mover, timeline: GoalTimeline, state: State, now_ns: int
    ) -> list[Event]:
        if state is not State.INACTIVE or self.must_pause:
            self.retreat.end()
        back, event = self.retreat.step(mover.motion.pose, now_ns, at_rest=self.at_rest)
        if back is not None and isinstance(mover, JointPath):
            self._enter(joints=False)
            mover = self._poses
        dropped: list[Event] = []
        self.mode = MotionMode.BRAKE if back is None else MotionMode.RETREAT
        if back is None:
            mover.stop()
            self.goal = None
            if timeline.plan.cause is not None and mover.at_rest:
                # So that nothing pulls the arm further.
                dropped = self._hold(mover, timeline, now_ns)
        elif back is not self._back:
            # Whatever the speed override: an arm in contact has to come free.
            here_m = mover.tcp.pose.position_m
            inside_m, _ = into_workspace(self._limits, back.position_m, here_m)
            inside_pose, hits = self._within_reach(mover.motion.pose, Pose(inside_m, back.rotation))
            inside = Goal(inside_pose, 0.0)
            dropped = limit_events(hits)
            shares = map(min, mover.shares(inside), Shares(self.retreat.speed))
            mover.go_to(inside, Shares(*shares))
        self._back = back
        return dropped if event is None else [*dropped, event]

    def _within_reach(self, start: Pose, end: Pose) -> tuple[Pose, list[LimitHit]]:
        """The part of a straight way that no barrier cuts off, and the limits that cut it.

        For motion that is no step of a plan; it is bounded in pieces, as steps are.
        """
        if self._reach is None:
            return end, []
        apart_m, apart_rad = pose_distance(start, end)
        pieces = math.ceil(max(apart_m / PIECE_M, apart_rad / PIECE_RAD, 1.0))
        here = start
        for piece in range(1, pieces + 1):
            there = end if piece == pieces else interpolate(start, end, piece / pieces)
            bounded = self._reach.bound(here, there, PIECE_S)
            here = bounded.pose
            if bounded.hits:
                return here, bounded.hits
        return here, []

    def _must_stream(self, state: State, now_ns: int) -> bool:
        if state in OBEYING or self.retreat.busy or not self.at_rest:
            self._rest_since_ns = None
            return state in OBEYING or self.streaming
        if self._rest_since_ns is None:
            self._rest_since_ns = now_ns
        # A clock that was set back ends it, too.
        return self.streaming and 0 <= now_ns - self._rest_since_ns < LINGER_NS


def _dropped(plan: Plan, rest: Goal) -> list[Event]:
    """The part of a chunk's plan that is left when the arm comes to rest, as an event."""
    if plan.cause is None:
        return []
    last, left = plan.goals[plan.bounded - 1], len(plan.goals) - plan.bounded
    apart_m, apart_rad = pose_distance(last.pose, rest.pose)
    if max(apart_m, apart_rad) <= DROPPED and not left:
        return []
    more = f", and {left} steps after that" if left else ""
    why = f"{apart_m:.5f} m and {apart_rad:.5f} rad of a chunk were not executed{more}"
    return [make_event("warning", "notice", "dropped", why, apart_m, DROPPED)]
