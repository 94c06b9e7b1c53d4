"""What the arm can do: a kinematic shadow of the robot walks ahead of every goal.

A step whose end has no joint solution, or comes too near to a singularity, to the arm itself or to
the table, is shortened to the part of it that is feasible; the rest of the step is not remembered.
Each barrier is a number ``h`` that must not become negative: singular value or distance minus its
stop. A step from ``h0`` must end with::

    h >= min(slow - stop, h0 / 2)     where h0 > 0: beyond `slow` it takes half of what is left,
    h >= h0                           where h0 <= 0: a violated barrier may only be left

which is a control barrier function in discrete time (Agrawal, Sreenath, "Discrete control barrier
functions for safety-critical control of discrete systems", RSS 2017) with a decay of one half.
A joint outside of its range may only move inwards. The elbow of a redundant arm is where pose and
posture put it, because that is what a Cartesian controller does with it: a solution that would need
the elbow to swing aside is none. `free_elbow` is for arms whose joints are commanded.

A step for which the joints alone are too slow is kept and told to be taken slower, see
`vla_zenoh.control.limits`; only where that would take more than ten times as long it is
shortened: such joints leap to another solution.
"""

from __future__ import annotations

from collections.abc import Generator, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from vla_zenoh.control.barriers import Barriers, Margins
from vla_zenoh.control.limits import LEAST, SLOWEST, LimitHit, Slowdown, full_speed_s
from vla_zenoh.errors import RecordError
from vla_zenoh.kinematics.ik import Approach, IkSettings, InverseKinematics, pose_error
from vla_zenoh.kinematics.kinematics import Kinematics, make_kinematics
from vla_zenoh.kinematics.so3 import Pose, exp3, orthonormal
from vla_zenoh.profile import Limits, Profile
from vla_zenoh.types import FloatArray

HALVINGS = 4
REFINEMENTS = 4
SMALLEST_FRACTION = 1 / 128
"""Less than this of a step is nothing."""
GUESS_SHORT = 0.95
"""A linear guess of the feasible part is taken a little shorter: most barriers bend downwards."""
SOLVER_ITERATIONS = 12
"""Steps are short and the start is near: who has not arrived by then will not."""
EFFORT = 5
"""Iterations of the solver that an evaluation may have; with more it counts as several."""
SAME_POSE = 1e-9


class Bounded(NamedTuple):
    """What became of a step.

    Args:
        pose: where it ends: the pose asked for itself where nothing acted, that from where it began
            where nothing is left of it.
        hits: what acted.
        joints_rad: (n,) of the shadow there.
        slowdown: why it is to be taken slower than at full speed.
    """

    pose: Pose
    hits: list[LimitHit]
    joints_rad: FloatArray
    slowdown: Slowdown | None


class _Stand(NamedTuple):
    """The shadow in one place: `pose` was asked for, `barriers` are those at `joints_rad`."""

    pose: Pose
    joints_rad: FloatArray
    error: float
    barriers: FloatArray


class _Start(NamedTuple):
    """Where a step begins, and what its end must keep: barriers, and joints' ranges."""

    here: _Stand
    floor: FloatArray
    lower_rad: FloatArray
    upper_rad: FloatArray


