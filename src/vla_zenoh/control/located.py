"""A bound that acted, and where on the arm."""

from __future__ import annotations

from vla_zenoh.control.limits import LimitHit


class LocatedHit(LimitHit):
    """A `LimitHit` that names a part of the robot.

    Attributes:
        where: the joint, the two links, or the link over the table; empty for the whole arm.
    """

    where: str

    def __new__(cls, name: str, value: float, limit: float, where: str = "") -> LocatedHit:
        """See the class; a located hit is never fatal."""
        hit = super().__new__(cls, name, value, limit)
        hit.where = where
        return hit
