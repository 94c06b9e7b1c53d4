"""What a profile's robot looks like: a mesh for every link, and where the links are.

The visual shapes of the URDF are taken, as Pinocchio reads them for the command node; where they
cannot be loaded, the collision shapes.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import coal
import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from vla_zenoh.errors import ResourceError, VlaZenohError
from vla_zenoh.kinematics.fingers import Fingers
from vla_zenoh.kinematics.kinematics import make_kinematics
from vla_zenoh.kinematics.so3 import Pose
from vla_zenoh.profile import Profile
from vla_zenoh.types import FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class LinkMesh:
    """The surface of a link, in the link's frame.

    Args:
        link: its name.
        vertices_m: (v, 3).
        triangles: (t, 3) indices of vertices.
        normals: (v, 3) unit.
        colour: red, green, blue, opacity, 0 to 1 each.
    """

    link: str
    vertices_m: NDArray[np.float32]
    triangles: NDArray[np.uint32]
    normals: NDArray[np.float32]
    colour: tuple[float, float, float, float]


class RobotModel:
    """Meshes of the profile's robot, and their poses in the base frame.

    Args:
        profile: its robot's description is read.

    Raises:
        ResourceError: the description or all of its shapes are not there.
        ProfileError: frames or joints that the description does not have.
        MissingExtraError: the package that carries the description is not installed.
    """

    def __init__(self, profile: Profile) -> None:
        robot = profile.robot
        self.kinematics = make_kinematics(profile)
        self._model: Any = self.kinematics.full_model
        self._data: Any = self._model.createData()
        self._q: FloatArray = np.array(self.kinematics.locked_position)
        for name, angle in zip(robot.arm_joints, robot.home_rad, strict=True):
            self._q[self._index(name)] = angle
        self._joints = {
            name: self._index(name) for name in (*robot.arm_joints, *robot.finger_joints)
        }
        self._finger_names = robot.finger_joints
        self._fingers = Fingers(robot.gripper, len(robot.finger_joints))
        self.meshes = link_meshes(self.kinematics.urdf)
        self._frames = {mesh.link: self._model.getFrameId(mesh.link) for mesh in self.meshes}

    def _index(self, joint: str) -> int:
        return self._model.joints[self._model.getJointId(joint)].idx_q

    def move(self, positions: Mapping[str, float]) -> None:
        """Take joint positions (rad, or m) by name; what is not of this robot is passed over."""
        for name, value in positions.items():
            if name in self._joints:
                self._q[self._joints[name]] = value

    def open(self, width_m: float) -> None:
        """Open the fingers to a width, all alike."""
        self.move(dict.fromkeys(self._finger_names, self._fingers.position(width_m)))

    def placements(self) -> Iterator[tuple[str, Pose]]:
        """Every link with a mesh, and its pose in the base frame."""
        pin.forwardKinematics(self._model, self._data, self._q)
        base = self.kinematics.base_placement
        for link, frame in self._frames.items():
            placement = base.actInv(pin.updateFramePlacement(self._model, self._data, frame))
            yield link, Pose(placement.translation.copy(), placement.rotation.copy())


@cache
def link_meshes(urdf: Path) -> tuple[LinkMesh, ...]:
    """The surface of every link that has one.

    Raises:
        ResourceError: no shape can be loaded.
    """
    return tuple(_meshes(pin.buildModelFromUrdf(str(urdf)), urdf))


def _meshes(model: Any, urdf: Path) -> Iterator[LinkMesh]:
    geometry = _load(model, urdf)
    by_link: dict[str, list[Any]] = {}
    for shape in geometry.geometryObjects:
        by_link.setdefault(model.frames[shape.parentFrame].name, []).append(shape)
    for link, shapes in by_link.items():
        to_link = model.frames[model.getFrameId(link)].placement.inverse()
        surfaces = [_surface(shape, to_link) for shape in shapes]
        starts = np.cumsum([0, *(len(points) for points, _ in surfaces)])
        points = np.concatenate([points for points, _ in surfaces])
        faces = np.concatenate(
            [faces + start for (_, faces), start in zip(surfaces, starts, strict=False)]
        )
        red, green, blue, opacity = (float(part) for part in shapes[0].meshColor)
        yield LinkMesh(
            link,
            points.astype(np.float32),
            faces.astype(np.uint32),
            _normals(points, faces),
            (red, green, blue, opacity),
        )


def _load(model: Any, urdf: Path) -> Any:
    folders = [str(folder) for folder in urdf.resolve().parents]
    why = "it has none"
    for kind in (pin.GeometryType.VISUAL, pin.GeometryType.COLLISION):
        try:
            found = pin.buildGeomFromUrdf(model, str(urdf), kind, package_dirs=folders)
        except (ValueError, RuntimeError) as error:
            why = str(error)
            continue
        if found.ngeoms:
            return found
    raise ResourceError(f"no shape of {urdf.name} can be shown: {why}")


def _surface(shape: Any, to_link: Any) -> tuple[FloatArray, NDArray[np.int64]]:
    """Points (v, 3) in the link's frame, and triangles (t, 3) of their indices."""
    geometry, placement = shape.geometry, to_link * shape.placement
    if isinstance(geometry, coal.BVHModelBase):
        points = np.array(geometry.vertices()) * shape.meshScale
        triangles = (geometry.tri_indices(index) for index in range(geometry.num_tris))
        faces = np.array([(triangle[0], triangle[1], triangle[2]) for triangle in triangles])
    else:
        points = primitive_corners(geometry).reshape(
            -1, 3
        )  # shared by no two faces: edges stay sharp
        faces = np.arange(len(points)).reshape(-1, 3)
    return points @ placement.rotation.T + placement.translation, faces


