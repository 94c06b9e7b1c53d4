"""Distance between two arms that share a space, each with kinematics and a base of its own."""

from __future__ import annotations

from typing import Any, NamedTuple

import coal
import numpy as np
import pinocchio as pin

from vla_zenoh.kinematics.collision import CollisionModel
from vla_zenoh.kinematics.kinematics import Kinematics
from vla_zenoh.kinematics.so3 import Pose
from vla_zenoh.types import FloatArray

KEPT = 8
"""Configurations of an arm whose placements are kept: each is compared with several others."""


class Nearest(NamedTuple):
    """The two links of two arms that are nearest to each other.

    Args:
        distance_m: between them, negative where they are inside each other.
        first: link of the first arm; empty: nothing is nearer than `within_m`.
        second: link of the second arm.
    """

    distance_m: float
    first: str = ""
    second: str = ""


class PlacedArm:
    """The hulls of an arm's links, placed in the frame of the robot.

    Args:
        kinematics: of the arm.
        collisions: has a hull for each link.
        base: where its base frame stands.
    """

    def __init__(self, kinematics: Kinematics, collisions: CollisionModel, base: Pose) -> None:
        self._model, self._data = kinematics.model, kinematics.model.createData()
        self._geometry: Any = collisions.links()
        self._placed = self._geometry.createData()
        stands = pin.SE3(base.rotation, base.position_m)
        self._base = stands * kinematics.base_placement.inverse()
        shapes = list(self._geometry.geometryObjects)
        self.names = [shape.name for shape in shapes]
        self.hulls: list[Any] = [shape.geometry for shape in shapes]
        for hull in self.hulls:
            hull.computeLocalAABB()
        self._centres = np.array([hull.aabb_center for hull in self.hulls])
        self.radii_m = np.array([hull.aabb_radius for hull in self.hulls])
        self._key = b""
        self._kept: dict[bytes, tuple[list[Any], FloatArray]] = {}

    def place(self, joints_rad: FloatArray) -> tuple[list[Any], FloatArray]:
        """Transforms of the hulls at these joints (n,), and the centres (m, 3) of their spheres."""
        key = joints_rad.tobytes()
        found = self._kept.get(key)
        if found is None:
            pin.updateGeometryPlacements(
                self._model, self._data, self._geometry, self._placed, joints_rad
            )
            placed = [self._base * placement for placement in self._placed.oMg]
            centres = np.array(
                [
                    at.rotation @ c + at.translation
                    for at, c in zip(placed, self._centres, strict=True)
                ]
            )
            transforms = [coal.Transform3s(at.rotation, at.translation) for at in placed]
            found = transforms, centres
            if len(self._kept) >= KEPT:
                self._kept.clear()
            self._kept[key] = found
        return found


class PartDistance:
    """Distances between two arms.

    Args:
        first: one of them.
        second: the other one.
    """

    def __init__(self, first: PlacedArm, second: PlacedArm) -> None:
        self._first, self._second = first, second
        self._spheres_m = first.radii_m[:, None] + second.radii_m[None, :]
        self._request, self._result = coal.DistanceRequest(), coal.DistanceResult()

    def nearest(self, first_rad: FloatArray, second_rad: FloatArray, within_m: float) -> Nearest:
        """The nearest links with the arms at these joints (n,) each.

        Args:
            first_rad: of the first arm.
            second_rad: of the second arm.
            within_m: links further apart than this are not looked for.
        """
        one, one_m = self._first.place(first_rad)
        other, other_m = self._second.place(second_rad)
        apart = np.linalg.norm(one_m[:, None] - other_m[None, :], axis=2) - self._spheres_m
        flat = apart.ravel()
        found = Nearest(within_m)
        for index in np.argsort(flat):
            if flat[index] >= found.distance_m:
                break
            i, j = divmod(int(index), len(other))
            self._result.clear()
            distance_m = coal.distance(
                self._first.hulls[i],
                one[i],
                self._second.hulls[j],
                other[j],
                self._request,
                self._result,
            )
            if distance_m < found.distance_m:
                found = Nearest(distance_m, self._first.names[i], self._second.names[j])
        return found
