"""Actions in joint space: steps of the joints within their bounds, and the smoothed motion.

A step is bounded on the joints that it asks for: ends of the joints' ranges and faces of the
workspace box stop the motion across them and leave that along them; near the arm itself or the
table a step is shortened as in `vla_zenoh.control.reachability`. A singularity does not matter.

The TCP of a straight motion of the joints goes along a curve. So the box is checked in between too,
and the velocity and acceleration of the TCP are bounded by their shares of the joints' limits. A
robot that takes poses goes to the poses of the joints instead, see `MotionPipeline`.
"""

from __future__ import annotations

import math
from collections.abc import Generator, Iterable
from copy import copy

import numpy as np

from vla_zenoh.control.actions import step_joints
from vla_zenoh.control.axis_smoothing import AxisSmoother
from vla_zenoh.control.limits import (
    FULL,
    LEAST_TO_GOAL,
    PAUSE_LEAD_M,
    PAUSE_LEAD_RAD,
    BoundedStep,
    LimitHit,
    Shares,
    chain_motion_limits,
    into_workspace,
    joint_margins,
    motion_limits,
    stop_way,
    workspace_corners,
)
from vla_zenoh.control.plan_timeline import Goal, joint_goal
from vla_zenoh.control.policy_check import ROUNDING, Rejection
from vla_zenoh.control.reachability import Barriers, Floors
from vla_zenoh.control.smoothing import Motion
from vla_zenoh.control.states import MotionMode
from vla_zenoh.kinematics.kinematics import Kinematics
from vla_zenoh.kinematics.so3 import Pose, norm3
from vla_zenoh.policy import ActionSpec
from vla_zenoh.profile import REJECT_FACTOR, Profile
from vla_zenoh.types import Cause, FloatArray, JointBound, JointCommand

STEP_HALVINGS = 7
"""Of the search for the feasible part of a step: to 1/128 of it."""
INSIDE_M = 0.002
"""A step ends this far inside the box, so that the curve to its end stays in it."""
CORRECTIONS = 4
"""Newton steps that bring a TCP back into the box."""
CHECKED_PLACES = np.array([0.25, 0.5, 0.75, 1.0])
"""Places of a motion at which it is checked."""
PARTS = (1.0, 0.5, 0.25, 0.125)
"""Shares of the displacement to a goal in the box that are tried, longest on the leash first."""
STOP_STEP_S = 0.01
"""Between two places of a stop that are checked. In between a TCP with the acceleration a is up to
a STOP_STEP_S^2 / 8 beyond the line through them: 0.06 mm with 5 m/s^2."""
ARC_RAD = 0.25
"""A motion is taken apart into pieces of this length to see how fast its TCP moves."""
NAMED = {"rad": "radians", "m": "metres"}
"""Units of joints in sentences."""
NEARER_M = 5e-4
"""m by which a motion may come nearer than a stop: goals are bounded step by step."""
CHECK_S = 0.016
"""Between two checks of distances at most, which cost too much for every tick; they look as far
ahead, and the joints get faster until then."""
PROBE = JointBound(0.01, 0.003)
"""First bit of the way of an arm that stands: the joint that moves furthest."""
TCP_ROOM = np.array([[0.95], [0.8], [0.8]])
"""Parts of the TCP's velocity, acceleration and jerk that a straight motion is planned with."""
BEND = 0.5
"""Part of the acceleration that a curve may take, of the TCP or in joint space."""
NO_WAY = 1e-9
"""A shorter displacement has no direction."""
CURVE_PEEK_RAD = 1e-4
"""Displacement for the rate of the Jacobian: shorter is rounding, longer is curved."""


def check_ticks(profile: Profile) -> int:
    """Ticks from one check of distances to the next."""
    return max(round(CHECK_S * profile.timing.command_hz), 1)


def first_bit(way_rad: FloatArray, kinematics: Kinematics) -> FloatArray:
    """`way_rad` (n,), or as much of it as no joint goes further than `PROBE`."""
    longest = float((np.abs(way_rad) / PROBE.of(kinematics.slides)).max())
    return way_rad / max(longest, 1.0)