class ReachabilityFilter:
    """See the module. Not a moment of time in it: the same questions get the same answers.

    Args:
        kinematics: of the arm.
        joints_rad: (n,) where the robot stands.
        limits: how near it may come to what, and how fast its TCP may be: a step takes at least
            as long as that.
        free_elbow: a redundant arm may leave its posture where a joint meets its range.
        posture_rad: (n,) what the robot's controller pulls a redundant arm to; None: where the
            robot stood at the last `reset`.
        known_good_rad: configurations known to be free, besides `joints_rad`.
        velocity_rad_s: (n,) how fast the joints may be; None: as the description has it.

    Raises:
        RecordError: joints of the wrong number.
        ResourceError: the URDF's collision shapes cannot be loaded.
    """

    def __init__(
        self,
        kinematics: Kinematics,
        joints_rad: ArrayLike,
        limits: Limits | None = None,
        *,
        free_elbow: bool = False,
        posture_rad: ArrayLike | None = None,
        known_good_rad: Sequence[FloatArray] = (),
        velocity_rad_s: FloatArray | None = None,
    ) -> None:
        self.kinematics = kinematics
        self._limits = limits = limits or Limits()
        self._free_elbow = free_elbow
        settings = IkSettings(
            joint_margin_rad=limits.reach.joint_margin_rad, max_iterations=SOLVER_ITERATIONS
        )
        self._solver = InverseKinematics(kinematics, posture_rad, settings)
        self._follow_posture = posture_rad is None
        most = kinematics.velocity_rad_s
        self._velocity_rad_s = most if velocity_rad_s is None else np.minimum(velocity_rad_s, most)
        self.barriers = Barriers(kinematics, limits.reach, known_good_rad)
        self.reset(joints_rad)

    def reset(self, joints_rad: ArrayLike) -> None:
        """The robot is here: stand where it stands.

        Raises:
            RecordError: not one finite number per arm joint.
        """
        joints = np.array(joints_rad, dtype=np.float64)
        if joints.shape != (self.kinematics.size,) or not np.isfinite(joints).all():
            raise RecordError(
                f"joints_rad must be {self.kinematics.size} finite numbers, got {joints!r}"
            )
        if self._follow_posture:
            self._solver.posture_rad = joints.copy()
        pose, jacobian = self.kinematics.pose_and_jacobian(joints)
        self._here = _Stand(pose, joints, 0.0, self.barriers.at(joints, jacobian))
        self._seat_rad: FloatArray | None = None
        self.slowdown: Slowdown | None = None
        """Why the step bounded last is to be taken slower than at full speed."""
        self.cost = 1
        """For how many the last evaluation counts."""

    def reseat(self, joints_rad: FloatArray) -> None:
        """The arm itself has these joints (n,): the next step begins with its elbow."""
        self._seat_rad = joints_rad

    def followed(self, pose: Pose, joints_rad: FloatArray) -> FloatArray | None:
        """Joints (n,) of an arm that went there from these (n,), None where it has none."""
        found = self._solver.approach(pose, joints_rad, bounded=False)
        return found.joints_rad if found.solved else None

    @property
    def joints_rad(self) -> FloatArray:
        """(n,) of the shadow: those of the last bounded pose."""
        return self._here.joints_rad.copy()

    @property
    def margins(self) -> Margins:
        """Room left where the shadow stands."""
        return self.barriers.margins(self._here.joints_rad, self._here.barriers)

    def bound(
        self,
        before: Pose,
        asked: Pose,
        dt_s: float = 0.1,
        start_rad: FloatArray | None = None,
    ) -> tuple[Pose, list[LimitHit]]:
        """`bounding` at once: where the step ends, and what acted."""
        pieces = self.bounding(before, asked, dt_s, start_rad)
        while True:
            try:
                next(pieces)
            except StopIteration as end:
                return end.value.pose, end.value.hits

    def bounding(
        self, before: Pose, asked: Pose, dt_s: float, start_rad: FloatArray | None = None
    ) -> Generator[None, None, Bounded]:
        """The furthest pose on the way from `before` to `asked` that the arm can take, in pieces.

        It stops before every evaluation (joints for a pose, and how near that is to what): what
        one costs is known, see `cost`, and how many there are is not, some 10 where a limit cuts.

        Args:
            before: where the step starts, usually the pose bounded last.
            asked: where it is to end.
            dt_s: time the step has.
            start_rad: joints at `before`, where known; None: near those of the last bounded pose.

        Returns:
            what became of it. The shadow stands there afterwards.
        """
        here = self._here
        stands = start_rad is None or np.array_equal(start_rad, here.joints_rad)
        if self._seat_rad is not None or not stands or not _same(before, here.pose):
            yield
            here = self._stand_at(before, here.joints_rad if start_rad is None else start_rad)
        start = _Start(here, self._floor(here), *self._solver.bounds(here.joints_rad))
        yield
        end, hits = self._try(start, asked, dt_s)
        if not hits:
            return self._settle(start, end, asked, hits, dt_s)
        step = pose_error(asked, before)
        best, low, high = here, 0.0, 1.0
        fraction = self._guess(start, end, hits)
        for _ in range(HALVINGS):
            if fraction < SMALLEST_FRACTION:
                break
            yield
            end, found = self._try(start, _part(before, step, fraction), dt_s)
            if not found:
                best, low = end, fraction
                break
            high, hits, fraction = fraction, found, fraction / 2
        if low > 0.0:
            for _ in range(REFINEMENTS):
                fraction = 0.5 * (low + high)
                yield
                end, found = self._try(start, _part(before, step, fraction), dt_s)
                if found:
                    high, hits = fraction, found
                else:
                    best, low = end, fraction
        return self._settle(start, best, best.pose if low > 0.0 else before, hits, dt_s)

    def _settle(
        self, start: _Start, end: _Stand, pose: Pose, hits: list[LimitHit], dt_s: float
    ) -> Bounded:
        self._here = end
        slower = self.barriers.slowdown(start.here.barriers, end.barriers)
        late = self._late(start.here, end, dt_s)
        if slower is None or (late is not None and late.share < slower.share):
            slower = late
        self.slowdown = slower
        return Bounded(pose, hits, end.joints_rad, slower)

    def _guess(self, start: _Start, end: _Stand, hits: Sequence[LimitHit]) -> float:
        """Where to begin to look for the feasible part, from how the whole step failed."""
        here = start.here
        if end is here or here.error > 0 or here.barriers.min() <= 0:
            return 0.5
        if hits[0].name == "joint_velocity":
            return GUESS_SHORT * hits[0].limit / (SLOWEST * hits[0].value)
        room = here.barriers - start.floor
        fall = np.maximum(here.barriers - end.barriers, 1e-12)
        return GUESS_SHORT * min(1.0, float((room / fall).min()))

    # -- one place ----------------------------------------------------------------------------
    def _stand_at(self, pose: Pose, start_rad: FloatArray) -> _Stand:
        seat_rad, self._seat_rad = self._seat_rad, None
        found = None if seat_rad is None else self._approach(pose, seat_rad)
        if found is None or not found.solved:
            found = self._approach(pose, start_rad)
        self._here = self._stand(pose, found)
        return self._here

    def _stand(self, pose: Pose, found: Approach) -> _Stand:
        error = 0.0 if found.solved else found.error_m + found.error_rad
        barriers = self.barriers.at(found.joints_rad, found.jacobian)
        return _Stand(pose, found.joints_rad, error, barriers)

    def _try(self, start: _Start, pose: Pose, dt_s: float) -> tuple[_Stand, list[LimitHit]]:
        """Where a step would lead, and what forbids it."""
        here = start.here
        found = self._approach(pose, here.joints_rad)
        # Where the start has no solution itself, coming nearer to having one is the way out.
        if not found.solved and found.error_m + found.error_rad >= here.error * (1 - 1e-6):
            return here, [self._out_of_range(start, found.wanted_rad) or self._out_of_reach(found)]
        outside = self._out_of_range(start, found.joints_rad)
        if outside is not None:
            return here, [outside]
        end = self._stand(pose, found)
        hits = [
            LimitHit(
                self.barriers.names[index],
                float(end.barriers[index] + self.barriers.stop[index]),
                float(start.floor[index] + self.barriers.stop[index]),
                where=self.barriers.where(index),
            )
            for index in (end.barriers < start.floor).nonzero()[0].tolist()
        ]
        leaving = here.barriers[0] < 0 and end.barriers[0] > here.barriers[0]
        if not hits and not leaving:
            late = self._late(here, end, dt_s)
            if late is not None and late.value > late.limit / SLOWEST:
                hits = [LimitHit(late.name, late.value, late.limit, where=late.where)]
        return end, hits

    def _floor(self, start: _Stand) -> FloatArray:
        """What the barriers may come down to in one step from there."""
        floor = self.barriers.floor(start.barriers)
        if start.error > 0:  # an arm that points to what it cannot reach is singular
            floor[0] = -np.inf
        return floor

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

    def _out_of_reach(self, found: Approach) -> LimitHit:
        tolerance = self._solver.settings.position_tolerance_m
        return LimitHit("reach", found.error_m + found.error_rad, tolerance)

    def _late(self, start: _Stand, end: _Stand, dt_s: float) -> Slowdown | None:
        """Why a step takes longer than the `dt_s` it has, where its joints are too slow for it."""
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
            max(full_s / needed_s, LEAST),
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


