"""What the measured joints say while the arm moves: how near it really is to what, and its elbow.

Goals are bounded by an arm that is reckoned with. This looks at the one there is. Of every bound
(end of a joint's range, singular value, distances of the arm to itself and to the table)::

    inside its zone (slow to stop) and getting nearer    speed sqrt(what is left / zone)
    past the stop by `PAST` and getting nearer           the arm has to brake

An arm may be that much off its command, and leans on a stop while it works there. A value gets
nearer when it leaves a band that follows it: noise within the band is none, a creep is one. And no
joint may be far from where it is commanded, or, where poses are, from where the arm that is
reckoned with has it when its TCP is led along the measured one: beyond ``limits.elbow_rad`` the arm
gets slower, and brakes at twice that.
"""

from __future__ import annotations

import numpy as np

from vla_zenoh.control.limits import SLOWEST, LimitHit, Slowdown
from vla_zenoh.control.reachability import ReachabilityFilter
from vla_zenoh.profile import Profile
from vla_zenoh.types import FloatArray

PERIOD_NS = 30_000_000
PAST_M, PAST_SINGULAR = 0.005, 0.005
PAST_MARGIN = 0.5
"""Part of ``joint_margin_rad``."""
BAND_RAD, BAND_M, BAND_SINGULAR = 2e-3, 5e-4, 5e-4
STEPS = 20
"""A share of the speed is one of so many, so that it does not change at every look."""


class JointMonitor:
    """See the module.

    Args:
        profile: limits, and whether joints or poses are commanded.
        reach: the arm that is reckoned with.
    """

    def __init__(self, profile: Profile, reach: ReachabilityFilter) -> None:
        self._reach, self._elbow_limit_rad = reach, profile.limits.elbow_rad
        barriers, joints = reach.barriers, reach.kinematics.size
        margin_rad = profile.limits.reach.joint_margin_rad
        distances = len(barriers.stop) - 1
        self._stop = np.concatenate([np.full(joints, margin_rad), barriers.stop])
        self._slow = np.concatenate([np.full(joints, 2 * margin_rad), barriers.slow])
        self._past = _each(joints, distances, PAST_MARGIN * margin_rad, PAST_SINGULAR, PAST_M)
        self._band = _each(joints, distances, BAND_RAD, BAND_SINGULAR, BAND_M)
        self.forget()

    def forget(self) -> None:
        """Nothing moves the arm: where it is then is no approach."""
        self._edge: FloatArray | None = None
        self._believed_rad: FloatArray | None = None
        self._next_ns = 0
        self._elbow_next = False
        self.elbow_rad = 0.0
        """How far the worst joint is from where the arm is believed to have it."""
        self._slower: dict[bool, Slowdown | None] = {}

    @property
    def slowdown(self) -> Slowdown | None:
        """Why the arm has to be slower, None for full speed."""
        found = [slower for slower in self._slower.values() if slower is not None]
        return min(found, key=lambda slower: slower.share, default=None)

    def look(
        self, measured_rad: FloatArray, commanded_rad: FloatArray | None, now_ns: int
    ) -> LimitHit | None:
        """Look when it is time: at the bounds and at the elbow in turns.

        Args:
            measured_rad: (n,) in chain order.
            commanded_rad: (n,) where joints are commanded; None: poses are.
            now_ns: time of this tick.

        Returns:
            why the arm has to brake, None where it does not.
        """
        if now_ns < self._next_ns:
            return None
        self._next_ns = now_ns + PERIOD_NS // 2
        self._elbow_next = not self._elbow_next
        if self._elbow_next:
            return self._bounds(measured_rad)
        return self._elbow(measured_rad, commanded_rad)

    def _bounds(self, measured_rad: FloatArray) -> LimitHit | None:
        kinematics, barriers = self._reach.kinematics, self._reach.barriers
        ends = np.minimum(measured_rad - kinematics.lower_rad, kinematics.upper_rad - measured_rad)
        left = barriers.at(measured_rad, kinematics.jacobian(measured_rad))
        left = np.concatenate([ends - self._stop[: len(ends)], left])
        before = left if self._edge is None else self._edge
        self._edge = np.minimum(np.maximum(before, left), left + self._band)
        nearer = self._edge < before
        past = np.where(nearer, left + self._past, 1.0)
        worst = int(np.argmin(past))
        if past[worst] < 0:
            stop = float(self._stop[worst])
            name, where = self._named(worst)
            return LimitHit(name, float(left[worst]) + stop, stop, where=where)
        zone = np.maximum(self._slow - self._stop, 1e-12)
        shares = np.where(nearer, np.sqrt(np.clip(left / zone, 0.0, 1.0)), 1.0)
        worst = int(np.argmin(shares))
        name, where = self._named(worst)
        value, limit = float(left[worst] + self._stop[worst]), float(self._slow[worst])
        self._slower[True] = _slower(name, float(shares[worst]), value, limit, where)
        return None

    def _elbow(self, measured_rad: FloatArray, commanded_rad: FloatArray | None) -> LimitHit | None:
        believed_rad = commanded_rad
        if believed_rad is None:
            start_rad = measured_rad if self._believed_rad is None else self._believed_rad
            pose = self._reach.kinematics.forward(measured_rad)
            believed_rad = self._believed_rad = self._reach.followed(pose, start_rad)
        if believed_rad is None:
            return None
        apart_rad = np.abs(measured_rad - believed_rad)
        worst = int(np.argmax(apart_rad))
        self.elbow_rad, limit_rad = float(apart_rad[worst]), self._elbow_limit_rad
        where = self._reach.kinematics.arm_joints[worst]
        if self.elbow_rad > 2 * limit_rad:
            return LimitHit("elbow_rad", self.elbow_rad, 2 * limit_rad, where=where)
        share = min(2.0 - self.elbow_rad / limit_rad, 1.0)
        self._slower[False] = _slower("elbow_rad", share, self.elbow_rad, limit_rad, where)
        return None

    def _named(self, index: int) -> tuple[str, str]:
        joints = self._reach.kinematics.arm_joints
        if index < len(joints):
            return "joint_limit", joints[index]
        index -= len(joints)
        return self._reach.barriers.names[index], self._reach.barriers.where(index)


def _each(
    joints: int, distances: int, of_joint: float, of_singular: float, of_distance: float
) -> FloatArray:
    return np.array([of_joint] * joints + [of_singular] + [of_distance] * distances)


def _slower(name: str, share: float, value: float, limit: float, where: str) -> Slowdown | None:
    share = max(float(np.ceil(share * STEPS)) / STEPS, SLOWEST)
    return None if share >= 1.0 else Slowdown(name, share, value, limit, where)
