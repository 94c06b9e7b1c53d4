"""How fast the arm may go where it comes near to a bound of its kinematics.

A barrier ``h`` (singular value or distance, minus its stop) that is inside of its zone ``z`` (slow
minus stop) and shrinks bounds the speed of the TCP to a share of the profile's::

    share = sqrt(h / z), at least SLOWEST

which is the speed that a constant deceleration can stop within what is left, when full speed can be
stopped within the zone. Away from a bound the arm goes at full speed.

A step for which the joints are too slow takes the time that they need, and a target that is far is
approached at a speed of its own. The arm comes later than the steps ask for then, and the slower
speed lasts until it has caught up (`going_on`): where it was needed is where the arm still is.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from vla_zenoh.control.smoothing import ROTATION_BOX
from vla_zenoh.kinematics.so3 import Pose, log3
from vla_zenoh.profile import Limits
from vla_zenoh.types import FloatArray

APPROACH = "approach"
"""Name of the slowdown to a target that is further away than a step."""
SLOWEST = 0.1
"""Share of its speed that is left to the arm close to a stop: it has to be able to work there."""
LEAST = 0.02
"""Likewise where the joints are too slow, or a far target is approached."""
SHRINKING = 1e-6
"""A barrier that changes by less stays as it is."""


class Slowdown(NamedTuple):
    """Why the arm goes slower.

    Args:
        name: the bound, as in `vla_zenoh.control.limits.LimitHit`.
        share: of the speed limit that is left.
        value: singular value or distance there.
        limit: below which it slows down.
        where: the joint, the two links, or the link over the table; empty for the whole arm.
        late_s: by so much the arm comes later than asked for because of it.
    """

    name: str
    share: float
    value: float
    limit: float
    where: str
    late_s: float = 0.0


def slowest(*reasons: Slowdown | None) -> Slowdown | None:
    """Of several reasons the one that leaves least speed."""
    return min((r for r in reasons if r is not None), key=lambda r: r.share, default=None)


def slowdown(
    before: FloatArray,
    after: FloatArray,
    stop: FloatArray,
    slow: FloatArray,
    names: Sequence[str],
    where: Callable[[int], str],
) -> Slowdown | None:
    """The bound that slows a step most, None for full speed.

    Args:
        before: (n,) barriers where the step begins.
        after: (n,) where it ends.
        stop: (n,) what a barrier is measured from.
        slow: (n,) where its zone begins.
        names: of the barriers.
        where: what of the arm barrier i is about.
    """
    zone = np.maximum(slow - stop, 1e-12)
    if (after >= zone).all():
        return None
    left = np.where(after < before - SHRINKING, np.clip(after / zone, 0.0, 1.0), 1.0)
    index = int(np.argmin(left))
    if left[index] >= 1.0:
        return None
    share = max(float(np.sqrt(left[index])), SLOWEST)
    value = float(after[index] + stop[index])
    return Slowdown(names[index], share, value, float(slow[index]), where(index))


def full_speed_s(limits: Limits, before: Pose, after: Pose) -> float:
    """Time (s) that a step takes at full speed, whose limits are those of `Smoother.box`."""
    way_m = after.position_m - before.position_m
    turn = log3(before.rotation.T @ after.rotation)
    return max(
        max(map(abs, way_m.tolist())) / limits.translation.velocity_m_s,
        max(map(abs, turn.tolist())) / (ROTATION_BOX * limits.rotation.velocity_rad_s),
    )


def going_on(
    before: Slowdown | None, now: Slowdown | None, dt_s: float, most_s: float
) -> Slowdown | None:
    """The slowdown of a step whose beginning the arm comes late to.

    Args:
        before: of the step before it.
        now: its own.
        dt_s: time it has.
        most_s: at full speed nobody is later than this: the leash sees to it.
    """
    if before is None or before.late_s <= 0.0:
        return now
    added_s = 0.0 if now is None else now.late_s
    if now is not None and now.name == APPROACH:
        late_s = max(before.late_s - dt_s, added_s)
    else:
        late_s = before.late_s + (added_s or -dt_s)
    if now is not None and now.share <= before.share:
        before = now
    elif late_s <= 0.0:
        return now
    return before._replace(late_s=max(min(late_s, most_s / before.share), 0.0))
