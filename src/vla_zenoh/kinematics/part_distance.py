"""Distance between two arms that share a space, each with kinematics and a base of its own."""

from __future__ import annotations

from collections.abc import Sequence
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


class Placement(NamedTuple):
    """The hulls of an arm's links at some joints.

    Args:
        transforms: of each hull into the frame of the robot.
        centres_m: (m, 3) centres of the spheres around them.
    """

    transforms: list[Any]
    centres_m: FloatArray


class PlacedArm:
    """The hulls of an arm's links, placed in the frame of the robot.

    Args:
        kinematics: of the arm.
        collisions: has a hull for each link.
        base: where its base frame stands.
    """

    def __init__(self, kinematics: Kinematics, collisions: CollisionModel, base: Pose) -> None:
        self._model = kinematics.model.copy()
        stands = pin.SE3(base.rotation, base.position_m) * kinematics.base_placement.inverse()
        self._geometry: Any = collisions.links().copy()
        for joint, parent in enumerate(self._model.parents):
            if joint > 0 and parent == 0:
                self._model.jointPlacements[joint] = stands * self._model.jointPlacements[joint]
        for shape in self._geometry.geometryObjects:
            if shape.parentJoint == 0:
                shape.placement = stands * shape.placement
        self._data, self._placed = self._model.createData(), self._geometry.createData()
        shapes = list(self._geometry.geometryObjects)
        self.names = [shape.name for shape in shapes]
        self.hulls: list[Any] = [shape.geometry for shape in shapes]
        for hull in self.hulls:
            hull.computeLocalAABB()
        centres = np.array([hull.aabb_center for hull in self.hulls])
        self._centres_m = np.hstack([centres, np.ones((len(centres), 1))])[:, :, None]
        self.radii_m = np.array([hull.aabb_radius for hull in self.hulls])
        self._kept: dict[bytes, Placement] = {}

    def place(self, joints_rad: FloatArray) -> Placement:
        """Where the hulls are at these joints (n,)."""
        key = joints_rad.tobytes()
        found = self._kept.get(key)
        if found is None:
            pin.updateGeometryPlacements(
                self._model, self._data, self._geometry, self._placed, joints_rad
            )
            frames = list(self._placed.oMg)
            matrices = np.array([frame.homogeneous for frame in frames])
            transforms = [coal.Transform3s(frame.rotation, frame.translation) for frame in frames]
            found = Placement(transforms, (matrices @ self._centres_m)[:, :3, 0])
            if len(self._kept) >= KEPT:
                self._kept.clear()
            self._kept[key] = found
        return found


class PartDistance:
    """Distances between two arms."""

    def __init__(self, first: PlacedArm, second: PlacedArm) -> None:
        self._first, self._second = first, second
        self._spheres_m = first.radii_m[:, None] + second.radii_m[None, :]
        self._request, self._result = coal.DistanceRequest(), coal.DistanceResult()

    def nearest(
        self, first_rad: Sequence[FloatArray], second_rad: Sequence[FloatArray], within_m: float
    ) -> Nearest:
        """The nearest links with the arms at any two of these configurations (n,).

        Links further apart than `within_m` are not looked for.
        """
        ones = [self._first.place(joints_rad) for joints_rad in first_rad]
        others = [self._second.place(joints_rad) for joints_rad in second_rad]
        one_m = np.array([placed.centres_m for placed in ones])
        other_m = np.array([placed.centres_m for placed in others])
        between_m = one_m[:, None, :, None] - other_m[None, :, None, :]
        apart_m = np.sqrt((between_m * between_m).sum(axis=-1)) - self._spheres_m
        found = Nearest(within_m)
        places = np.argwhere(apart_m < within_m)
        bounds_m = apart_m[apart_m < within_m]
        order = np.argsort(bounds_m)
        for (a, b, i, j), bound_m in zip(
            places[order].tolist(), bounds_m[order].tolist(), strict=True
        ):
            if bound_m >= found.distance_m:
                break
            self._result.clear()
            distance_m = coal.distance(
                self._first.hulls[i],
                ones[a].transforms[i],
                self._second.hulls[j],
                others[b].transforms[j],
                self._request,
                self._result,
            )
            if distance_m < found.distance_m:
                found = Nearest(distance_m, self._first.names[i], self._second.names[j])
        return found
