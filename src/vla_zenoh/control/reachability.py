"""Reachability: steps are shortened to what the arm can do, by a kinematic model that moves ahead.

A step whose end has no joint solution, or comes too near to a singularity, to the arm itself or to
the table, is shortened to its feasible part; the rest of the step is dropped. Each barrier is a
number ``h`` that must not become negative: singular value or distance minus its stop. A step from
``h0`` must end with::

    h >= min(slow - stop, h0 / 2)     where h0 > 0: beyond `slow` it takes half of what is left,
    h >= h0                           where h0 <= 0: a violated barrier may only be left, and does
                                      not fall again (`Floors`)

which is a control barrier function in discrete time (Agrawal, Sreenath, "Discrete control barrier
functions for safety-critical control of discrete systems", RSS 2017) with a decay of one half.
A joint outside its range may only move inwards. The elbow of a redundant arm is where pose and
posture put it, as with a Cartesian controller, unless joints are commanded.

Inside its zone ``slow - stop`` a barrier that shrinks limits the speed of the TCP to a share of the
profile's::

    share = sqrt(h / (slow - stop)), at least LEAST_NEAR_STOP

the speed that a constant deceleration can stop within the distance left, if it can stop full speed
within the zone. A step for which only the joints are too slow is kept with a slowdown, see
`vla_zenoh.control.limits`; it is shortened only if it would take more than ten times as long, for
then the joints jump to another solution.
"""

from __future__ import annotations

from collections.abc import Generator, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from vla_zenoh.control.limits import (
    LEAST_NEAR_STOP,
    LEAST_TO_GOAL,
    BoundedStep,
    LimitHit,
    Slowdown,
    full_speed_s,
    joint_margins,
    slowest,
)
from vla_zenoh.errors import ProfileError, RecordError
from vla_zenoh.kinematics.collision import FREE_M, CollisionModel
from vla_zenoh.kinematics.kinematics import (
    TOLERANCE_M,
    Approach,
    InverseKinematics,
    Kinematics,
    make_kinematics,
    pose_error,
    smallest_singular_value,
)
from vla_zenoh.kinematics.so3 import Pose, interpolate
from vla_zenoh.profile import Profile, ReachLimits
from vla_zenoh.types import FloatArray, HeldBox

LEAVES_M = 5e-3
"""A pair that is never far apart can get this much further apart than its stop."""
DECAY = 0.5
"""Part of the distance to a stop that one step may take inside its zone."""
NOISE = 2e-6
"""m, and singular value: difference of distances and solver between two equal poses."""
SHRINKING = 1e-6
"""A barrier that changes by less counts as constant."""
REACH_HALVINGS = 4
"""Tries for a part that is feasible, the first a guess; then nothing of the step is left."""
REFINEMENTS = 4
"""Halvings of what is between the feasible part and the next: to 1/16 of it."""
SMALLEST_FRACTION = 1 / 128
"""A smaller part of a step counts as nothing."""
GUESS_SHORT = 0.95
"""Factor on a linear guess of the feasible part: most barriers are concave."""
SOLVER_ITERATIONS = 12
"""Steps are short and start near their end: a solver that needs more does not converge."""
EFFORT = 5
"""Iterations of the solver per evaluation; one with more counts as several."""
SAME_POSE = 1e-9
"""Poses nearer to each other than this have the same joints: rounding of a sum of steps."""
NEWTON_STEPS = 8
"""From joints that are near a few suffice; without a solution it ends somewhere near."""


class Margins(NamedTuple):
    """Distances of an arm to its bounds.

    Args:
        joint_rad: smallest distance of a joint to the end of its range, inf where none has one.
        joint: its name.
        singular_value: smallest of the Jacobian.
        self_m: smallest distance of the arm to itself, inf where nothing can touch.
        table_m: smallest distance to the table, inf without one.
        keep_out_m: smallest distance to a keep-out, inf without one.
    """

    joint_rad: float
    joint: str
    singular_value: float
    self_m: float
    table_m: float
    keep_out_m: float