class JointBounds:
    """Bounds of steps and motions of the joints. Independent of time."""

    def __init__(self, profile: Profile, kinematics: Kinematics, barriers: Barriers) -> None:
        self.limits, self.kinematics, self.barriers = profile.limits, kinematics, barriers
        self._floors = Floors(barriers)
        self.motion = chain_motion_limits(profile, kinematics)
        poses = profile.robot.command == "pose"
        self._tcp_rates = motion_limits(profile.limits).box[0] if poses else None
        margin_rad = joint_margins(self.limits.reach, kinematics)
        self.lower_rad = kinematics.lower_rad + margin_rad
        self.upper_rad = kinematics.upper_rad - margin_rad
        self.leashes = JointBound(self.limits.lead_rad, self.limits.lead_m).of(kinematics.slides)
        """(n,) how far each joint's goal may be ahead."""
        self._steps = JointBound(self.limits.step_rad, self.limits.step_m).of(kinematics.slides)

    def ways(self, start_rad: FloatArray, way_rad: FloatArray) -> tuple[float, float]:
        """Lengths of a straight motion: of the TCP or a sliding joint, m, of others, rad."""
        slides = self.kinematics.slides
        turned_rad = float(np.abs(way_rad[~slides]).max(initial=0.0))
        slid_m = float(np.abs(way_rad[slides]).max(initial=0.0))
        # The TCP's curve, were all of it as fast as its fastest piece: no less than its length,
        # and much more than the distance of its ends where joints turn far.
        far_m = max(norm3(rate[:3]) for rate in self._twists(start_rad, way_rad))
        return max(slid_m, far_m), turned_rad

    def full_speed_s(self, start_rad: FloatArray, way_rad: FloatArray) -> float:
        """Time (s) of a straight motion at full speed: of the joints, or of the TCP's poses."""
        if self._tcp_rates is None:
            return float(np.max(np.abs(way_rad) / self.motion.velocity_rad_s))
        rates = np.abs(self._twists(start_rad, way_rad))
        return float((rates / self._tcp_rates).max())

    def _twists(self, start_rad: FloatArray, way_rad: FloatArray) -> FloatArray:
        """(k, 6) of the TCP on the pieces of a straight motion that takes a second."""
        pieces = 1 + int(float(np.abs(way_rad).max()) / ARC_RAD)
        places = (np.arange(pieces) + 0.5) / pieces
        jacobian = self.kinematics.jacobian
        return np.array([jacobian(start_rad + place * way_rad) @ way_rad for place in places])

    def in_chain_order(self, action: ActionSpec, steps: FloatArray) -> FloatArray:
        """Steps (n, D) of joints with their columns in the order of the kinematics."""
        columns = [action.joints.index(name) for name in self.kinematics.arm_joints]
        return np.concatenate([steps[:, columns], steps[:, action.arm_size :]], axis=1)

    def far_out_of_range(
        self, action: ActionSpec, steps: FloatArray, base_rad: FloatArray
    ) -> Rejection | None:
        """Why targets (n, D) in chain order are too far outside their ranges to be intended."""
        endless = self.kinematics.endless
        asked_rad = np.array(
            [step_joints(action, step, base_rad, base_rad, endless) for step in steps]
        )
        away_rad = np.maximum(self.lower_rad - asked_rad, asked_rad - self.upper_rad)
        mosts = REJECT_FACTOR * self._steps
        step, joint = np.unravel_index(int(np.argmax(away_rad / mosts)), away_rad.shape)
        most_rad = float(mosts[joint])
        if away_rad[step, joint] <= most_rad:
            return None
        name, at_rad = self.kinematics.arm_joints[joint], asked_rad[step, joint]
        unit = self.kinematics.unit(int(joint))
        why = (
            f"a target of {name} at {at_rad:.4g} {unit}, whose range is "
            f"{self.lower_rad[joint]:.4g} to {self.upper_rad[joint]:.4g}: are these {NAMED[unit]}, "
            "and from the zero and in the direction of the arm's description?"
        )
        return Rejection("joint_limit", why, float(away_rad[step, joint]), most_rad)

    def bound_in_pieces(
        self, start_rad: FloatArray, asked_rad: FloatArray
    ) -> Generator[None, None, BoundedStep]:
        """The end of a step from `start_rad` (n,) towards `asked_rad` (n,), in pieces.

        Yields before every evaluation of the distances.
        """
        target_rad, hits = self.into_ranges(start_rad, asked_rad)
        yield
        before = self.barriers_at(start_rad)
        floor = self._floors.after(before)
        yield
        after, found = self._try(start_rad, target_rad, floor)
        if found is not None:
            low, high, whole, after = 0.0, 1.0, target_rad, before
            for _ in range(STEP_HALVINGS):
                middle = 0.5 * (low + high)
                part_rad = start_rad + middle * (whole - start_rad)
                yield
                end, hit = self._try(start_rad, part_rad, floor)
                if hit is None:
                    low, after = middle, end
                else:
                    high, found = middle, hit
            hits = [found, *hits]
            target_rad = start_rad + low * (whole - start_rad)
        slower = self.barriers.slowdown(before, after)
        return BoundedStep(self.kinematics.forward(target_rad), hits, target_rad, slower)

    def barriers_at(self, joints_rad: FloatArray) -> FloatArray:
        """Barriers of the distances; a singularity is none."""
        left_m = self.barriers.collisions.distances(joints_rad) - self.barriers.stop[1:]
        return np.concatenate([[np.inf], left_m])

    def into_ranges(
        self, start_rad: FloatArray, asked_rad: FloatArray
    ) -> tuple[FloatArray, list[LimitHit]]:
        """The nearest joints within their ranges and with the TCP inside the box, and the hits."""
        hits: list[LimitHit] = []
        lower, upper = np.minimum(self.lower_rad, start_rad), np.maximum(self.upper_rad, start_rad)
        target_rad = np.clip(asked_rad, lower, upper)
        joint = int(np.argmax(np.abs(asked_rad - target_rad)))
        if abs(asked_rad[joint] - target_rad[joint]) > ROUNDING:
            asked, bound = float(asked_rad[joint]), float(target_rad[joint])
            name = self.kinematics.arm_joints[joint]
            hits.append(LimitHit("joint_limit", asked, bound, where=name))
        low, high = workspace_corners(self.limits)
        start_m = self.kinematics.forward(start_rad).position_m
        low, high = np.minimum(low + INSIDE_M, start_m), np.maximum(high - INSIDE_M, start_m)
        outside_m = 0.0
        for _ in range(CORRECTIONS):
            pose, jacobian = self.kinematics.pose_and_jacobian(target_rad)
            back_m = np.clip(pose.position_m, low, high) - pose.position_m
            away_m = norm3(back_m)
            if away_m < ROUNDING:
                break
            outside_m = max(outside_m, away_m)
            rows = jacobian[:3]
            step = rows.T @ np.linalg.solve(rows @ rows.T + ROUNDING * np.eye(3), back_m)
            target_rad = np.clip(target_rad + step, lower, upper)
        if outside_m > INSIDE_M:
            hits.append(LimitHit("workspace", outside_m, 0.0))
        return target_rad, hits

    def _try(
        self, start_rad: FloatArray, end_rad: FloatArray, floor: FloatArray
    ) -> tuple[FloatArray, LimitHit | None]:
        """Barriers at the end of a step, and the limit that forbids it."""
        after = self.barriers_at(end_rad)
        hit = self._box_hit(start_rad, end_rad)
        short = after - floor
        index = int(np.argmin(short))
        if hit is None and short[index] < 0:
            hit = self.barriers.hit(index, after[index], floor[index])
        return after, hit

    def _box_hit(self, start_rad: FloatArray, end_rad: FloatArray) -> LimitHit | None:
        """The face of the box that the straight motion between two joints would cross."""
        corners_m = self.corners_with(self.kinematics.forward(start_rad).position_m)
        places_rad = start_rad + CHECKED_PLACES[:, None] * (end_rad - start_rad)
        return self.face_hit(corners_m, places_rad)

    def corners_with(self, place_m: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Lower and upper corner (3,) m of the box with a place of the TCP, outside or not."""
        low_m, high_m = workspace_corners(self.limits)
        return np.minimum(low_m, place_m), np.maximum(high_m, place_m)

    def face_hit(
        self, corners_m: tuple[FloatArray, FloatArray], places_rad: Iterable[FloatArray]
    ) -> LimitHit | None:
        """The face of the box of these corners outside which the TCP is at any of the joints."""
        for joints_rad in places_rad:
            at_m = self.kinematics.forward(joints_rad).position_m
            outside_m = norm3(at_m - np.clip(at_m, *corners_m))
            if outside_m > ROUNDING:
                return LimitHit("workspace", outside_m, 0.0)
        return None

    def ahead_hit(
        self, start_rad: FloatArray, end_rad: FloatArray, floor: FloatArray
    ) -> LimitHit | None:
        """The bound that the straight motion between two joints would violate."""
        hit = self._box_hit(start_rad, end_rad)
        return hit or self.distance_hit(start_rad, end_rad, floor)

    def distance_hit(
        self, start_rad: FloatArray, end_rad: FloatArray, floor: FloatArray
    ) -> LimitHit | None:
        """The distance that would be too small at the end of a motion between two joints.

        Below zero it must not fall under its `floor` (n,).
        """
        if np.array_equal(start_rad, end_rad):
            return None
        after = self.barriers_at(end_rad)
        short = after - floor + NEARER_M
        index = int(np.argmin(short))
        return self.barriers.hit(index, after[index]) if short[index] < 0 else None


class JointPath(AxisSmoother):
    """Smooth motion of the joints themselves, with the motion of their TCP."""

    stuck = ""
    strays_m = 2.5e-3
    """A goal that is new as the brake begins moves its end: with this much for each of two arms
    none came nearer than their stop in 5 million ticks of ``fuzz_parts.py``."""

    def __init__(self, profile: Profile, bounds: JointBounds) -> None:
        self.kinematics, self._bounds = bounds.kinematics, bounds
        self._tcp_box = motion_limits(profile.limits).box
        self._check_ticks = check_ticks(profile)
        self._hits: list[LimitHit] = []
        self._before_bound = False
        """It braked before a bound, on the way to what was asked for last."""
        home_rad = self.kinematics.ordered(profile.robot.arm_joints, profile.robot.home_rad)
        dt_s, box = 1.0 / profile.timing.command_hz, np.array(bounds.motion)
        super().__init__(home_rad, dt_s, box, within=(bounds.lower_rad, bounds.upper_rad))

    @property
    def tcp(self) -> Motion:
        """The commanded motion of the TCP."""
        return self.motion

    def stand(self, position: FloatArray) -> None:
        super().stand(position)
        self._before_bound = False
        self._unchecked = 0
        """Ticks since distances were looked at."""
        self._floor = np.full(len(self._bounds.barriers.stop), -np.inf)
        """(n,) least values of distances, see `_raise_floor`."""
        self._held = self._bounds.barriers.collisions.held
        self._follow()
        self._corners_m = self._bounds.corners_with(self.motion.pose.position_m)
        """Corners (3,) of what the TCP keeps to, see `_tighten`."""

    def leash(self, goal: Goal, ahead_s: float) -> tuple[Goal, list[LimitHit]]:
        """`goal`, or a nearer one on the leash and inside the box, and the limits that acted.

        A part of the way between two joints inside the box may be outside, and so may their mean.
        """
        here_rad, goal_rad = self.state.position, goal.known_rad
        from_rad = here_rad + ahead_s * self.state.velocity
        hits: list[LimitHit] = []
        leashes = self._bounds.leashes
        ahead = np.abs(goal_rad - from_rad) / leashes
        joint = int(np.argmax(ahead))
        if ahead[joint] > 1.0:
            name = "lead_m" if self.kinematics.slides[joint] else "lead_rad"
            most = float(leashes[joint])
            hits.append(LimitHit(name, float(ahead[joint]) * most, most))
            goal_rad = from_rad + (goal_rad - from_rad) / ahead[joint]
            goal = joint_goal(self.kinematics, goal_rad, goal.width_m, goal.slowdown)
        outside_m = self._outside_m(goal)
        if outside_m <= ROUNDING:
            return goal, hits
        hits.append(LimitHit("workspace", outside_m, 0.0))
        inside_rad, _ = self._bounds.into_ranges(here_rad, goal_rad)
        for share in PARTS:
            part_rad = here_rad + share * (inside_rad - here_rad)
            near = joint_goal(self.kinematics, part_rad, goal.width_m, goal.slowdown)
            on_leash = (np.abs(part_rad - from_rad) <= leashes + ROUNDING).all()
            if on_leash and self._outside_m(near) <= ROUNDING:
                return near, hits
        return joint_goal(self.kinematics, here_rad, goal.width_m, goal.slowdown), hits

    def near(self, goal: Goal) -> Goal:
        """`goal`, or one so near that the arm can retreat from there."""
        way_rad = self.way_to(goal)
        leads = JointBound(PAUSE_LEAD_RAD, PAUSE_LEAD_M).of(self.kinematics.slides)
        longest = (np.abs(way_rad) / leads).max()
        if longest <= 1.0:
            return goal
        nearer_rad = self.state.position + way_rad / longest
        return joint_goal(self.kinematics, nearer_rad, goal.width_m, goal.slowdown)

    def resting_goal(self, _: Pose, width_m: float) -> Goal:
        """Brake; where that ends."""
        return joint_goal(self.kinematics, self.braked(), width_m)

    def _outside_m(self, goal: Goal) -> float:
        """How far outside the box a goal is, or further outside than the arm."""
        here_m = self.motion.pose.position_m
        return into_workspace(self._bounds.limits, goal.pose.position_m, here_m)[1]

    def go_to(self, goal: Goal, shares: Shares = FULL, *, all_to_stop: bool = False) -> bool:
        """Move to the joints of `goal`, or as near as the bounds allow; see `move_to`.

        A new goal does not end a brake before a bound: each would bring the arm nearer.
        """
        self._asked, self._before_bound = (goal, shares, all_to_stop), False
        here_rad, end_rad = self.state.position, goal.known_rad
        self._raise_floor()
        if not self._goes:
            self._brake_at(self._near_hit())
            if self._before_bound:
                return True
        hit = self._bounds.ahead_hit(here_rad, end_rad, self._floor)
        if hit is not None:
            self._hits.append(hit)
            way_rad, low, high = end_rad - here_rad, 0.0, 1.0
            for _ in range(STEP_HALVINGS):
                middle = 0.5 * (low + high)
                found = self._bounds.ahead_hit(here_rad, here_rad + middle * way_rad, self._floor)
                low, high = (low, middle) if found else (middle, high)
            end_rad = here_rad + low * way_rad
        planned = self.move_to(end_rad, shares, all_to_stop=all_to_stop)
        if self._goes:  # it may get faster until the next check
            self._brake_at(self._near_hit())
        return planned

    def tick(self) -> Motion:
        """Advance by a tick; brakes where the motion would come too near to a bound."""
        if self._before_bound and self.at_rest:
            self._go_on()
        if self._unchecked >= self._check_ticks and self._goes:
            self._raise_floor()
            self._brake_at(self._near_hit())
        self._unchecked += 1
        before = self.state
        moves = self.advance(1.0)
        if moves and not (self.braking or self._stops_inside()):
            hit = self._stop_hit()
            if hit is not None:
                self.state = before  # a stop from there was found to end inside
                self._brake_at(hit)
                self.advance(1.0)
        if moves:
            self._follow()
            self._tighten()
        return self.motion

    def brake(self) -> None:
        """Come to rest as `tick` has checked it."""
        self._before_bound = False
        self.brake_on_line()

    def _brake_at(self, hit: LimitHit | None) -> None:
        if hit is not None:
            self._hits.append(hit)
            self.brake()
            self._before_bound = True

    @property
    def _goes(self) -> bool:
        return not (self.braking or self.at_rest)

    def _raise_floor(self) -> None:
        """No distance falls again, once it is below zero.

        If each motion were compared with its own start, a slow one, or one that stops and goes,
        would pass any bound by `NEARER_M` at a time.
        """
        held = self._bounds.barriers.collisions.held
        if held != self._held:  # what is too near now may move away
            self._held, self._floor = held, np.full(len(self._floor), -np.inf)
        left_m = self._bounds.barriers_at(self.state.position)
        self._floor = np.maximum(self._floor, np.minimum(left_m, 0.0))

    def _tighten(self) -> None:
        """A TCP outside the box goes no further out, and not back where it has been.

        Its corners are those of the box with the place where the arm stood last. Were they those
        with its present place, each tick might leave the box by a bit that the next one takes as
        its start.
        """
        low_m, high_m = self._bounds.corners_with(self.motion.pose.position_m)
        if not self.at_rest:
            low_m = np.maximum(low_m, self._corners_m[0])
            high_m = np.minimum(high_m, self._corners_m[1])
        self._corners_m = low_m, high_m

    def _near_hit(self) -> LimitHit | None:
        """The distance that would be too small at the end of a stop, begun before the next check.

        Of an arm that stands: after the first bit of the way to what was asked for last.
        """
        here_rad, self._unchecked = self.state.position, 0
        if self.at_rest:
            way_rad = self.way_to(self._asked[0])
            ahead_rad = first_bit(way_rad, self.kinematics)
        elif self.braking:  # an upper bound, so that a new goal does not end the brake
            ahead_rad = stop_way(*self.state[1:], self.box, self._check_ticks * self._dt_s)
        else:  # of the motion in progress, which may still get faster
            ahead_rad = self.stopping_rad(self._check_ticks * self._dt_s)[-1] - here_rad
        return self._bounds.distance_hit(here_rad, here_rad + ahead_rad, self._floor)

    def _go_on(self) -> None:
        """Continue after a brake before a bound, if the straight way to the goal is free."""
        goal, shares, all_to_stop = self._asked
        self._before_bound = False
        self._raise_floor()
        way_rad = self.state.position, goal.known_rad
        if not (self._near_hit() or self._bounds.ahead_hit(*way_rad, self._floor)):
            self.go_to(goal, shares, all_to_stop=all_to_stop)

    def _stop_hit(self) -> LimitHit | None:
        """The face of the box that a stop from the present state would cross.

        The stop is no straight line of the joints where they do not all move in proportion.
        """
        stop = self._stop(self.box, together=self._line() is not None)
        if stop is None:
            return None
        steps = math.ceil(stop.duration_s / STOP_STEP_S)
        times_s = stop.duration_s * np.arange(steps + 1) / max(steps, 1)
        stop_rad = (stop.at(float(time_s)).position for time_s in times_s)
        return self._bounds.face_hit(self._corners_m, stop_rad)

    def _stops_inside(self) -> bool:
        """Whether the TCP is too far from every face of the box for a stop to cross one."""
        low, high = workspace_corners(self._bounds.limits)
        place = self.motion.pose.position_m
        room_m = float(np.minimum(place - low, high - place).min())
        way = np.abs(stop_way(*self.state[1:], self.box, self._dt_s))
        # A joint moves the TCP by its way times its lever, which grows by what the TCP has moved:
        # all together by a factor of exp(their ways) at most (Gronwall).
        return float(way @ self._levers) * math.exp(float(way.sum())) < room_m

    def stopping_rad(self, ahead_s: float) -> list[FloatArray]:
        """(n,) each, joints on the way of a stop that begins in `ahead_s`, and at its end."""
        if self.at_rest:
            return [self.state.position]
        ahead = copy(self)
        if not self.braking:
            ahead.advance(ahead_s / self._dt_s)
        end_rad = ahead.braked()
        return [ahead.halfway_to_rest(), end_rad]

    def _follow(self) -> None:
        """Compute the motion of the TCP."""
        joints_rad, velocity, acceleration = self.state
        pose, jacobian = self.kinematics.pose_and_jacobian(joints_rad)
        self._levers = np.sqrt((jacobian[:3] ** 2).sum(axis=0))
        change = jacobian @ acceleration
        fastest = float(np.abs(velocity).max())
        if fastest > 0.0:
            peek_s = CURVE_PEEK_RAD / fastest
            ahead, behind = (
                self.kinematics.jacobian(joints_rad + sign * peek_s * velocity)
                for sign in (1.0, -1.0)
            )
            change += (ahead - behind) @ velocity / (2 * peek_s)
        self.motion = Motion(pose, jacobian @ velocity, change)

    def taken_hits(self) -> list[LimitHit]:
        """Limits that acted since the last call."""
        hits, self._hits = self._hits, []
        return hits

    # -- the same interface as for poses ------------------------------------------------------
    @property
    def joints_rad(self) -> FloatArray:
        """(n,) joints commanded."""
        return self.state.position

    def step(self, mode: MotionMode) -> None:
        """Advance by one tick."""
        self.tick()

    stop = pause = brake

    def way_to(self, goal: Goal) -> FloatArray:
        """(n,) from the commanded joints to those of `goal`."""
        return goal.known_rad - self.state.position

    def axis_rates(self) -> tuple[FloatArray, FloatArray]:
        """(n,) velocity and acceleration of the joints."""
        return self.state[1:]

    def shares(self, goal: Goal) -> Shares:
        """Shares of the joints' limits with which the TCP keeps its own on the way to a goal."""
        way_rad = self.way_to(goal)
        places = [self.state.position + place * way_rad for place in (0.0, 0.5, 1.0)]
        ways = [self.kinematics.jacobian(place) @ way_rad for place in places]
        bends = 2 * np.abs(np.diff(ways, axis=0)).max(axis=0)
        now = float(np.linalg.norm(self.state.velocity))
        return followed_shares(
            way_rad, self.box, now, np.abs(ways).max(axis=0), bends, TCP_ROOM * self._tcp_box, BEND
        )

    def command(self, state: str, cause: Cause | None, goal: Goal | None) -> JointCommand:
        """The joint command of this tick."""
        return JointCommand(self.kinematics.arm_joints, *self.state, state, cause)


def followed_shares(
    ways: FloatArray,
    box: FloatArray,
    speed: float,
    other_ways: FloatArray,
    bends: FloatArray,
    limits: FloatArray,
    bend: float,
) -> Shares:
    """Shares of the limits of a straight motion that another space can follow.

    The motion goes by `ways` (n,) within `box` (3, n), and has the `speed` now. In the other space
    it goes by `other_ways` (m,) in one unit of time, changing by `bends` (m,); that has the
    `limits` (3, m), and the curvature may take the part `bend` of its acceleration.
    """
    length = float(np.linalg.norm(ways))
    if length < NO_WAY:
        return FULL
    # All axes move together, as fast as the slowest one.
    rates = (box / np.maximum(np.abs(ways), NO_WAY)).min(axis=1)
    now = speed / length
    bends = np.maximum(bends, NO_WAY)
    needed = np.maximum(rates[:, None] * other_ways, NO_WAY)
    velocity, _, jerk = (limits / needed).min(axis=1)
    fastest = min(rates[0] * velocity, float(np.min(np.sqrt(bend * limits[1] / bends))))
    reached = min(fastest, (now * now + rates[1]) ** 0.5)
    left = limits[1] - bends * reached * reached  # at least the part 1 - bend, by `fastest`
    parts = np.clip([fastest / rates[0], (left / needed[1]).min(), jerk], LEAST_TO_GOAL, 1.0)
    return Shares(*(float(part) for part in parts))