def _normals(points: FloatArray, faces: NDArray[np.int64]) -> NDArray[np.float32]:
    """Unit normals (v, 3): the mean of the faces that share a point, by their areas."""
    first, second, third = (points[faces[:, corner]] for corner in range(3))
    area = np.cross(second - first, third - first)
    total = np.zeros_like(points)
    for axis in range(3):
        weights = np.repeat(area[:, axis], 3)
        total[:, axis] = np.bincount(faces.ravel(), weights, len(points))
    length = np.linalg.norm(total, axis=1, keepdims=True)
    return (total / np.maximum(length, 1e-12)).astype(np.float32)


def primitive_corners(geometry: Any) -> FloatArray:
    """(t, 3, 3) corners of the triangles of a box, cylinder, sphere or capsule.

    Raises:
        ResourceError: it is of another kind.
    """
    if isinstance(geometry, coal.Box):
        ring = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * geometry.halfSide[:2]
        height = geometry.halfSide[2]
        return _stacked([(ring, -height), (ring, height)])
    turn = np.arange(24) * 2 * np.pi / 24
    around = np.stack([np.cos(turn), np.sin(turn)], axis=1)
    if isinstance(geometry, coal.Cylinder):
        ring = around * geometry.radius
        return _stacked([(ring, -geometry.halfLength), (ring, geometry.halfLength)])
    if isinstance(geometry, (coal.Sphere, coal.Capsule)):
        half = geometry.halfLength if isinstance(geometry, coal.Capsule) else 0.0
        tilts = np.linspace(-0.5, 0.5, 10) * np.pi
        radius = geometry.radius
        return _stacked(
            [
                (around * radius * np.cos(tilt), radius * np.sin(tilt) + np.copysign(half, tilt))
                for tilt in tilts
            ]
        )
    raise ResourceError(
        f"a shape of the kind {type(geometry).__name__} is not known; "
        "known: mesh, box, cylinder, sphere, capsule"
    )


def _stacked(rings: list[tuple[FloatArray, float]]) -> FloatArray:
    """(t, 3, 3): rings of equally many points above each other, closed at both ends."""
    levels = [np.column_stack([ring, np.full(len(ring), z)]) for ring, z in rings]
    triangles: list[FloatArray] = []
    for low, high in itertools.pairwise(levels):
        low_next, high_next = np.roll(low, -1, axis=0), np.roll(high, -1, axis=0)
        triangles += [np.stack([low, low_next, high_next], 1), np.stack([low, high_next, high], 1)]
    for level, upwards in ((levels[0], False), (levels[-1], True)):
        middle = np.broadcast_to(level.mean(axis=0), level.shape)
        edge = (level, np.roll(level, -1, axis=0))
        triangles.append(np.stack([middle, *(edge if upwards else edge[::-1])], 1))
    return np.concatenate(triangles)


def load_robot_model(profile: Profile) -> tuple[RobotModel | None, str]:
    """The robot's shapes, or why there are none: the rest can be looked at without them."""
    try:
        return RobotModel(profile), ""
    except VlaZenohError as error:
        return None, str(error)