class Barriers:
    """Values that must not become negative: singular value and distances, each minus its stop.

    Barrier 0 is the singular value, the others are pairs that may touch: the arm and itself, the
    table and the keep-outs; hand and fingers to the table have a stop of their own.

    Args:
        kinematics: of the arm.
        limits: stop and slow of each kind.
        home_rad: (n,) the arm at home.

    Attributes:
        names: of the barriers, as in `vla_zenoh.control.limits.LimitHit`.
        stop: (n,) value at which each is zero.
        slow: (n,) value at which its zone begins.

    Raises:
        ResourceError: the URDF's collision shapes cannot be loaded.
        ProfileError: the arm at home touches a keep-out.
    """

    def __init__(self, kinematics: Kinematics, limits: ReachLimits, home_rad: FloatArray) -> None:
        self.collisions = CollisionModel(
            kinematics,
            near_m=limits.collision_slow_m,
            table_z_m=limits.table_z_m,
            home_rad=home_rad,
            keep_out=limits.keep_out,
            may_touch=limits.may_touch,
        )
        pairs = self.collisions.pairs
        hand = np.array([pair.is_hand and pair.limit == "table_distance" for pair in pairs], bool)
        self.names = ["singularity", *(pair.limit for pair in pairs)]
        stops_m = np.where(hand, limits.table_stop_m, limits.collision_stop_m)
        slows_m = np.where(hand, limits.table_slow_m, limits.collision_slow_m)
        # A pair that is never far apart, as an upper arm whose shoulder is near the table, has a
        # stop and a zone that it can leave.
        farthest_m = self.collisions.farthest_m
        stops_m = np.minimum(stops_m, farthest_m - LEAVES_M)
        slows_m = np.maximum(np.minimum(slows_m, 0.5 * (stops_m + farthest_m)), stops_m)
        self.stop = np.array([limits.singularity_stop, *stops_m])
        self.slow = np.array([limits.singularity_slow, *slows_m])
        self.zone = np.maximum(self.slow - self.stop, 1e-12)
        if limits.keep_out:
            self._check_keep_outs(home_rad)

    def _check_keep_outs(self, home_rad: FloatArray) -> None:
        distances_m = self.collisions.distances(home_rad)
        for index in np.argsort(distances_m):
            pair, stop_m = self.collisions.pairs[index], self.stop[index + 1]
            if pair.limit == "keep_out" and distances_m[index] <= stop_m:
                raise ProfileError(
                    f"{pair.first} is {distances_m[index]:.3f} m from the keep-out "
                    f"{pair.second!r} with the arm at home, and must be over {stop_m:g} m "
                    "(collision_stop_m) away; move the keep-out, make it smaller, or give another "
                    "home_rad",
                    ("limits", "reach", "keep_out", pair.second),
                )

    def at(self, joints_rad: FloatArray, jacobian: FloatArray) -> FloatArray:
        """Barriers (n,) at these joints, whose Jacobian is (6, n) m and rad."""
        values = np.empty(len(self.stop))
        values[0] = smallest_singular_value(jacobian)
        values[1:] = self.collisions.distances(joints_rad)
        return values - self.stop

    def inside(self, joints_rad: FloatArray) -> list[LimitHit]:
        """The distances that are too small at these joints, the most violated one first."""
        left_m = self.collisions.distances(joints_rad) - self.stop[1:]
        order = np.argsort(left_m)
        return [self.hit(int(i) + 1, float(left_m[i])) for i in order if left_m[i] <= 0]

    def where(self, index: int) -> str:
        """The part of the arm that barrier `index` is about; empty: the whole arm."""
        if index == 0:
            return ""
        pair = self.collisions.pairs[index - 1]
        return pair.first if pair.limit == "table_distance" else str(pair)

    def hit(self, index: int, left: float, least: float = 0.0) -> LimitHit:
        """Barrier `index` as a limit that acted: `left` of it, where it must be `least`."""
        stop = float(self.stop[index])
        where = self.where(index)
        return LimitHit(self.names[index], float(left) + stop, float(least) + stop, where=where)

    def slowdown(self, before: FloatArray, after: FloatArray) -> Slowdown | None:
        """The slowdown of a step from barriers `before` to `after`, None for full speed."""
        if (after >= self.zone).all():
            return None
        left = np.where(after < before - SHRINKING, np.clip(after / self.zone, 0.0, 1.0), 1.0)
        index = int(left.argmin())
        if left[index] >= 1.0:
            return None
        share = max(float(np.sqrt(left[index])), LEAST_NEAR_STOP)
        value, slow = float(after[index] + self.stop[index]), float(self.slow[index])
        return Slowdown(self.names[index], share, value, slow, self.where(index))


