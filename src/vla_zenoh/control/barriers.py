"""Barriers and distance constraints of an arm: singularity, collisions, keep-outs, workspace.

A barrier ``h`` (singular value or distance, minus its stop) that is inside its zone ``z`` (slow
minus stop) and shrinks limits the speed of the TCP to a share of the profile's::

    share = sqrt(h / z), at least SLOWEST

the speed that a constant deceleration can stop within the distance left, if it can stop full speed
within the zone.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from vla_zenoh.control.limits import SLOWEST, LimitHit, Slowdown, workspace_corners
from vla_zenoh.kinematics.collision import FREE_M, CollisionModel
from vla_zenoh.kinematics.kinematics import Kinematics, smallest_singular_value
from vla_zenoh.profile import Limits, ReachLimits
from vla_zenoh.types import FloatArray

DECAY = 0.5
"""Part of the distance to a stop that one step may take inside its zone."""
NOISE = 2e-6
"""m, and singular value: difference of distances and solver between two equal poses."""
SHRINKING = 1e-6
"""A barrier that changes by less counts as constant."""
NEAR_M = 0.08
"""A pair further from its stop than this is no constraint until the next update."""


class Margins(NamedTuple):
    """Distances of an arm to its bounds.

    Args:
        joint_rad: smallest distance of a joint to the end of its range.
        joint: its name.
        singular_value: smallest of the Jacobian.
        self_m: smallest distance of the arm to itself, inf where nothing can touch.
        self_pair: the two links.
        table_m: smallest distance to the table, inf without one.
        table_link: the link.
        keep_out_m: smallest distance to a keep-out, inf without one.
        keep_out_pair: the link and the keep-out.
    """

    joint_rad: float
    joint: str
    singular_value: float
    self_m: float
    self_pair: str
    table_m: float
    table_link: str
    keep_out_m: float
    keep_out_pair: str


class Barriers:
    """Values that must not become negative: singular value and distances, each minus its stop.

    Barrier 0 is the singular value, the others are pairs that may touch: the arm and itself, the
    table and the keep-outs; hand and fingers to the table have a stop of their own.

    Args:
        kinematics: of the arm.
        limits: stop and slow of each kind.
        known_good_rad: configurations known to be free of collisions.

    Attributes:
        names: of the barriers, as in `vla_zenoh.control.limits.LimitHit`.
        stop: (n,) value at which each is zero.
        slow: (n,) value at which its zone begins.

    Raises:
        ResourceError: the URDF's collision shapes cannot be loaded.
        ProfileError: a known configuration touches a keep-out.
    """

    def __init__(
        self,
        kinematics: Kinematics,
        limits: ReachLimits,
        known_good_rad: Sequence[FloatArray] = (),
    ) -> None:
        self._kinematics = kinematics
        self.collisions = CollisionModel(
            kinematics,
            near_m=limits.collision_slow_m,
            touching_m=limits.collision_stop_m,
            table_z_m=limits.table_z_m,
            known_good_rad=known_good_rad,
            keep_out=limits.keep_out,
        )
        pairs = self.collisions.pairs
        hand = np.array([pair.is_hand and pair.limit == "table_distance" for pair in pairs], bool)
        self.names = ["singularity", *(pair.limit for pair in pairs)]
        stops_m = np.where(hand, limits.table_stop_m, limits.collision_stop_m)
        slows_m = np.where(hand, limits.table_slow_m, limits.collision_slow_m)
        self.stop = np.array([limits.singularity_stop, *stops_m])
        self.slow = np.array([limits.singularity_slow, *slows_m])
        self._zone = np.maximum(self.slow - self.stop, 1e-12)

    def at(self, joints_rad: FloatArray, jacobian: FloatArray) -> FloatArray:
        """Barriers (n,) at these joints, whose Jacobian is (6, n) m and rad."""
        values = np.empty(len(self.stop))
        values[0] = smallest_singular_value(jacobian)
        values[1:] = self.collisions.distances(joints_rad)
        return values - self.stop

    def floor(self, before: FloatArray) -> FloatArray:
        """Least values (n,) after one step from `before`."""
        return np.where(before > 0, np.minimum(self._zone, (1 - DECAY) * before), before - NOISE)

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
        if (after >= self._zone).all():
            return None
        left = np.where(after < before - SHRINKING, np.clip(after / self._zone, 0.0, 1.0), 1.0)
        index = int(left.argmin())
        if left[index] >= 1.0:
            return None
        share = max(float(np.sqrt(left[index])), SLOWEST)
        value, slow = float(after[index] + self.stop[index]), float(self.slow[index])
        return Slowdown(self.names[index], share, value, slow, self.where(index))

    def margins(self, joints_rad: FloatArray, barriers: FloatArray) -> Margins:
        """Margins at these joints, whose barriers are known."""
        kinematics = self._kinematics
        room = np.minimum(joints_rad - kinematics.lower_rad, kinematics.upper_rad - joints_rad)
        tightest = int(np.argmin(room))
        values = (barriers + self.stop).tolist()
        nearest: dict[str, tuple[float, str]] = dict.fromkeys(
            ("self_collision", "table_distance", "keep_out"), (np.inf, "")
        )
        for index, value in enumerate(values[1:], start=1):
            if value < FREE_M:
                name = self.names[index]
                nearest[name] = min(nearest[name], (value, self.where(index)))
        return Margins(
            float(room[tightest]),
            kinematics.arm_joints[tightest],
            values[0],
            *nearest["self_collision"],
            *nearest["table_distance"],
            *nearest["keep_out"],
        )


class DistanceConstraints:
    """Linear constraints on joint velocities: the faces of the TCP's box, and distances of the arm.

    Each constraint is a row ``g`` (n,) in m/rad and the distance left in m: joint velocities ``qd``
    reduce it at the rate ``g qd``. Distances of the arm to itself, the table and keep-outs are
    computed every few ticks and linear in between; their slope is the relative velocity of the two
    nearest points along the line between them.

    Args:
        limits: with the box of the TCP.
        barriers: of the arm; None: only the box.
    """

    def __init__(self, limits: Limits, barriers: Barriers | None) -> None:
        self._low_m, self._high_m = workspace_corners(limits)
        self._barriers = barriers
        self._at_rad: FloatArray | None = None
        self._near = np.zeros(0, dtype=np.intp)
        self._rows, self._left_m = np.zeros((0, 0)), np.zeros(0)

    def update(self, joints_rad: FloatArray) -> None:
        """Compute distances and slopes at these joints (n,)."""
        if self._barriers is None:
            return
        collisions, stop_m = self._barriers.collisions, self._barriers.stop[1:]
        distances_m = collisions.distances(joints_rad)
        self._near = near = np.flatnonzero(distances_m < stop_m + NEAR_M)
        self._at_rad = joints_rad
        self._rows = -collisions.gradients(joints_rad, near.tolist())
        self._left_m = (distances_m - stop_m)[near]

    def hit(self, row: int, left_m: float) -> LimitHit:
        """The constraint of this row as a limit that acted, `left_m` from the arm."""
        if row < 6 or self._barriers is None:
            return LimitHit("workspace", -left_m, 0.0)
        return self._barriers.hit(int(self._near[row - 6]) + 1, left_m)

    def at(
        self, joints_rad: FloatArray, position_m: FloatArray, jacobian: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Rows (m, n) and distances left (m,) at these joints (n,), their TCP and its Jacobian."""
        rows = [jacobian[:3], -jacobian[:3]]
        left_m = [self._high_m - position_m, position_m - self._low_m]
        if self._at_rad is not None and len(self._rows):
            rows.append(self._rows)
            left_m.append(self._left_m - self._rows @ (joints_rad - self._at_rad))
        return np.concatenate(rows), np.concatenate(left_m)
