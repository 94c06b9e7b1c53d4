"""What a controller allows its joints, and why a target is not sent; no library, no clock."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from vla_zenoh.types import FloatArray

NEAR_RAD = 1e-3
"""Limits differ by less between the maker's description, as float32, and the controller."""
FASTER = 1.5
"""A late tick makes up for the one before it."""


class JointBound(NamedTuple):
    """Ends and largest velocity of one joint: rad and rad/s, or m and m/s."""

    lower: float
    upper: float
    velocity: float


class Bounds:
    """The limits that a controller reports of the joints of its arm.

    Args:
        names: of the joints.
        joints: one for each.
    """

    def __init__(self, names: Sequence[str], joints: Sequence[JointBound]) -> None:
        self._names = tuple(names)
        self.lower_rad, self.upper_rad, self.velocity_rad_s = np.array(joints, np.float64).T

    def narrower_than(
        self, lower_rad: FloatArray, upper_rad: FloatArray, velocity_rad_s: FloatArray
    ) -> Iterator[str]:
        """Where a profile allows more than the controller, joint by joint."""
        for index, name in enumerate(self._names):
            least, most = self.lower_rad[index], self.upper_rad[index]
            if lower_rad[index] < least - NEAR_RAD or upper_rad[index] > most + NEAR_RAD:
                yield (
                    f"{name} may go from {lower_rad[index]:.3f} to {upper_rad[index]:.3f} rad, "
                    f"the controller allows {least:.3f} to {most:.3f}: set robot.joint_range_rad"
                )
            if velocity_rad_s[index] > self.velocity_rad_s[index]:
                yield (
                    f"{name} may turn at {velocity_rad_s[index]:.3g} rad/s, the controller allows "
                    f"{self.velocity_rad_s[index]:.3g}: lower limits.joint.velocity_rad_s"
                )

    def inside(self, position_rad: FloatArray) -> FloatArray:
        """The nearest joints that are within the ends."""
        return np.clip(position_rad, self.lower_rad, self.upper_rad)

    def why_not(self, target_rad: FloatArray, before_rad: FloatArray, elapsed_s: float) -> str:
        """Why a target is not sent after another one; empty: it may be."""
        beyond_rad = np.maximum(self.lower_rad - target_rad, target_rad - self.upper_rad)
        index = int(np.argmax(beyond_rad))
        if beyond_rad[index] > NEAR_RAD:
            return (
                f"target of {self._names[index]} is {target_rad[index]:.3f} rad, the controller "
                f"allows {self.lower_rad[index]:.3f} to {self.upper_rad[index]:.3f}"
            )
        step_rad = np.abs(target_rad - before_rad)
        share = step_rad / (self.velocity_rad_s * elapsed_s * FASTER)
        index = int(np.argmax(share))
        if share[index] > 1:
            return (
                f"target of {self._names[index]} is {step_rad[index]:.3f} rad from the one "
                f"{elapsed_s:.3f} s before, the controller allows "
                f"{self.velocity_rad_s[index]:.3g} rad/s"
            )
        return ""