class Floors:
    """Least values of barriers after a step; a violated one does not fall, in however many steps.

    Args:
        barriers: what it is about.
    """

    def __init__(self, barriers: Barriers) -> None:
        self._zone = barriers.zone
        self._reached = np.full(len(barriers.zone), -np.inf)
        """(n,) greatest values up to zero since the arm began to move by itself."""

    def after(self, before: FloatArray) -> FloatArray:
        """Least values (n,) after one step from `before`."""
        violated = np.minimum(before, 0.0)
        was_moved = violated < self._reached - NOISE
        self._reached = np.where(was_moved, violated, np.maximum(violated, self._reached))
        inside = np.minimum(self._zone, (1 - DECAY) * before)
        return np.where(before > 0, inside, self._reached - NOISE)


class _Configuration(NamedTuple):
    """The model at one pose: the pose asked for, and the barriers at `joints_rad`."""

    pose: Pose
    joints_rad: FloatArray
    error: float
    barriers: FloatArray


class _Start(NamedTuple):
    """The start of a step, and the bounds of its end: least barriers, and ranges of the joints."""

    here: _Configuration
    floor: FloatArray
    lower_rad: FloatArray
    upper_rad: FloatArray


class ReachabilityFilter:
    """Bounds steps of the TCP by the kinematics of the arm, at first at home. Independent of time.

    Args:
        profile: its robot, and limits: stop and slow of the barriers, speed of the TCP.
        kinematics: of the robot; None: they are made.

    Raises:
        ResourceError: the robot's description or its collision shapes cannot be loaded.
        ProfileError: as `make_kinematics`, or the arm at home touches a keep-out.
    """

    def __init__(self, profile: Profile, kinematics: Kinematics | None = None) -> None:
        self.kinematics = kinematics = kinematics or make_kinematics(profile)
        self._limits, robot = profile.limits, profile.robot
        home_rad = kinematics.ordered(robot.arm_joints, robot.home_rad)
        # Elbow and joint velocities are ours only where joints are commanded.
        self._free_elbow = robot.command == "joint"
        self._velocity_rad_s = kinematics.velocity_rad_s
        if self._free_elbow:
            own_rad_s = self._limits.joint.of("velocity_rad_s", kinematics.size)
            self._velocity_rad_s = np.minimum(
                kinematics.ordered(robot.arm_joints, own_rad_s), self._velocity_rad_s
            )
        self._solver = InverseKinematics(
            kinematics,
            home_rad,
            joint_margin_rad=joint_margins(self._limits.reach, kinematics),
            max_iterations=SOLVER_ITERATIONS,
        )
        self._at_start = robot.posture == "start"
        """The controller pulls a redundant arm to its joints at the last `reset`, not to home."""
        self.barriers = Barriers(kinematics, self._limits.reach, home_rad)
        self._floors = Floors(self.barriers)
        self.reset(home_rad)

    def reset(self, joints_rad: ArrayLike) -> None:
        """Move the model to the joints of the robot.

        Raises:
            RecordError: not one finite number per arm joint.
        """
        joints = np.array(joints_rad, dtype=np.float64)
        if joints.shape != (self.kinematics.size,) or not np.isfinite(joints).all():
            raise RecordError(
                f"joints_rad must be {self.kinematics.size} finite numbers, got {joints!r}"
            )
        if self._at_start:
            self._solver.posture_rad = joints.copy()
        pose, jacobian = self.kinematics.pose_and_jacobian(joints)
        self._here = _Configuration(pose, joints, 0.0, self.barriers.at(joints, jacobian))
        self._measured_rad: FloatArray | None = None
        self.cost = 1
        """Number of evaluations that the last one counts as."""

    def hold(self, box: HeldBox | None) -> None:
        """Count what the gripper holds among the arm's links; None: nothing."""
        self.barriers.collisions.hold(box)
        here = self._here
        jacobian = self.kinematics.jacobian(here.joints_rad)
        self._here = here._replace(barriers=self.barriers.at(here.joints_rad, jacobian))

    def set_elbow(self, joints_rad: FloatArray) -> None:
        """Start the next step with the elbow of these joints (n,) of the robot."""
        self._measured_rad = joints_rad

    def solve(self, pose: Pose, joints_rad: FloatArray) -> FloatArray | None:
        """Joints (n,) for `pose`, solved from `joints_rad` (n,); None without a solution."""
        found = self._solver.approach(pose, joints_rad, bounded=False)
        return found.joints_rad if found.solved else None

    def joints_near(self, pose: Pose, joints_rad: FloatArray) -> FloatArray:
        """Joints (n,) of `pose`, or as near to it as they get, solved from `joints_rad` (n,)."""
        return self._solver.approach(pose, joints_rad, bounded=False).joints_rad

    def joints_at(self, pose: Pose) -> FloatArray:
        """Joints (n,) of `pose`, or as near to it as they get, with the robot's elbow."""
        measured_rad = self._measured_rad
        joints_rad = self._here.joints_rad if measured_rad is None else measured_rad
        for _ in range(NEWTON_STEPS):
            here, jacobian = self.kinematics.pose_and_jacobian(joints_rad)
            step = np.linalg.lstsq(jacobian, pose_error(pose, here), rcond=1e-3)[0]
            joints_rad = joints_rad + step
        return joints_rad

    @property
    def joints_rad(self) -> FloatArray:
        """(n,) of the model: those of the last bounded pose."""
        return self._here.joints_rad.copy()

    @property
    def margins(self) -> Margins:
        """Margins of the model where it is."""
        kinematics, joints_rad = self.kinematics, self._here.joints_rad
        room = np.minimum(joints_rad - kinematics.lower_rad, kinematics.upper_rad - joints_rad)
        tightest = int(np.argmin(room))
        values = (self._here.barriers + self.barriers.stop).tolist()
        nearest_m: dict[str, float] = dict.fromkeys(
            ("self_collision", "table_distance", "keep_out"), np.inf
        )
        for name, value in zip(self.barriers.names[1:], values[1:], strict=True):
            if value < FREE_M:
                nearest_m[name] = min(nearest_m[name], value)
        joint = kinematics.arm_joints[tightest]
        return Margins(float(room[tightest]), joint, values[0], *nearest_m.values())

    def bound(self, before: Pose, asked: Pose, dt_s: float) -> BoundedStep:
        """`bound_in_pieces` at once."""
        search = self.bound_in_pieces(before, asked, dt_s)
        while True:
            try:
                next(search)
            except StopIteration as last:
                return last.value

    def bound_in_pieces(
        self, before: Pose, asked: Pose, dt_s: float, start_rad: FloatArray | None = None
    ) -> Generator[None, None, BoundedStep]:
        """The furthest pose from `before` towards `asked` that the arm can take, in pieces.

        Yields before every evaluation (joints of a pose, and their barriers): the cost of one is
        known, see `cost`, their number is not, about 10 where a limit cuts. Afterwards the model is
        at the end of the step.

        Args:
            before: start of the step, usually the pose bounded last.
            asked: its end.
            dt_s: its duration.
            start_rad: (n,) joints at `before`; None: near those of the last bounded pose.
        """
        here = self._here
        is_here = start_rad is None or np.array_equal(start_rad, here.joints_rad)
        if self._measured_rad is not None or not is_here or not _same(before, here.pose):
            yield
            measured_rad, self._measured_rad = self._measured_rad, None
            found = None if measured_rad is None else self._approach(before, measured_rad)
            if found is None or not found.solved:
                near_rad = here.joints_rad if start_rad is None else start_rad
                found = self._approach(before, near_rad)
            here = self._here = self._configuration(before, found)
        floor = self._floors.after(here.barriers)
        if here.error > 0:  # an arm stretched towards a pose out of reach is singular
            floor[0] = -np.inf
        start = _Start(here, floor, *self._solver.bounds(here.joints_rad))
        yield
        end, hits = self._try(start, asked, dt_s)
        if not hits:
            return self._settle(start, end, asked, hits, dt_s)
        best, low, high = here, 0.0, 1.0
        fraction = self._guess(start, end, hits)
        for _ in range(REACH_HALVINGS):
            if fraction < SMALLEST_FRACTION:
                break
            yield
            end, found = self._try(start, interpolate(before, asked, fraction), dt_s)
            if not found:
                best, low = end, fraction
                break
            high, hits, fraction = fraction, found, fraction / 2
        if low > 0.0:
            for _ in range(REFINEMENTS):
                fraction = 0.5 * (low + high)
                yield
                end, found = self._try(start, interpolate(before, asked, fraction), dt_s)
                if found:
                    high, hits = fraction, found
                else:
                    best, low = end, fraction
        return self._settle(start, best, best.pose if low > 0.0 else before, hits, dt_s)

    def _settle(
        self, start: _Start, end: _Configuration, pose: Pose, hits: list[LimitHit], dt_s: float
    ) -> BoundedStep:
        self._here = end
        slower = self.barriers.slowdown(start.here.barriers, end.barriers)
        slower = slowest(slower, self._late(start.here, end, dt_s))
        return BoundedStep(pose, hits, end.joints_rad, slower)

    def _guess(self, start: _Start, end: _Configuration, hits: Sequence[LimitHit]) -> float:
        """First guess of the feasible part, from how the whole step failed."""
        here = start.here
        if end is here or here.error > 0 or here.barriers.min() <= 0:
            return 0.5
        if hits[0].name == "joint_velocity":
            return GUESS_SHORT * hits[0].limit / (LEAST_NEAR_STOP * hits[0].value)
        room = here.barriers - start.floor
        fall = np.maximum(here.barriers - end.barriers, 1e-12)
        return GUESS_SHORT * min(1.0, float((room / fall).min()))

    # -- one evaluation -----------------------------------------------------------------------
    def _configuration(self, pose: Pose, found: Approach) -> _Configuration:
        error = 0.0 if found.solved else found.error_m + found.error_rad
        barriers = self.barriers.at(found.joints_rad, found.jacobian)
        return _Configuration(pose, found.joints_rad, error, barriers)

    def _try(self, start: _Start, pose: Pose, dt_s: float) -> tuple[_Configuration, list[LimitHit]]:
        """The end of a step to `pose`, and the limits that forbid it."""
        here = start.here
        found = self._approach(pose, here.joints_rad)
        # From a start without a solution, a step that comes nearer to one is allowed.
        if not found.solved and found.error_m + found.error_rad >= here.error * (1 - 1e-6):
            apart = LimitHit("reach", found.error_m + found.error_rad, TOLERANCE_M)
            return here, [self._out_of_range(start, found.wanted_rad) or apart]
        outside = self._out_of_range(start, found.joints_rad)
        if outside is not None:
            return here, [outside]
        end = self._configuration(pose, found)
        hits = [
            self.barriers.hit(index, end.barriers[index], start.floor[index])
            for index in (end.barriers < start.floor).nonzero()[0].tolist()
        ]
        leaving = here.barriers[0] < 0 and end.barriers[0] > here.barriers[0]
        if not hits and not leaving:
            late = self._late(here, end, dt_s)
            if late is not None and late.value > late.limit / LEAST_NEAR_STOP:
                hits = [LimitHit(late.name, late.value, late.limit, where=late.where)]
        return end, hits

    def _approach(self, pose: Pose, start_rad: FloatArray) -> Approach:
        found = self._solver.approach(pose, start_rad, bounded=self._free_elbow)
        self.cost = max(1, found.effort // EFFORT)
        return found

    def _out_of_range(self, start: _Start, joints_rad: FloatArray) -> LimitHit | None:
        lower, upper = start.lower_rad, start.upper_rad
        excess = np.maximum(lower - joints_rad, joints_rad - upper)
        joint = int(excess.argmax())
        if excess[joint] <= 0:
            return None
        value = float(joints_rad[joint])
        bound = float(lower[joint] if value < lower[joint] else upper[joint])
        return LimitHit("joint_limit", value, bound, where=self.kinematics.arm_joints[joint])

    def _late(self, start: _Configuration, end: _Configuration, dt_s: float) -> Slowdown | None:
        """The slowdown of a step whose joints need longer than `dt_s`, None where they do not."""
        joint_s = np.abs(end.joints_rad - start.joints_rad) / self._velocity_rad_s
        joint = int(joint_s.argmax())
        needed_s = float(joint_s[joint])
        if needed_s <= dt_s:
            return None
        full_s = full_speed_s(self._limits, start.pose, end.pose)
        time_s = max(dt_s, full_s)
        if needed_s <= time_s:
            return None
        limit = float(self._velocity_rad_s[joint])
        return Slowdown(
            "joint_velocity",
            max(full_s / needed_s, LEAST_TO_GOAL),
            limit * needed_s / time_s,
            limit,
            self.kinematics.arm_joints[joint],
            needed_s - dt_s,
        )


def _same(a: Pose, b: Pose) -> bool:
    return a is b or (
        float(np.abs(a.position_m - b.position_m).max()) < SAME_POSE
        and float(np.abs(a.rotation - b.rotation).max()) < SAME_POSE
    )
