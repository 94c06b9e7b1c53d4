"""Joint impedance control of an arm by joint torques.

Every joint behaves as if a damped spring connected it to a moving reference. With ``M`` the arm's
inertia::

    e    = q_ref - q                                    clamped to ``max_error_rad``
    D    = zeta (M^1/2 K^1/2 + K^1/2 M^1/2)
    I   += ki K e dt                                    clamped to ``max_integral_nm``
    tau  = M qdd_ref + K e + D (qd_ref - qd) + I + h

with ``h`` the bias of Coriolis, centrifugal and gravity torques. Inertia as feed-forward beside a
spring and a damper is the PD+ law of Paden and Panja (*Globally asymptotically stable 'PD+'
controller for robot manipulators*, Int. J. Control 47(6), 1988); the damping is the design by
square roots of Albu-Schaeffer, Ott, Frese and Hirzinger (*Cartesian impedance control of redundant
robots*, ICRA 2003), here in joint space. The stiffness is that of Franka's own example
(``joint_impedance_example_controller`` of franka_ros). The integral term carries joint friction and
payload that the model lacks.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from vla_zenoh.simulation.cartesian_impedance import ArmDynamics
from vla_zenoh.simulation.robot_model import JointGains
from vla_zenoh.types import FloatArray
from vla_zenoh.types.commands import JointReference


class JointImpedanceOutput(NamedTuple):
    """Result of one control period.

    Args:
        torque_nm: (n,) within the effort limits.
        error_rad: (n,) from joints to reference, before the clamp.
        saturated: an effort limit cut the torque.
    """

    torque_nm: FloatArray
    error_rad: FloatArray
    saturated: bool


class JointImpedance:
    """Joint impedance controller; its only state is the integral torque.

    Args:
        gains: stiffness, damping, bounds.
        effort_nm: (n,) torque limits.
        period_s: time between two calls of `torque`.
    """

    def __init__(self, gains: JointGains, *, effort_nm: FloatArray, period_s: float) -> None:
        self.gains = gains
        self._effort_nm = np.array(effort_nm, float)
        joints = len(self._effort_nm)
        self._stiffness = _per_joint(gains.stiffness_nm_rad, joints)
        # zeta * sqrt(K_j) scales the columns of M^1/2; its transpose gives the other half.
        self._damping_scale = gains.damping_ratio * np.sqrt(self._stiffness)
        self._integral_rate = gains.integral_1_s * period_s * self._stiffness
        self._integral_limit = _per_joint(gains.max_integral_nm, joints)
        self._integral = np.zeros(joints)

    @property
    def integral_nm(self) -> FloatArray:
        """(n,) torque of the integral action; a copy."""
        return self._integral.copy()

    def reset(self) -> None:
        """Clear the integral."""
        self._integral = np.zeros_like(self._integral)

    def take_over(self, torque_nm: FloatArray, state: ArmDynamics) -> None:
        """Take over from another law that held the arm at rest with `torque_nm` (n,).

        The part of that torque beyond the model (friction, payload) goes into the integral, so that
        the first torque of this law equals the last of the other.
        """
        self._integral = self._bounded(torque_nm - state.bias_nm)

    def torque(self, reference: JointReference, state: ArmDynamics) -> JointImpedanceOutput:
        """One control period: joint torques that pull the arm to `reference`."""
        error = reference.position_rad - state.position_rad
        stretch = np.abs(error) / self.gains.max_error_rad
        spring_error = error / np.maximum(stretch, 1.0)
        # A reference that moves on while the arm is blocked would push by its velocity alone,
        # so the feed-forward fades over the second half of the allowed error.
        feed = min(1.0, max(0.0, 2.0 - 2.0 * float(stretch.max())))

        inertias, axes = np.linalg.eigh(state.inertia)
        half_damping = ((axes * np.sqrt(inertias)) @ axes.T) * self._damping_scale
        slip = feed * reference.velocity_rad_s - state.velocity_rad_s
        wanted = (
            state.inertia @ (feed * reference.acceleration_rad_s2)
            + self._stiffness * spring_error
            + half_damping @ slip
            + half_damping.T @ slip
            + self._integral
            + state.bias_nm
        )
        torque = np.minimum(np.maximum(wanted, -self._effort_nm), self._effort_nm)
        cut = torque != wanted
        self._integrate(spring_error, held=cut | (stretch >= 1.0))
        return JointImpedanceOutput(torque, error, bool(cut.any()))

    def _integrate(self, error: FloatArray, held: NDArray[np.bool_]) -> None:
        """Integrate; towards zero only at joints that are blocked or at their torque limit."""
        step = self._integral_rate * error
        step[held & (step * self._integral >= 0.0)] = 0.0
        self._integral = self._bounded(self._integral + step)

    def _bounded(self, torque_nm: FloatArray) -> FloatArray:
        return np.minimum(np.maximum(torque_nm, -self._integral_limit), self._integral_limit)


def _per_joint(values: tuple[float, ...], joints: int) -> FloatArray:
    return np.array([values[min(joint, len(values) - 1)] for joint in range(joints)])
