"""Joints for a pose: damped least squares that leaves a redundant arm in its posture.

One iteration, with e the pose error, z a step towards the posture and W the damping::

    e  = [p_goal - p ; log3(R_goal R^T)]          base frame
    W  = (|e|^2 / 2 + bias) 1
    dq = z + J^T (J J^T + W)^-1 (e - J z)

A damping that follows the error converges quadratically where there is a solution and stays calm
where there is none. A joint that would pass its bound is put on it and the others carry on without
it. Source: Sugihara, "Solvability-unconcerned inverse kinematics by the Levenberg-Marquardt
method", IEEE Trans. Robotics 27(5), 2011; here a metre weighs as much as a radian.
"""

from __future__ import annotations

import itertools
import math
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from vla_zenoh.errors import RecordError
from vla_zenoh.kinematics.kinematics import Kinematics
from vla_zenoh.kinematics.so3 import Pose, log3
from vla_zenoh.types import FloatArray

_IDENTITY_6 = np.eye(6)
HOLDING = 2
"""Iterations that a round costs in which joints are put on their bounds."""
TOLERANCE_M, TOLERANCE_RAD = 1e-6, 1e-6
"""A solution is at most this far off."""
POSTURE_GAIN = 0.1
"""Part of the way to the posture taken in a first iteration."""
MAX_POSTURE_STEP_RAD = 0.01
"""At most this far: the posture is approached slowly."""
DAMPING_BIAS = 1e-9
"""W of an error of zero."""
MAX_JOINT_STEP_RAD = 0.5
"""Of one iteration: a far pose is approached in several."""


class Approach(NamedTuple):
    """How near the arm came to a pose.

    Args:
        joints_rad: (n,).
        error_m: distance left.
        error_rad: the same for rotation.
        solved: within the tolerances.
        wanted_rad: (n,) the last iteration's joints before they were put on their bounds.
        jacobian: (6, n) at `joints_rad`.
        effort: what it took, in iterations: some 3, and many times that at the ends of ranges.
    """

    joints_rad: FloatArray
    error_m: float
    error_rad: float
    solved: bool
    wanted_rad: FloatArray
    jacobian: FloatArray
    effort: int


def pose_error(goal: Pose, here: Pose) -> FloatArray:
    """(6,) m and rad in the base frame, from `here` to `goal`."""
    error = np.empty(6)
    error[:3] = goal.position_m - here.position_m
    error[3:] = log3(goal.rotation @ here.rotation.T)
    return error


