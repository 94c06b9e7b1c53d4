"""Contact: the external load on the arm, and whether it is too much.

A robot may measure the external wrench at its TCP (`PoseState.wrench`) and efforts of its joints
(`JointState.effort_nm`), which count only if they are external too. Each load is filtered, and its
bias removed::

    f' = (measured - f) / FILTER_S                  noise, and impacts that are over at once
    b' = (f - b) / DRIFT_S,  |b - b_0| <= slow      a load that was picked up, a sensor that drifts

with ``b_0`` the load at activation, at most ``slow``: a load in the gripper, a sensor that was not
zeroed. The value that counts is the norm of ``f - b``, for joints the greatest one. Above ``slow``
the arm has a share of its speed, ``(stop - |f - b|) / (stop - slow)``, above ``stop`` it must stop.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

from vla_zenoh.control.limits import SLOWEST, Slowdown
from vla_zenoh.profile import ContactLimits
from vla_zenoh.types import JointState, PoseState, Stamped

FILTER_S = 0.02
DRIFT_S = 10.0
LONGEST_S = 0.1
"""Longest time between two states that the filters integrate."""
QUIET = 0.2
"""Part of ``slow`` below which the arm is not in contact."""
STEPS = 10
"""Number of speed shares; each change of the share replans the motion."""


class ExternalLoad(NamedTuple):
    """An external load above its limit.

    Args:
        name: ``contact_force``, ``contact_torque`` or ``contact_effort``.
        value: in `unit`.
        limit: in `unit`.
        unit: N or Nm.
    """

    name: str
    value: float
    limit: float
    unit: str


class _LoadFilter:
    """One kind of load, filtered and without its bias."""

    def __init__(
        self,
        name: str,
        unit: str,
        slow: float | None,
        stop: float | None,
        apart: Callable[[Sequence[float], Sequence[float]], float],
    ) -> None:
        self.name, self.unit = name, unit
        self.stop = math.inf if stop is None else stop
        self.slow = self.stop if slow is None else slow
        self._apart = apart
        self.known = False
        self._filtered: list[float] = []
        self._bias: list[float] = []
        self._start_bias: list[float] = []
        self.value = 0.0
        """The size of the load, in N or Nm."""

    def update(self, measured: Sequence[float], dt_s: float, *, drifts: bool) -> None:
        """Add a measurement, `dt_s` after the last one; `drifts`: let the bias follow."""
        if not self.known or len(measured) != len(self._filtered):
            self._filtered, self.known = list(measured), True
            self._bias, self._start_bias = [0.0] * len(measured), [0.0] * len(measured)
        filtered, bias = self._filtered, self._bias
        share = -math.expm1(-dt_s / FILTER_S)
        for index, value in enumerate(measured):
            filtered[index] += share * (value - filtered[index])
        if drifts and dt_s > 0:
            drift = dt_s / DRIFT_S
            for index, value in enumerate(filtered):
                bias[index] += drift * (value - bias[index])
            if self._apart(bias, self._start_bias) > self.slow:
                self._bias = bias = self._near(bias, self._start_bias)
        self.value = self._apart(filtered, bias)

    def zero(self) -> None:
        """Take the present load for the bias, as far as `slow`."""
        self._start_bias = self._near(self._filtered, [0.0] * len(self._filtered))
        self._bias = self._start_bias.copy()
        self.value = self._apart(self._filtered, self._bias)

    def _near(self, values: list[float], middle: Sequence[float]) -> list[float]:
        apart = self._apart(values, middle)
        if apart <= self.slow:
            return values.copy()
        share = self.slow / max(apart, 1e-9)
        return [m + share * (v - m) for v, m in zip(values, middle, strict=True)]


def _greatest(values: Sequence[float], others: Sequence[float]) -> float:
    return max((abs(a - b) for a, b in zip(values, others, strict=True)), default=0.0)


class Contact:
    """The external load on the arm, as far as the robot measures it.

    Args:
        limits: slow and stop of each kind of load.
    """

    def __init__(self, limits: ContactLimits) -> None:
        self._force = _LoadFilter(
            "contact_force", "N", limits.force_slow_n, limits.force_stop_n, math.dist
        )
        self._torque = _LoadFilter(
            "contact_torque", "Nm", limits.torque_slow_nm, limits.torque_stop_nm, math.dist
        )
        self._effort = _LoadFilter(
            "contact_effort", "Nm", limits.effort_slow_nm, limits.effort_stop_nm, _greatest
        )
        self._all = (self._force, self._torque, self._effort)
        self._wants_effort = limits.effort_stop_nm is not None
        self._active = False
        self._kinds: list[_LoadFilter] = []
        """Those that the robot measures."""
        self._begun: list[_LoadFilter] = []
        self._pose_ns = self._joint_ns = 0

    # -- measurements -------------------------------------------------------------------------
    def update_pose(self, state: Stamped[PoseState]) -> None:
        """Add the newest pose, with the wrench if the robot measures one."""
        wrench = state.record.wrench
        if wrench is None:
            self._forget(self._force, self._torque)
            return
        load = wrench.tolist()
        dt_s = _passed_s(self._pose_ns, state.header.stamp_wall_ns)
        self._pose_ns = state.header.stamp_wall_ns
        self._force.update(load[:3], dt_s, drifts=self._active)
        self._torque.update(load[3:], dt_s, drifts=self._active)
        if self._force not in self._kinds:
            self._measures()

    def update_joints(self, state: Stamped[JointState]) -> None:
        """Add the newest joints; used if a limit of the profile says that efforts are external."""
        effort_nm = state.record.effort_nm
        if effort_nm is None:
            self._forget(self._effort)
        elif self._wants_effort:
            dt_s = _passed_s(self._joint_ns, state.header.stamp_wall_ns)
            self._joint_ns = state.header.stamp_wall_ns
            self._effort.update(effort_nm.tolist(), dt_s, drifts=self._active)
            if self._effort not in self._kinds:
                self._measures()

    def _forget(self, *kinds: _LoadFilter) -> None:
        if any(kind.known for kind in kinds):
            for kind in kinds:
                kind.known = False
            self._measures()

    def _measures(self) -> None:
        self._kinds = [kind for kind in self._all if kind.known]

    def begin(self) -> None:
        """Start an activation: the present load is not a contact."""
        self._active, self._begun = True, self._kinds
        for kind in self._kinds:
            kind.zero()

    def end(self) -> None:
        """End the activation: the bias follows the load no longer."""
        self._active = False

    # -- contact ------------------------------------------------------------------------------
    @property
    def known(self) -> bool:
        """The robot measures external loads."""
        return bool(self._kinds)

    @property
    def lost(self) -> str:
        """Which load the robot measured when the activation began and does not now."""
        for kind in self._begun:
            if not kind.known:
                return f"the robot no longer measures {kind.name}, which limits.contact needs"
        return ""

    @property
    def missing(self) -> list[str]:
        """Reasons against an activation: loads with a limit of the profile, not measured."""
        if not self._wants_effort or self._effort.known:
            return []
        return [
            "limits.contact.effort_stop_nm is set, and the robot reports no joint efforts; take "
            "the limit out, or let the robot report its external joint torques"
        ]

    @property
    def force_n(self) -> float | None:
        """External force, None where it is not measured."""
        return self._force.value if self._force.known else None

    @property
    def torque_nm(self) -> float | None:
        """External torque about the TCP, None where it is not measured."""
        return self._torque.value if self._torque.known else None

    @property
    def quiet(self) -> bool:
        """No contact, as far as the robot measures it."""
        return all(kind.value <= QUIET * kind.slow for kind in self._kinds)

    def overload(self) -> ExternalLoad | None:
        """The load above its stop limit, None without one."""
        for kind in self._kinds:
            value = kind.value
            if value > kind.stop:
                return ExternalLoad(kind.name, value, kind.stop, kind.unit)
        return None

    def slowdown(self) -> Slowdown | None:
        """The slowdown of the greatest load, None without one."""
        slowest: Slowdown | None = None
        for kind in self._kinds:
            value = kind.value
            if value <= kind.slow:
                continue
            left = max((kind.stop - value) / max(kind.stop - kind.slow, 1e-9), 0.0)
            share = max(math.ceil(left * STEPS) / STEPS, SLOWEST)
            if share < (slowest.share if slowest else 1.0):
                slowest = Slowdown(kind.name, share, value, kind.slow, "")
        return slowest


def _passed_s(before_ns: int, now_ns: int) -> float:
    return min(max((now_ns - before_ns) / 1e9, 0.0), LONGEST_S)
