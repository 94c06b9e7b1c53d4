"""Reachability: steps are shortened to what the arm can do, by a kinematic model that moves ahead.

A step whose end has no joint solution, or comes too near to a singularity, to the arm itself or to
the table, is shortened to its feasible part; the rest of the step is dropped. Each barrier is a
number ``h`` that must not become negative: singular value or distance minus its stop. A step from
``h0`` must end with::

    h >= min(slow - stop, h0 / 2)     where h0 > 0: beyond `slow` it takes half of what is left,
    h >= h0                           where h0 <= 0: a violated barrier may only be left

which is a control barrier function in discrete time (Agrawal, Sreenath, "Discrete control barrier
functions for safety-critical control of discrete systems", RSS 2017) with a decay of one half.
A joint outside its range may only move inwards. The elbow of a redundant arm is where pose and
posture put it, as with a Cartesian controller, unless joints are commanded (`free_elbow`).

A step for which only the joints are too slow is kept with a slowdown, see
`vla_zenoh.control.limits`; it is shortened only if it would take more than ten times as long, for
then the joints jump to another solution.
"""

from __future__ import annotations

from collections.abc import Generator, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from vla_zenoh.control.barriers import Barriers, Margins
from vla_zenoh.control.limits import (
    LEAST,
    SLOWEST,
    BoundedStep,
    LimitHit,
    Slowdown,
    full_speed_s,
    joint_margins,
    slowest,
)
from vla_zenoh.errors import RecordError
from vla_zenoh.kinematics.kinematics import (
    TOLERANCE_M,
    Approach,
    InverseKinematics,
    Kinematics,
    make_kinematics,
    pose_error,
)
from vla_zenoh.kinematics.so3 import Pose, exp3, orthonormal
from vla_zenoh.profile import Limits, Profile
from vla_zenoh.types import FloatArray, HeldBox

HALVINGS = 4
REFINEMENTS = 4
SMALLEST_FRACTION = 1 / 128
"""A smaller part of a step counts as nothing."""
GUESS_SHORT = 0.95
"""Factor on a linear guess of the feasible part: most barriers are concave."""
SOLVER_ITERATIONS = 12
"""Steps are short and start near their end: a solver that needs more does not converge."""
EFFORT = 5
"""Iterations of the solver per evaluation; one with more counts as several."""
SAME_POSE = 1e-9
NEWTON_STEPS = 8


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
    """Bounds steps of the TCP by the kinematics of the arm. Independent of time.

    Args:
        kinematics: of the arm.
        joints_rad: (n,) of the robot at present.
        limits: stop and slow of the barriers, and the speed of the TCP at which a step is taken.
        free_elbow: a redundant arm may leave its posture where a joint meets its range.
        posture_rad: (n,) the posture that the robot's controller pulls a redundant arm to; None:
            the joints at the last `reset`.
        known_good_rad: configurations known to be free, besides `joints_rad`.
        velocity_rad_s: (n,) limits of the joints; None: those of the URDF.

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
        self._solver = InverseKinematics(
            kinematics,
            posture_rad,
            joint_margin_rad=joint_margins(limits.reach, kinematics),
            max_iterations=SOLVER_ITERATIONS,
        )
        self._follow_posture = posture_rad is None
        most = kinematics.velocity_rad_s
        self._velocity_rad_s = most if velocity_rad_s is None else np.minimum(velocity_rad_s, most)
        self.barriers = Barriers(kinematics, limits.reach, known_good_rad)
        self.reset(joints_rad)

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
        if self._follow_posture:
            self._solver.posture_rad = joints.copy()
        pose, jacobian = self.kinematics.pose_and_jacobian(joints)
        self._here = _Configuration(pose, joints, 0.0, self.barriers.at(joints, jacobian))
        self._measured_rad: FloatArray | None = None
        self.slowdown: Slowdown | None = None
        """Of the step bounded last."""
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
        return self._solver.solve(pose, joints_rad, bounded=False)

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
        return self.barriers.margins(self._here.joints_rad, self._here.barriers)

    def bound(
        self, before: Pose, asked: Pose, dt_s: float = 0.1, start_rad: FloatArray | None = None
    ) -> tuple[Pose, list[LimitHit]]:
        """`bound_in_pieces` at once: the end of the step, and the limits that acted."""
        pieces = self.bound_in_pieces(before, asked, dt_s, start_rad)
        while True:
            try:
                next(pieces)
            except StopIteration as end:
                return end.value[:2]

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
        floor = self.barriers.floor(here.barriers)
        if here.error > 0:  # an arm stretched towards a pose out of reach is singular
            floor[0] = -np.inf
        start = _Start(here, floor, *self._solver.bounds(here.joints_rad))
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
        self, start: _Start, end: _Configuration, pose: Pose, hits: list[LimitHit], dt_s: float
    ) -> BoundedStep:
        self._here = end
        self.slowdown = slowest(
            self.barriers.slowdown(start.here.barriers, end.barriers),
            self._late(start.here, end, dt_s),
        )
        return BoundedStep(pose, hits, end.joints_rad, self.slowdown)

    def _guess(self, start: _Start, end: _Configuration, hits: Sequence[LimitHit]) -> float:
        """First guess of the feasible part, from how the whole step failed."""
        here = start.here
        if end is here or here.error > 0 or here.barriers.min() <= 0:
            return 0.5
        if hits[0].name == "joint_velocity":
            return GUESS_SHORT * hits[0].limit / (SLOWEST * hits[0].value)
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
            if late is not None and late.value > late.limit / SLOWEST:
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
    """The pose after `fraction` of a step (6,) m and rad, on the line and the geodesic."""
    turned = exp3(fraction * step[3:]) @ before.rotation
    return Pose(before.position_m + fraction * step[:3], orthonormal(turned))


def make_reachability_filter(
    profile: Profile, kinematics: Kinematics | None = None
) -> ReachabilityFilter:
    """That of the profile's robot, at its home pose; it raises as `make_kinematics` does."""
    kinematics = kinematics or make_kinematics(profile)
    names = profile.robot.arm_joints
    home_rad = kinematics.ordered(names, profile.robot.home_rad)
    # Elbow and joint velocities are ours only where joints are commanded.
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