class InverseKinematics:
    """Damped least-squares inverse kinematics within joint limits.

    Args:
        kinematics: of the arm.
        posture_rad: (n,) where a redundant arm prefers to be; None: the middle of its ranges.
        joint_margin_rad: kept from both ends of every joint's range, one number or (n,).
        max_iterations: after which there is no solution.

    Raises:
        RecordError: the margin leaves a joint no range, or the posture has the wrong size.
    """

    def __init__(
        self,
        kinematics: Kinematics,
        posture_rad: ArrayLike | None = None,
        *,
        joint_margin_rad: float | FloatArray = 0.05,
        max_iterations: int = 40,
    ) -> None:
        self.kinematics, self._max_iterations = kinematics, max_iterations
        self.lower_rad = kinematics.lower_rad + joint_margin_rad
        self.upper_rad = kinematics.upper_rad - joint_margin_rad
        if np.any(self.lower_rad >= self.upper_rad):
            name = kinematics.arm_joints[int(np.argmin(self.upper_rad - self.lower_rad))]
            raise RecordError(f"joint_margin_rad {joint_margin_rad} leaves {name!r} no range")
        middle = 0.5 * (self.lower_rad + self.upper_rad)
        self.posture_rad = middle if posture_rad is None else np.array(posture_rad, dtype=float)
        if self.posture_rad.shape != (kinematics.size,):
            raise RecordError(
                f"posture_rad has shape {self.posture_rad.shape}, wanted ({kinematics.size},)"
            )

    def solve(
        self, pose: Pose, start_rad: FloatArray, *, bounded: bool = True
    ) -> FloatArray | None:
        """Joints (n,) that put the TCP there, near `start_rad`; None where there are none.

        The search is local: a pose that needs several joints on the very ends of their ranges, or
        the arm in another branch than at the start, may be missed. `bounded`: see `approach`.
        """
        found = self.approach(pose, start_rad, bounded=bounded)
        return found.joints_rad if found.solved else None

    def approach(self, pose: Pose, start_rad: FloatArray, *, bounded: bool = True) -> Approach:
        """Like `solve`, and how near it came where there is no solution.

        `bounded` keeps every joint within its bounds, the other joints taking over; else pose and
        posture alone decide where the joints go.
        """
        lower, upper = self.bounds(start_rad)
        joints = wanted = start_rad
        last, stalls, effort = math.inf, 0, 0
        for iteration in range(self._max_iterations + 1):
            here, jacobian = self.kinematics.pose_and_jacobian(joints)
            error = pose_error(pose, here)
            x, y, z, rx, ry, rz = error.tolist()
            error_m, error_rad = math.hypot(x, y, z), math.hypot(rx, ry, rz)
            squared = error_m * error_m + error_rad * error_rad
            solved = error_m <= TOLERANCE_M and error_rad <= TOLERANCE_RAD
            # At a bound or out of reach the error shrinks by ever less: three rounds are proof.
            stalls = stalls + 1 if squared > 0.8 * last and iteration > 2 else 0
            if solved or stalls == 3 or iteration == self._max_iterations:
                effort += iteration
                return Approach(joints, error_m, error_rad, solved, wanted, jacobian, effort)
            last = squared
            # After the first iteration the pose alone decides.
            drift = self._drift(joints) if iteration == 0 else None
            step = self._step(error, jacobian, drift, 0.5 * squared + DAMPING_BIAS)
            largest = max(map(abs, step.tolist()))
            if largest > MAX_JOINT_STEP_RAD:
                step *= MAX_JOINT_STEP_RAD / largest
            wanted = joints + step
            if bounded:
                joints, rounds = self._inside(
                    wanted, joints, error, jacobian, drift, squared, lower, upper
                )
                effort += HOLDING * rounds
            else:
                joints = wanted
        raise AssertionError("the last iteration returns")

    def bounds(self, start_rad: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Least and greatest joints (n,): no joint goes further out than it was."""
        return np.minimum(self.lower_rad, start_rad), np.maximum(self.upper_rad, start_rad)

    def _drift(self, joints: FloatArray) -> FloatArray:
        """(n,) the step towards the posture."""
        drift = POSTURE_GAIN * (self.posture_rad - joints)
        farthest = max(map(abs, drift.tolist()))
        if farthest > MAX_POSTURE_STEP_RAD:
            drift *= MAX_POSTURE_STEP_RAD / farthest
        return drift

    @staticmethod
    def _step(
        error: FloatArray, jacobian: FloatArray, drift: FloatArray | None, damping: float
    ) -> FloatArray:
        left = jacobian @ jacobian.T + damping * _IDENTITY_6
        if drift is None:
            return jacobian.T @ np.linalg.solve(left, error)
        return drift + jacobian.T @ np.linalg.solve(left, error - jacobian @ drift)

    def _inside(
        self,
        wanted: FloatArray,
        joints: FloatArray,
        error: FloatArray,
        jacobian: FloatArray,
        drift: FloatArray | None,
        squared: float,
        lower: FloatArray,
        upper: FloatArray,
    ) -> tuple[FloatArray, int]:
        """`wanted`, or the best step of the other joints once those past a bound stand on it.

        And in how many rounds.
        """
        if ((wanted >= lower) & (wanted <= upper)).all():
            return wanted, 0
        held = np.zeros(len(joints), dtype=bool)
        step = wanted - joints
        for rounds in itertools.count(1):
            wanted = joints + step
            past = ~held & ((wanted < lower) | (wanted > upper))
            if not past.any():
                return np.clip(wanted, lower, upper), rounds
            held |= past
            if held.sum() > len(joints) - 1:
                return np.clip(wanted, lower, upper), rounds
            onto = np.where(held, np.clip(wanted, lower, upper) - joints, 0.0)
            free = np.where(held, 0.0, jacobian)
            damping = 0.5 * squared + DAMPING_BIAS + 1e-6
            aside = None if drift is None else np.where(held, 0.0, drift)
            step = onto + self._step(error - jacobian @ onto, free, aside, damping)
        raise AssertionError("there are no more joints to hold")
