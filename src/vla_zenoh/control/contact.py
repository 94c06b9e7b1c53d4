"""What presses against the arm, and whether it is too much.

A robot may tell the external wrench at its TCP (`PoseState.wrench`), and efforts of its joints
(`JointState.effort_nm`), which are of use here where they are external too. Each kind is filtered::

    f' = (told - f) / FILTER_S                      noise, and blows that are over at once
    b' = (f - b) / DRIFT_S,  |b - b_0| <= slow      a load that was taken up, a sensor that drifts

with ``b_0`` what was felt when the arm was activated, ``slow`` of that at most: a load in the
gripper, a sensor that was not zeroed. What counts is the length of ``f - b``, of joints the
greatest. Above ``slow`` the arm has a share of its speed, ``(stop - |f - b|) / (stop - slow)``,
above ``stop`` it must stop.
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
"""A state that comes later than that after the one before does not say what was in between."""
QUIET = 0.2
"""Part of ``slow`` below which nothing presses."""
STEPS = 10
"""The speed has so many shares: each change of it plans the motion anew."""


class ExternalLoad(NamedTuple):
    """More than may press against the arm.

    Args:
        name: ``contact_force``, ``contact_torque`` or ``contact_effort``.
        value: N or Nm.
        limit: likewise.
        unit: of both.
    """

    name: str
    value: float
    limit: float
    unit: str


class _Felt:
    """One kind of it, filtered."""

    def __init__(
        self,
        name: str,
        unit: str,
        slow: float | None,
        stop: float | None,
        size: Callable[[Sequence[float]], float],
    ) -> None:
        self.name, self.unit = name, unit
        self.stop = math.inf if stop is None else stop
        self.slow = self.stop if slow is None else slow
        self._size = size
        self.known = False
        self._now: list[float] = []
        self._bias: list[float] = []
        self._began: list[float] = []

    def take(self, told: Sequence[float], dt_s: float, *, drifts: bool) -> None:
        if not self.known or len(told) != len(self._now):
            self._now, self.known = list(told), True
            self._bias = self._began = [0.0] * len(told)
        share = -math.expm1(-dt_s / FILTER_S)
        self._now = [f + share * (t - f) for f, t in zip(self._now, told, strict=True)]
        if drifts and dt_s > 0:
            drift = dt_s / DRIFT_S
            bias = [b + drift * (f - b) for b, f in zip(self._bias, self._now, strict=True)]
            self._bias = self._near(bias, self._began)

    def begin(self) -> None:
        self._bias = self._began = self._near(self._now, [0.0] * len(self._now))

    def _near(self, values: Sequence[float], middle: Sequence[float]) -> list[float]:
        apart = [v - m for v, m in zip(values, middle, strict=True)]
        share = min(1.0, self.slow / max(self._size(apart), 1e-9))
        return [m + share * a for m, a in zip(middle, apart, strict=True)]

    @property
    def value(self) -> float:
        return self._size([f - b for f, b in zip(self._now, self._bias, strict=True)])


def _length(values: Sequence[float]) -> float:
    return math.hypot(*values)


def _greatest(values: Sequence[float]) -> float:
    return max(map(abs, values), default=0.0)


class Contact:
    """See the module.

    Args:
        limits: of what may press.
    """

    def __init__(self, limits: ContactLimits) -> None:
        self._force = _Felt("contact_force", "N", limits.force_slow_n, limits.force_stop_n, _length)
        self._torque = _Felt(
            "contact_torque", "Nm", limits.torque_slow_nm, limits.torque_stop_nm, _length
        )
        self._effort = _Felt(
            "contact_effort", "Nm", limits.effort_slow_nm, limits.effort_stop_nm, _greatest
        )
        self._wants_effort = limits.effort_stop_nm is not None
        self._active = False
        self._pose_ns = self._joint_ns = 0

    # -- what is told -------------------------------------------------------------------------
    def take_pose(self, state: Stamped[PoseState]) -> None:
        """The newest pose, with the wrench where the robot tells one."""
        wrench = state.record.wrench
        if wrench is None:
            self._force.known = self._torque.known = False
            return
        told = wrench.tolist()
        dt_s = _passed_s(self._pose_ns, state.header.stamp_wall_ns)
        self._pose_ns = state.header.stamp_wall_ns
        self._force.take(told[:3], dt_s, drifts=self._active)
        self._torque.take(told[3:], dt_s, drifts=self._active)

    def take_joints(self, state: Stamped[JointState]) -> None:
        """The newest joints; looked at where a limit says that their efforts are external."""
        if self._wants_effort:
            dt_s = _passed_s(self._joint_ns, state.header.stamp_wall_ns)
            self._joint_ns = state.header.stamp_wall_ns
            self._effort.take(state.record.effort_nm.tolist(), dt_s, drifts=self._active)

    def begin(self) -> None:
        """The arm is activated: what presses now is no contact."""
        self._active = True
        for kind in self._kinds:
            kind.begin()

    def end(self) -> None:
        """It is not active any more: what presses from here on is not got used to."""
        self._active = False

    # -- what it means ------------------------------------------------------------------------
    @property
    def told(self) -> bool:
        """The robot says whether something presses."""
        return bool(self._kinds)

    @property
    def force_n(self) -> float | None:
        """External force, None where it is not told."""
        return self._force.value if self._force.known else None

    @property
    def torque_nm(self) -> float | None:
        """External torque about the TCP, None where it is not told."""
        return self._torque.value if self._torque.known else None

    @property
    def quiet(self) -> bool:
        """Nothing presses, as far as the robot tells."""
        return all(kind.value <= QUIET * kind.slow for kind in self._kinds)

    def pressed(self) -> ExternalLoad | None:
        """What is above its limit, None: nothing."""
        for kind in self._kinds:
            value = kind.value
            if value > kind.stop:
                return ExternalLoad(kind.name, value, kind.stop, kind.unit)
        return None

    def slowdown(self) -> Slowdown | None:
        """What makes the arm slower, None: nothing."""
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

    @property
    def _kinds(self) -> list[_Felt]:
        return [kind for kind in (self._force, self._torque, self._effort) if kind.known]


def _passed_s(before_ns: int, now_ns: int) -> float:
    return min(max((now_ns - before_ns) / 1e9, 0.0), LONGEST_S)
