"""What commanded joints are held before: the faces of the TCP's box, and distances of the arm.

A wall is a row ``g`` (n,) in m/rad and what is left of the way to it in m: with joint velocities
``qd`` the arm comes nearer by ``g qd``. Distances of the arm to itself and to the table are looked
at now and then, and are linear in between: their slope is the relative velocity of the two nearest
points along the line that joins them.
"""

from __future__ import annotations

import numpy as np

from vla_zenoh.control.barriers import Barriers
from vla_zenoh.control.limits import LimitHit
from vla_zenoh.profile import Limits
from vla_zenoh.types import FloatArray

NEAR_M = 0.08
"""What is further from its stop than this is no concern until the next look."""


class Walls:
    """See the module.

    Args:
        limits: with the box of the TCP.
        barriers: of the arm; None: only the box.
    """

    def __init__(self, limits: Limits, barriers: Barriers | None) -> None:
        workspace = limits.workspace
        box = np.array([workspace.x_m, workspace.y_m, workspace.z_m])
        self._low_m, self._high_m = box[:, 0], box[:, 1]
        self._barriers = barriers
        self._at_rad: FloatArray | None = None
        self._near = np.zeros(0, dtype=np.intp)
        self._rows, self._left_m = np.zeros((0, 0)), np.zeros(0)

    def look(self, joints_rad: FloatArray) -> None:
        """Find what the arm is near to in these joints (n,)."""
        if self._barriers is None:
            return
        collisions, stop_m = self._barriers.collisions, self._barriers.stop[1:]
        distances_m = collisions.distances(joints_rad)
        self._near = near = np.flatnonzero(distances_m < stop_m + NEAR_M)
        self._at_rad = joints_rad
        self._rows = -collisions.gradients(joints_rad, near.tolist())
        self._left_m = (distances_m - stop_m)[near]

    def hit(self, wall: int, left_m: float) -> LimitHit:
        """What the wall of this number is, so far from the arm."""
        if wall < 6 or self._barriers is None:
            return LimitHit("workspace", -left_m, 0.0)
        index = int(self._near[wall - 6]) + 1
        barriers, stop_m = self._barriers, float(self._barriers.stop[index])
        return LimitHit(barriers.names[index], left_m + stop_m, stop_m, where=barriers.where(index))

    def at(
        self, joints_rad: FloatArray, position_m: FloatArray, jacobian: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Rows (m, n) and ways left (m,) of these joints (n,), their TCP and its Jacobian."""
        rows, left_m = [jacobian[:3], -jacobian[:3]], [self._high_m - position_m]
        left_m.append(position_m - self._low_m)
        if self._at_rad is not None and len(self._rows):
            rows.append(self._rows)
            left_m.append(self._left_m - self._rows @ (joints_rad - self._at_rad))
        return np.concatenate(rows), np.concatenate(left_m)
