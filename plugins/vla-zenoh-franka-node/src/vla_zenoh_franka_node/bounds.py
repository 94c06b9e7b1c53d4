"""The bounds within which a franka-node accepts targets, so that none is sent that it refuses."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vla_zenoh.kinematics.so3 import log3, quat_from_rotation, rotation_from_quat
from vla_zenoh.types import FloatArray


@dataclass(frozen=True)
class Bounds:
    """Largest distances of a target from the one before it (step) and from the arm (lead)."""

    step_m: float
    step_rad: float
    lead_m: float
    lead_rad: float
    step_joint_rad: float
    lead_joint_rad: float

    def why_not_pose(self, target: FloatArray, before: FloatArray, ee: FloatArray) -> str:
        """Why a pose must not be sent; empty: it may.

        Args:
            target: (7,) position and quaternion xyzw.
            before: (7,) the last one.
            ee: (4, 4) measured pose.
        """
        measured = pose_values(ee)
        for name, of, most_m, most_rad in (
            ("steps from the last target by", before, self.step_m, self.step_rad),
            ("leads the arm by", measured, self.lead_m, self.lead_rad),
        ):
            way_m = float(np.linalg.norm(target[:3] - of[:3]))
            if not way_m <= most_m:
                return f"target {name} {way_m:.3f} m, allowed: {most_m:g} m"
            turn = rotation_from_quat(target[3:]) @ rotation_from_quat(of[3:]).T
            turn_rad = float(np.linalg.norm(log3(turn)))
            if not turn_rad <= most_rad:
                return f"target {name} {turn_rad:.3f} rad, allowed: {most_rad:g} rad"
        return ""

    def why_not_joints(
        self, target: FloatArray, before: FloatArray, position_rad: FloatArray
    ) -> str:
        """Why joints must not be sent; empty: they may. All of them are (7,), rad."""
        for name, of, most_rad in (
            ("steps from the last target by", before, self.step_joint_rad),
            ("leads the arm by", position_rad, self.lead_joint_rad),
        ):
            ways_rad = np.abs(target - of)
            worst = int(np.argmax(ways_rad))
            if not ways_rad[worst] <= most_rad:
                return (
                    f"target {name} {ways_rad[worst]:.3f} rad at joint {worst + 1}, "
                    f"allowed: {most_rad:g} rad"
                )
        return ""


def pose_values(pose: FloatArray) -> FloatArray:
    """(7,) position and quaternion xyzw of a (4, 4) pose."""
    return np.concatenate((pose[:3, 3], quat_from_rotation(pose[:3, :3])))
