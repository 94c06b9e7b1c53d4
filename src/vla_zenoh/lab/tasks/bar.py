"""Judges whether two arms lifted the bar of the scene ``pair``, from its true pose."""

from __future__ import annotations

import math

import numpy as np

from vla_zenoh.errors import RecordError
from vla_zenoh.kinematics.so3 import rotation_from_quat
from vla_zenoh.lab.tasks.judge import (
    DROPPED,
    FELL,
    NOT_MOVED,
    TABLE_EDGE_Z_M,
    TILTED,
    TIMEOUT,
    Verdict,
)
from vla_zenoh.lab.tasks.order import Order
from vla_zenoh.types import FloatArray, ObjectPoses

BAR = "bar"
LIFTED_M = 0.10
"""The middle of a bar that counts as lifted is this much higher than at first."""
LEVEL_RAD = 0.1
"""Its tilt then, at most."""
HELD_S = 1.0
"""So long it has to stay lifted and level."""
TOUCHED_M = 0.01


class BarJudge:
    """Judges ``lift the bar``; used as a `vla_zenoh.lab.tasks.TaskJudge`.

    Args:
        order: goal.
        before: all objects at the start.

    Raises:
        RecordError: there is no bar.
    """

    def __init__(self, order: Order, before: ObjectPoses) -> None:
        self.order = order
        if BAR not in before.names:
            raise RecordError(
                f"there is no {BAR} among the objects {', '.join(before.names)}; it is lifted in "
                "the scene 'pair'"
            )
        self._z_m = self._begin_z_m = self._highest_m = self._pose(before)[0][2]
        self._tilt_rad = self._time_s = 0.0
        self._good_since_s: float | None = None

    def update(
        self,
        objects: ObjectPoses,
        width_m: float,
        time_s: float,
        tcp_m: FloatArray | None = None,
    ) -> Verdict | None:
        """The verdict as soon as it is certain; only the objects matter."""
        position_m, rotation = self._pose(objects)
        self._z_m, self._time_s = float(position_m[2]), time_s
        self._highest_m = max(self._highest_m, self._z_m)
        self._tilt_rad = math.asin(min(abs(float(rotation[2, 0])), 1.0))
        if self._z_m < TABLE_EDGE_Z_M:
            return Verdict(False, FELL, time_s)
        lifted = self._z_m - self._begin_z_m > LIFTED_M
        if not lifted or self._tilt_rad > LEVEL_RAD:
            self._good_since_s = None
        elif self._good_since_s is None:
            self._good_since_s = time_s
        elif time_s - self._good_since_s >= HELD_S:
            return Verdict(True, "", time_s)
        return None

    def end(self) -> Verdict:
        """The verdict at the time limit."""
        if self._good_since_s is not None:
            return Verdict(False, TIMEOUT, self._time_s)
        if self._tilt_rad > LEVEL_RAD:
            return Verdict(False, TILTED, self._time_s)
        touched = self._highest_m - self._begin_z_m > TOUCHED_M
        return Verdict(False, DROPPED if touched else NOT_MOVED, self._time_s)

    @staticmethod
    def _pose(objects: ObjectPoses) -> tuple[FloatArray, FloatArray]:
        index = objects.names.index(BAR)
        return np.array(objects.position_m[index]), rotation_from_quat(objects.quat_xyzw[index])
