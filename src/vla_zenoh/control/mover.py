"""From goals on a time axis to commands: leash, smoothing, joints, braking, and when to stream."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from vla_zenoh.control.aggregate import Aggregator
from vla_zenoh.control.compose import Goal, GoalTimeline, Plan
from vla_zenoh.control.composer import Composer
from vla_zenoh.control.contact import Contact
from vla_zenoh.control.gripper import GripperArbiter
from vla_zenoh.control.joint_stage import JointStage
from vla_zenoh.control.limits import into_workspace, leash, workspace_corners
from vla_zenoh.control.ports import Outputs
from vla_zenoh.control.reach import Shadow
from vla_zenoh.control.retreat import Retreat
from vla_zenoh.control.slowdown import APPROACH, Slowdown, slowest
from vla_zenoh.control.smoothing import FULL, Motion, Shares, Smoother, motion_limits
from vla_zenoh.control.so3 import Pose, distance, exp3, held_pose, log3, pose_of, quat_from_rotation
from vla_zenoh.control.states import OBEYING, State
from vla_zenoh.control.step_timing import StepTiming
from vla_zenoh.errors import ProfileError
from vla_zenoh.profile import Profile
from vla_zenoh.types import (
    Cause,
    FloatArray,
    GripperState,
    JointState,
    PoseCommand,
    PoseState,
    Stamped,
    Task,
)

LINGER_NS = 500_000_000
"""The stream goes on for this long after the arm stands, so that its last pose is not lost."""
SAME_WIDTH_M = 0.005
"""A gripper this near to the width last sent has reached it."""
HELD_M, HELD_RAD = 0.002, 0.01
"""A robot that holds a pose this near to what is streamed to it obeys: no stream begins."""
HELD_JOINT_RAD = 0.004
SETTLED, SETTLED_NS = 5e-4, 100_000_000
"""One that moves by less, in m and rad, for so long stands."""


class Mover:
    """See the module.

    Args:
        profile: limits, rate, and whether poses or joints are commanded.
        reach: see `Commander`.
        composer: bounds the goals that come due.

    Raises:
        ProfileError: joints are to be commanded and there are no kinematics.
    """

    def __init__(self, profile: Profile, reach: Shadow | None, composer: Composer) -> None:
        self._limits = profile.limits
        self._dt_s = 1.0 / profile.timing.command_hz
        self._max_width_m = profile.robot.gripper.max_width_m
        self._reach, self._composer = reach, composer
        self._aggregator = Aggregator(profile.composition)
        self._joints: JointStage | None = None
        if profile.robot.command == "joint":
            if reach is None:
                raise ProfileError("robot.command is joint, which needs the robot's kinematics")
            self._joints = JointStage(profile, reach.kinematics, reach.barriers)
        self.gripper = GripperArbiter(profile.robot.gripper)
        self.timeline: GoalTimeline | None = None
        self.goal: Goal | None = None
        self.streaming = False
        self.speed = 1.0
        """Share of the speed limits that the arm has to its goal, the override aside."""
        self._override, self._slowing = 1.0, False
        self._held_back: Slowdown | None = None
        self.pressed: Slowdown | None = None
        """What presses against the arm, and makes it slower wherever it goes."""
        self.contact = Contact(profile.limits.contact)
        self.retreat = Retreat(profile.limits, self.contact)
        self._back: Pose | None = None
        self._slowed_by: set[str] = set()
        self._smoother: Smoother | None = None
        self._stands: tuple[Pose, int] | None = None
        self._timing: StepTiming | None = None
        self._cause: Cause | None = None
        self._rest_since_ns: int | None = None

    # -- where it is --------------------------------------------------------------------------
    @property
    def at_rest(self) -> bool:
        """What is commanded stands still."""
        still = self._joints is None or self._joints.at_rest
        return self._smoother is None or (self._smoother.at_rest and still)

    @property
    def commanded(self) -> Pose | None:
        """The pose last streamed, None while nothing is."""
        return self._smoother.motion.pose if self._smoother and self.streaming else None

    @property
    def joints_rad(self) -> FloatArray | None:
        """(n,) joints commanded, None where poses are."""
        return None if self._joints is None else self._joints.position_rad

    def hold_back(self, slower: Slowdown | None) -> None:
        """Go no faster than this from now on, whatever the goal allows; None: as it allows."""
        self._held_back = slower

    @property
    def stuck(self) -> str:
        """Why joints that are commanded will not come to the pose, empty while they follow."""
        return "" if self._joints is None else self._joints.stuck

    @property
    def failures(self) -> int:
        """Times Ruckig found no way and the arm was braked instead."""
        return self._smoother.failures if self._smoother else 0

    # -- beginning ----------------------------------------------------------------------------
    def anchor(
        self,
        measured: PoseState,
        gripper: GripperState,
        joint: JointState | None,
        now_ns: int,
        *,
        blocked: bool,
    ) -> None:
        """Begin where the robot's own controller stands, so that nothing jumps.

        Args:
            measured: TCP pose, with the controller's reference where the robot tells it.
            gripper: what it holds, it keeps.
            joint: newest joints.
            now_ns: time of this tick.
            blocked: the arm is far from its controller's reference.
        """
        self._slowed_by.clear()
        self._held_back = None
        self.retreat.end()
        if self._reach is not None and joint is not None:
            self._reach.reset(self._reach.kinematics.joints_of(joint))
        actual, start = pose_of(measured), held_pose(measured)
        standing = not self.streaming or self.at_rest
        if self._smoother is None:
            # Joints that are commanded have walls of their own.
            inside = workspace_corners(self._limits) if self._joints is None else None
            self._smoother = Smoother(start, self._dt_s, motion_limits(self._limits), inside)
            self._timing = StepTiming(self._smoother.box)
        elif standing and not (
            self.streaming and self._near(*distance(self._smoother.motion.pose, start))
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
        # A blocked arm's controller is led back to where the arm is. Otherwise a brake under way
        # goes on to its end, and the goal is where it ends.
        goal = Goal(actual if blocked else self._smoother.resting_pose(), width_m)
        assert self._timing is not None
        self._timing.restart()
        if self.timeline is None:
            self.timeline = GoalTimeline(goal, now_ns)
        else:
            self.timeline.restart(goal, now_ns)
        self.goal = None if blocked else goal

    def look_at(self, measured: PoseState, now_ns: int) -> None:
        """See whether the robot still moves where the stream stands already."""
        if not self.streaming or not self.at_rest:
            self._stands = None
            return
        held = held_pose(measured)
        if self._stands is None or max(distance(held, self._stands[0])) > SETTLED:
            self._stands = held, now_ns

    def unsettled(self, now_ns: int) -> list[str]:
        """Why no activation may begin yet: the robot is on its way to where the stream ended.

        A robot that braked by itself stands elsewhere: a new stream begins there.
        """
        if self._stands is None or self._smoother is None:
            return []
        held, since_ns = self._stands
        apart_m, apart_rad = distance(self._smoother.motion.pose, held)
        if self._near(apart_m, apart_rad) or now_ns - since_ns > SETTLED_NS:
            return []
        return [
            f"the robot is still {apart_m:.3f} m and {apart_rad:.3f} rad from where it was sent "
            f"last; activate again in {LINGER_NS / 1e9:g} s"
        ]

    @staticmethod
    def _near(apart_m: float, apart_rad: float) -> bool:
        """The robot holds what is streamed to it: to begin anew would be a step in the stream."""
        return apart_m <= HELD_M and apart_rad <= HELD_RAD

    def _held_joints(self, joint: JointState) -> FloatArray:
        """Joints the robot's controller holds, or where they are."""
        assert self._reach is not None
        kinematics = self._reach.kinematics
        if joint.reference_rad is not None:
            return kinematics.ordered(joint.names, joint.reference_rad)
        return kinematics.joints_of(joint)

    def _width_to_keep(self, gripper: GripperState) -> float:
        """The width last sent while the gripper obeys it, because a grip ends with another."""
        sent_m = self.gripper.sent_m
        if sent_m is not None and (
            abs(sent_m - gripper.width_m) < SAME_WIDTH_M
            or (gripper.holding and sent_m < gripper.width_m)
        ):
            return sent_m
        return min(max(gripper.width_m, 0.0), self._max_width_m)

    # -- one tick -----------------------------------------------------------------------------
    def advance(
        self, state: State, task: Task, overdue_ns: int, now_ns: int, ticks: int, out: Outputs
    ) -> bool:
        """Move on by `ticks` periods: after the goal in force where active, else braking.

        Args:
            state: of the command node.
            task: its rate and speed override.
            overdue_ns: when the watchdog brakes unless a chunk comes.
            now_ns: time of this tick.
            ticks: see `Commander.step`.
            out: what happened.

        Returns:
            whether a trajectory could be computed; where not, the arm brakes.
        """
        if self._smoother is None or self.timeline is None:
            return True
        self._cause = None
        self._take_override(task.speed, self.timeline, now_ns)
        if state is State.ACTIVE:
            self._cause = self._follow(
                self._smoother, self.timeline, task, overdue_ns, now_ns, ticks, out
            )
        else:
            self._retreat_or_brake(self._smoother, self.timeline, state, now_ns, out)
        went_on, self.streaming = self.streaming, self._must_stream(state, now_ns)
        if not self.streaming:
            return True
        failures = self._smoother.failures
        # A stream that begins has nothing to make up for: the robot takes one that begins at rest.
        for _ in range(ticks if went_on else 1):
            if self._joints is None:
                self._smoother.tick()
            else:
                active = state is State.ACTIVE and self._override > 0.0
                braking = not active and self._back is None
                self._joints.tick(self._smoother, braking=braking, elbow=active)
        return self._smoother.failures == failures

    def command(
        self, state: State, now_ns: int, gripper: Stamped[GripperState] | None, out: Outputs
    ) -> None:
        """Say where robot and gripper have to be now, while streaming."""
        if not self.streaming or self._smoother is None:
            return
        if self._joints is not None:
            out.joint = self._joints.command(state.value, self._cause)
        else:
            out.pose = self._pose_command(self._smoother.motion, state)
        if state is State.ACTIVE:
            out.gripper = self.gripper.step(now_ns, gripper)

    def _take_override(self, override: float, timeline: GoalTimeline, now_ns: int) -> None:
        """Let plan time pass at the speed override, and plan the way to the goal anew."""
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
        out: Outputs,
    ) -> Cause | None:
        plans = self._aggregator.plans(timeline, now_ns)
        out.shortened(self._composer.bound_until(plans, now_ns))
        goal = self._aggregator.goal(plans, now_ns)
        if self._override == 0.0:
            self._stand(smoother)
            return timeline.plan.cause
        slowed = smoother.slowed_down or (self._slowing and _within(smoother, self._override))
        # Of where the arm will be with this tick: it may be on its way from there.
        pose, hits = leash(self._limits, goal.pose, _ahead(smoother.motion, ticks * self._dt_s))
        slower = slowest(goal.slowdown, self.pressed, self._held_back)
        slowed |= (slower.share if slower else 1.0) != self.speed
        if goal is not self.goal or hits or slowed:
            if hits:
                cut = self._shorten(plans, goal, pose, now_ns)
                if goal is not self.goal:
                    out.tell(
                        "warning", "limit", hits[0].name, "leash", hits[0].value, hits[0].limit
                    )
                goal = cut
            self._slow_down(slower, out)
            shares = self._shares(smoother, goal.pose, timeline.plan, task, overdue_ns, now_ns)
            hard = self._slowing and self._joints is None
            enough = smoother.target(goal.pose, shares, all_to_stop=hard)
            self._slowing &= not (enough and _within(smoother, self._override))
            self.goal = goal
            self.gripper.want(goal.width_m)
        return timeline.plan.cause

    def _stand(self, smoother: Smoother) -> None:
        """Stop on the way, to go on from there when the override allows it again."""
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
        """Parts of its limits that the arm has on the way to a goal."""
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
        # The same motion in more time: its acceleration shrinks with the square of the override,
        # its jerk with the cube. Until a faster arm has slowed down it brakes as hard as it may.
        slow = _within(smoother, override)
        most = Shares(1.0, override**2, override**3) if slow else FULL
        return self._of_joints(smoother, goal, Shares(speed, most.acceleration, most.jerk))

    def _of_joints(self, smoother: Smoother, goal: Pose, shares: Shares) -> Shares:
        """No more than the joints can follow, where they are commanded."""
        if self._joints is None:
            return shares
        joints = self._joints.shares(smoother.motion, goal, smoother.box)
        return Shares(*map(min, joints, shares))

    def _slow_down(self, slower: Slowdown | None, out: Outputs) -> None:
        """Take over the speed of a goal; tell each reason once in every activation."""
        if slower is not None and slower.name not in (APPROACH, *self._slowed_by):
            self._slowed_by.add(slower.name)
            where = f" at {slower.where}" if slower.where else ""
            out.tell("info", "limit", slower.name, f"slower{where}", slower.value, slower.limit)
        self.speed = 1.0 if slower is None else slower.share

    def _shorten(self, plans: Sequence[Plan], goal: Goal, pose: Pose, now_ns: int) -> Goal:
        """Move all that is ahead by what the leash cut off, or the cut way would come back.

        What is moved lies between goals that were bounded.
        """
        cut = Goal(pose, goal.width_m, slowdown=goal.slowdown)
        if len(plans) == 1:
            plans[0].shift_rest(plans[0].index_at(now_ns), cut, self._limits)
            return cut
        way_m = pose.position_m - goal.pose.position_m
        turn = goal.pose.rotation.T @ pose.rotation
        for plan in plans:
            plan.shift(plan.index_at(now_ns), way_m, turn, self._limits)
        return cut

    def _retreat_or_brake(
        self, smoother: Smoother, timeline: GoalTimeline, state: State, now_ns: int, out: Outputs
    ) -> None:
        if state is not State.INACTIVE:
            self.retreat.end()
        back = self.retreat.turn(smoother.motion.pose, now_ns, out, at_rest=self.at_rest)
        if back is None:
            self._brake(smoother, timeline, now_ns)
        elif back is not self._back:
            # Whatever the speed override: an arm that presses has to come free.
            inside_m, _ = into_workspace(
                self._limits, back.position_m, smoother.motion.pose.position_m
            )
            inside = Pose(inside_m, back.rotation)
            smoother.target(inside, self._of_joints(smoother, inside, Shares(self.retreat.speed)))
        self._back = back

    def _brake(self, smoother: Smoother, timeline: GoalTimeline, now_ns: int) -> None:
        """Stop, and let the goal be where the arm stops, so that nothing pulls it further."""
        if self._joints is None:
            smoother.brake()
        else:
            self._joints.brake(smoother)
        self.goal = None
        if timeline.plan.cause is not None and smoother.at_rest:
            timeline.hold(Goal(smoother.motion.pose, timeline.at(now_ns).width_m), now_ns)
            if self._timing is not None:
                self._timing.restart()

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


def _ahead(motion: Motion, dt_s: float) -> Pose:
    """Where a motion will be in a moment."""
    (position_m, rotation), twist, acceleration = motion
    way = dt_s * (twist + 0.5 * dt_s * acceleration)
    return Pose(position_m + way[:3], exp3(way[3:]) @ rotation)


def _within(smoother: Smoother, override: float) -> bool:
    """Whether the arm moves as slowly as it would at this override, and will go on so."""
    most = smoother.box * override ** np.array([[1.0], [2.0], [3.0]])
    (_, rotation), *motion = smoother.motion
    # The limits of rotation are those of the axes that turn with the arm.
    speed, change = (np.abs(np.append(part[:3], rotation.T @ part[3:])) for part in motion)
    return bool(
        (change <= most[1]).all() and (speed + change**2 / (2 * most[2]) <= most[0] * 1.001).all()
    )
