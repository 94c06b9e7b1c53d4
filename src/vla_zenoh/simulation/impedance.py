"""Impedance control of an arm by joint torques: a damped spring pulls it to a moving reference.

`CartesianImpedance` pulls the TCP. With ``Lambda`` its inertia in task space and ``J`` its
Jacobian::

    e       = [p_ref - p ; log3(R_ref R^T)]            base frame, clamped to ``max_error_*``
    Lambda  = (J M^-1 J^T)^-1
    D       = zeta (Lambda^1/2 K^1/2 + K^1/2 Lambda^1/2)
    I      += ki K e dt                                 clamped to ``max_integral_*``
    F       = K e + D (xd_ref - J qd) + Lambda (xdd_ref - Jd qd) + I
    Jbar    = M^-1 J^T Lambda                           dynamically consistent inverse
    tau     = J^T F + (1 - J^T Jbar^T) tau_posture + h

with ``h`` the bias of Coriolis, centrifugal and gravity torques. The formulation in task space
and the dynamically consistent nullspace are Khatib's (*A unified approach for motion and force
control of robot manipulators: the operational space formulation*, IEEE J. Robotics and Automation
3(1), 1987). The damping is the factorisation design of Albu-Schaeffer, Ott, Frese and Hirzinger
(*Cartesian impedance control of redundant robots*, ICRA 2003; Ott, *Cartesian Impedance Control of
Redundant and Flexible-Joint Robots*, Springer 2008), which keeps the damping ratio in every pose;
a constant matrix does not.

The torque stands for a period ``T``, which a damped spring bears up to ``w T`` of about 1, with
``w^2`` the greatest eigenvalue of ``K^1/2 Lambda^-1 K^1/2``. A light arm is pulled by a softer
spring: K and ki K times ``min(1, (MAX_PHASE / (w T))^2)``.

`JointImpedance` pulls every joint. With ``M`` the arm's inertia::

    e    = q_ref - q                                    clamped to ``max_error_rad``
    D    = zeta (M^1/2 K^1/2 + K^1/2 M^1/2)
    tau  = M qdd_ref + K e + D (qd_ref - qd) + I + h

Inertia as feed-forward beside a spring and a damper is the PD+ law of Paden and Panja (*Globally
asymptotically stable 'PD+' controller for robot manipulators*, Int. J. Control 47(6), 1988). The
stiffness is that of Franka's own example (``joint_impedance_example_controller`` of franka_ros).

The integral term of either law carries joint friction and payload that the model lacks.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from vla_zenoh.policy.meaning import nearest_turn
from vla_zenoh.simulation.robot_model import JointGains
from vla_zenoh.types import FloatArray, JointReference, PoseReference

MIN_MOBILITY = 0.01
"""Task-space mobility (1/kg or 1/(kg m^2)) below which a direction counts as singular: its apparent
inertia grows without bound, and so would damping and feed-forward."""
MAX_PHASE = 0.6
"""Greatest phase in rad by which the arm swings on its spring in a control period."""
SAME_RAD = 1e-4
"""Joints that moved by less than this have the same inertia in task space and damping."""


class ArmDynamics(NamedTuple):
    """State and dynamics of an arm of n joints, input of an impedance law; in the base frame."""

    position_rad: FloatArray  # (n,)
    velocity_rad_s: FloatArray  # (n,)
    tcp_position_m: FloatArray  # (3,)
    tcp_rotation: FloatArray  # (3, 3)
    jacobian: FloatArray  # (6, n) of the TCP, linear rows first, base axes
    drift: FloatArray  # (6,) m/s^2 and rad/s^2: Jd qd, the TCP's acceleration at constant qd
    inertia: FloatArray  # (n, n) joint-space inertia, kg m^2
    bias_nm: FloatArray  # (n,) Coriolis, centrifugal and gravity torques


class _TaskSpace(NamedTuple):
    """Lambda, D (6, 6) and the transposed Jbar (6, n) of an arm with its joints at `at_rad`.

    `stiffness` is the share of K in use, for a control period of `period_s`.
    """

    at_rad: FloatArray
    period_s: float
    stiffness: float
    inertia: FloatArray
    damping: FloatArray
    consistent: FloatArray


class ImpedanceOutput(NamedTuple):
    """Result of one control period."""

    torque_nm: FloatArray  # (n,) within the effort limits
    saturated: bool  # an effort limit cut the torque
    error: FloatArray  # before the clamp: of the TCP (6,) in m and rad, or of joints (n,) in rad
    wrench: FloatArray | None = None  # (6,) N and Nm of the TCP; None in joint control


@dataclass(frozen=True, slots=True)
class ImpedanceGains:
    """Gains of the law: by default it follows within a millimetre, and presses with at most 55 N.

    The largest stretch of the spring, `max_error_*`, bounds the pressing force.
    """

    translational_n_m: float = 2000.0  # stiffness
    rotational_nm_rad: float = 120.0
    damping_ratio: float = 1.0  # zeta, 1 is critical
    integral_1_s: float = 4.0  # ki, 0 switches integral action off
    max_integral_n: float = 15.0  # per axis
    max_integral_nm: float = 3.0
    max_error_m: float = 0.02
    max_error_rad: float = 0.2
    posture_nm_rad: float = 20.0  # nullspace stiffness towards the posture
    limit_nm_rad: float = 30.0  # stiffness with which the nullspace leaves a joint limit
    limit_margin_rad: float = 0.1  # distance to a joint limit at which that begins


class _Impedance:
    """What both laws have: torque limits, and integral action clamped to `limit`.

    `rate` is ki K; `integral` the torque (n,) in Nm, or the wrench (6,) in N and Nm.
    """

    def __init__(
        self, effort_nm: FloatArray, rate: FloatArray, limit: FloatArray, period_s: float
    ) -> None:
        self._effort_nm = np.array(effort_nm, float)
        self._rate, self._limit, self._period_s = rate, limit, period_s
        self.integral = np.zeros(len(limit))

    def set_period(self, period_s: float) -> None:
        """Let the torque of the next call last `period_s`."""
        self._period_s = period_s

    def _integrate(self, error: FloatArray, held: bool | NDArray[np.bool_]) -> None:
        """Integrate; where `held`, towards zero only: the arm is blocked, or a torque is cut."""
        step = self._rate * self._period_s * error
        if held is not False:
            step[held & ~(step * self.integral < 0.0)] = 0.0  # NaN as well
        self.integral = _bounded(self.integral + step, self._limit)


def _bounded(values: FloatArray, limit: FloatArray) -> FloatArray:
    return np.minimum(np.maximum(values, -limit), limit)  # faster than np.clip


class CartesianImpedance(_Impedance):
    """Cartesian impedance controller; its only state is the integral wrench.

    Limits and `posture_rad`, which the nullspace prefers, are (n,); `period_s` is the time between
    two calls of `torque`.
    """

    def __init__(
        self,
        gains: ImpedanceGains,
        *,
        lower_rad: FloatArray,
        upper_rad: FloatArray,
        effort_nm: FloatArray,
        posture_rad: FloatArray,
        period_s: float,
    ) -> None:
        self.gains = gains
        self._soft_lower_rad = np.asarray(lower_rad, float) + gains.limit_margin_rad
        self._soft_upper_rad = np.asarray(upper_rad, float) - gains.limit_margin_rad
        self._endless = np.isinf(self._soft_upper_rad)
        self._posture_rad = np.array(posture_rad, float)
        self._posture_damping = 2.0 * math.sqrt(gains.posture_nm_rad)
        self._stiffness = np.repeat([gains.translational_n_m, gains.rotational_nm_rad], 3)
        # zeta * sqrt(K_j) scales the columns of Lambda^1/2; its transpose gives the other half.
        self._damping_scale = gains.damping_ratio * np.sqrt(self._stiffness)
        rate = gains.integral_1_s * self._stiffness
        most = np.repeat([gains.max_integral_n, gains.max_integral_nm], 3)
        super().__init__(effort_nm, rate, most, period_s)
        self._task_space: _TaskSpace | None = None

    def take_over(self, torque_nm: FloatArray, state: ArmDynamics) -> None:
        """Take over from another law that held the arm at rest with `torque_nm` (n,).

        The part of that torque beyond the model (friction, payload) goes into the integral, so that
        the first torque of this law equals the last of the other at the TCP.
        """
        beyond = self._seen(state).consistent @ (torque_nm - state.bias_nm)
        self.integral = _bounded(beyond, self._limit)
        self._posture_rad = state.position_rad.copy()

    def torque(self, reference: PoseReference, state: ArmDynamics) -> ImpedanceOutput:
        """One control period: joint torques that pull the TCP to `reference`."""
        jacobian, transposed = state.jacobian, state.jacobian.T
        error = np.empty(6)
        error[:3] = reference.position_m - state.tcp_position_m
        error[3:] = pin.log3(reference.rotation @ state.tcp_rotation.T)
        spring_error, feed = self._clamp(error)

        _, _, share, inertia, damping, consistent = self._seen(state)
        slip = feed * reference.twist - jacobian @ state.velocity_rad_s
        wrench = share * self._stiffness * spring_error + damping @ slip + self.integral
        wrench += inertia @ (feed * reference.acceleration - state.drift)
        posture = self._posture_torque(state)
        wanted = transposed @ (wrench - consistent @ posture) + posture + state.bias_nm
        torque = _bounded(wanted, self._effort_nm)
        saturated = bool((torque != wanted).any())
        self._integrate(share * spring_error, saturated or feed <= 0.0)
        return ImpedanceOutput(torque, saturated, error, wrench)

    def _seen(self, state: ArmDynamics) -> _TaskSpace:
        """The arm in task space; kept while the joints stay where they are."""
        known, position_rad, period_s = self._task_space, state.position_rad, self._period_s
        if (
            known is not None
            and known.period_s == period_s
            and float(np.abs(position_rad - known.at_rad).max()) < SAME_RAD
        ):
            return known
        compliance = np.linalg.solve(state.inertia, state.jacobian.T)  # M^-1 J^T, (n, 6)
        mobilities = state.jacobian @ compliance
        mobility, axes = np.linalg.eigh(mobilities)
        mobility = np.maximum(mobility, MIN_MOBILITY)
        inertia = (axes / mobility) @ axes.T
        share = self._bearable(mobilities)
        half = ((axes / np.sqrt(mobility)) @ axes.T) * (math.sqrt(share) * self._damping_scale)
        known = _TaskSpace(
            position_rad.copy(), period_s, share, inertia, half + half.T, inertia @ compliance.T
        )
        self._task_space = known
        return known

    def _bearable(self, mobilities: FloatArray) -> float:
        """The share of K, 0 to 1, that an arm of these mobilities (6, 6) bears for a period."""
        root = np.sqrt(self._stiffness)
        fastest = float(np.linalg.eigvalsh(root[:, None] * mobilities * root)[-1])
        return min(1.0, (MAX_PHASE / self._period_s) ** 2 / max(fastest, 1e-12))

    def _clamp(self, error: FloatArray) -> tuple[FloatArray, float]:
        """Bounded stretch of the spring, and the share of the feed-forward that remains, 1 to 0.

        A reference that moves on while the arm is blocked would push by its velocity alone,
        so the feed-forward fades over the second half of the allowed error.
        """
        x, y, z, a, b, c = error.tolist()
        distance, angle = math.hypot(x, y, z), math.hypot(a, b, c)
        stretch = max(distance / self.gains.max_error_m, angle / self.gains.max_error_rad)
        if stretch <= 0.5:
            return error, 1.0
        clamped = error.copy()
        clamped[:3] *= min(1.0, self.gains.max_error_m / max(distance, 1e-12))
        clamped[3:] *= min(1.0, self.gains.max_error_rad / max(angle, 1e-12))
        return clamped, max(0.0, 2.0 - 2.0 * stretch)

    def _posture_torque(self, state: ArmDynamics) -> FloatArray:
        position = state.position_rad
        inside = np.minimum(np.maximum(position, self._soft_lower_rad), self._soft_upper_rad)
        posture_rad = self._posture_rad
        if self._endless.any():
            nearest_rad = nearest_turn(posture_rad, position)
            posture_rad = np.where(self._endless, nearest_rad, posture_rad)
        return (
            self.gains.posture_nm_rad * (posture_rad - position)
            - self._posture_damping * state.velocity_rad_s
            + self.gains.limit_nm_rad * (inside - position)
        )


class JointImpedance(_Impedance):
    """Joint impedance controller; its only state is the integral torque."""

    def __init__(self, gains: JointGains, *, effort_nm: FloatArray, period_s: float) -> None:
        self.gains = gains
        joints = len(effort_nm)
        self._stiffness = _per_joint(gains.stiffness_nm_rad, joints)
        # zeta * sqrt(K_j) scales the columns of M^1/2; its transpose gives the other half.
        self._damping_scale = gains.damping_ratio * np.sqrt(self._stiffness)
        rate = gains.integral_1_s * self._stiffness
        most = _per_joint(gains.max_integral_nm, joints)
        super().__init__(effort_nm, rate, most, period_s)

    def take_over(self, torque_nm: FloatArray, state: ArmDynamics) -> None:
        """Take over from the other law, see `CartesianImpedance.take_over`."""
        self.integral = _bounded(torque_nm - state.bias_nm, self._limit)

    def torque(self, reference: JointReference, state: ArmDynamics) -> ImpedanceOutput:
        """One control period: joint torques that pull the arm to `reference`."""
        error = reference.position_rad - state.position_rad
        stretch = np.abs(error) / self.gains.max_error_rad
        spring_error = error / np.maximum(stretch, 1.0)
        # As in Cartesian control the feed-forward fades while the arm is blocked.
        feed = min(1.0, max(0.0, 2.0 - 2.0 * float(stretch.max())))

        inertias, axes = np.linalg.eigh(state.inertia)
        half_damping = ((axes * np.sqrt(inertias)) @ axes.T) * self._damping_scale
        slip = feed * reference.velocity_rad_s - state.velocity_rad_s
        wanted = (
            state.inertia @ (feed * reference.acceleration_rad_s2)
            + self._stiffness * spring_error
            + half_damping @ slip
            + half_damping.T @ slip
            + self.integral
            + state.bias_nm
        )
        torque = _bounded(wanted, self._effort_nm)
        cut = torque != wanted
        self._integrate(spring_error, cut | (stretch >= 1.0))
        return ImpedanceOutput(torque, bool(cut.any()), error)


def _per_joint(values: tuple[float, ...], joints: int) -> FloatArray:
    return np.array([values[min(joint, len(values) - 1)] for joint in range(joints)])
