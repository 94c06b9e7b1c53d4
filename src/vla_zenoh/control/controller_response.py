"""Response of a controller that covers only a part of each delta.

At every step such a controller sets its goal g on where the arm is, and the arm moves there as a
mass on a spring with a damper until the next step::

    g = x(0) + delta        x'' = kp (g - x) - 2 z w x',  w = sqrt(kp)

With ``e = x - g`` and ``s = w sqrt(z^2 - 1)``, imaginary below critical damping::

    e(t)  = exp(-z w t) (e(0) cosh(s t) + (e'(0) + z w e(0)) sinh(s t) / s)
    e'(t) = exp(-z w t) (e'(0) cosh(s t) - (z w e'(0) + w^2 e(0)) sinh(s t) / s)

Position and rate at the end of a step begin the next one, also across chunks: what a policy does to
the arm depends on its steps alone, not on how they are divided into chunks or how often it is
asked. The rotation vector of the turn since the step began takes the place of x for rotations.

Source: robosuite's operational space controller (``OSC_POSE``, the controller of LIBERO): kp 150,
damping ratio 1, 20 Hz. Its rotation error is ``sin(angle) axis``, and its orientation goal stays
where it is while the rotation numbers are all exactly zero.
"""

from __future__ import annotations

import cmath
import math
from dataclasses import dataclass, replace

import numpy as np

from vla_zenoh.kinematics.so3 import Pose, exp3, log3, norm3, orthonormal
from vla_zenoh.policy import ControllerSpec
from vla_zenoh.types import FloatArray

NO_CUT = 1e-9
"""A translation or rotation that is shortened by less counts as complete."""


@dataclass(frozen=True, slots=True, eq=False)
class Response:
    """State of a controller's response at the end of a step.

    Args:
        controller: its gains.
        rate: (6,) of the arm, m/s and rad/s in base axes.
        held: (3, 3) orientation goal.
        start_rate: (6,) of the arm when the step began.
        way: (6,) from there to the controller's goal, m and rad.
    """

    controller: ControllerSpec
    rate: FloatArray
    held: FloatArray
    start_rate: FloatArray
    way: FloatArray

    def stopped(self, asked: Pose, reached: Pose) -> Response:
        """The state where a limit ended the step at `reached`: nothing moves on into the limit."""
        cut_m = asked.position_m - reached.position_m
        cut_rad = log3(asked.rotation @ reached.rotation.T)
        rate = self.rate.copy()
        for part, cut in ((rate[:3], cut_m), (rate[3:], cut_rad)):
            length = norm3(cut)
            if length > NO_CUT:
                part -= max(float(part @ cut), 0.0) / length**2 * cut
        return replace(self, rate=rate)


def respond(
    controller: ControllerSpec,
    way_m: FloatArray,
    turn: FloatArray | None,
    dt_s: float,
    before: Pose,
    state: Response | None,
) -> tuple[Pose, Response]:
    """Where the arm is at the end of a step, and how it moves there.

    Args:
        controller: its gains.
        way_m: (3,) delta in base axes.
        turn: (3, 3) delta in base axes; None: the orientation goal stays.
        dt_s: duration of the step.
        before: where the step begins.
        state: at the end of the step before; None: at rest.
    """
    rate = np.zeros(6) if state is None else state.rate
    if turn is not None:
        held = orthonormal(turn @ before.rotation)
    else:
        held = before.rotation if state is None else state.held
    error = log3(held @ before.rotation.T)
    angle = norm3(error)
    if angle > 0.0:
        error = math.sin(angle) / angle * error
    way = np.concatenate([way_m, error])
    moved, reached = _motion(controller, rate, way, dt_s)
    return _after(before, moved), Response(controller, reached, held, rate, way)


def between(
    before: Pose, after: Pose, state: Response, dt_s: float, share: float
) -> tuple[Pose, Response]:
    """Pose and state at `share` (0 to 1) of a step.

    Args:
        before: where the step begins.
        after: where it ends; what a limit cut off is cut off evenly.
        state: at its end.
        dt_s: its duration.
        share: of it that has passed.
    """
    whole, whole_rate = _motion(state.controller, state.start_rate, state.way, dt_s)
    moved, rate = _motion(state.controller, state.start_rate, state.way, share * dt_s)
    end, here = _after(before, whole), _after(before, moved)
    left = log3(after.rotation @ end.rotation.T)
    pose = Pose(
        here.position_m + share * (after.position_m - end.position_m),
        orthonormal(exp3(share * left) @ here.rotation),
    )
    return pose, replace(state, rate=rate + share * (state.rate - whole_rate))


def _motion(
    controller: ControllerSpec, rate: FloatArray, way: FloatArray, t_s: float
) -> tuple[FloatArray, FloatArray]:
    """Displacement and rate (6,) after `t_s`."""
    w, zw = math.sqrt(controller.kp), controller.damping_ratio * math.sqrt(controller.kp)
    s = cmath.sqrt(zw * zw - w * w)
    # exp(-z w t) cosh(s t) and exp(-z w t) sinh(s t) / s, without the overflow of a large s t.
    slow, fast = cmath.exp((s - zw) * t_s), cmath.exp(-(s + zw) * t_s)
    cosh = (slow + fast).real / 2
    if abs(s) * t_s < 1e-3:
        sinh = math.exp(-zw * t_s) * t_s * (1 + (s * t_s) ** 2 / 6).real
    else:
        sinh = ((slow - fast) / (2 * s)).real
    moved = way - way * cosh + (rate - zw * way) * sinh
    return moved, rate * cosh - (zw * rate - w * w * way) * sinh


def _after(before: Pose, moved: FloatArray) -> Pose:
    turned = orthonormal(exp3(moved[3:]) @ before.rotation)
    return Pose(before.position_m + moved[:3], turned)