def _part(before: Pose, step: FloatArray, fraction: float) -> Pose:
    """`fraction` of a step (6,) m and rad on the straight line and the shortest turn."""
    turned = exp3(fraction * step[3:]) @ before.rotation
    return Pose(before.position_m + fraction * step[:3], orthonormal(turned))


def make_reachability_filter(
    profile: Profile, kinematics: Kinematics | None = None
) -> ReachabilityFilter:
    """The kinematic shadow that bounds goals, standing at home.

    Raises:
        ResourceError: description or collision shapes are not there.
        ProfileError: frames or joints that the description does not have.
    """
    kinematics = kinematics or make_kinematics(profile)
    names = profile.robot.arm_joints
    home_rad = kinematics.ordered(names, profile.robot.home_rad)
    # Its joints are ours to command, and to hold back, only where the profile says so.
    commanded = profile.robot.command == "joint"
    most_rad_s = profile.limits.joint.of("velocity_rad_s", len(names))
    return ReachabilityFilter(
        kinematics,
        home_rad,
        profile.limits,
        free_elbow=commanded,
        posture_rad=home_rad if profile.robot.posture == "home" else None,
        known_good_rad=[home_rad],
        velocity_rad_s=kinematics.ordered(names, most_rad_s) if commanded else None,
    )
