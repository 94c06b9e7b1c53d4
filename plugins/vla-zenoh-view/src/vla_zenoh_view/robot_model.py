"""The profile's robot in Rerun: the visual shapes of its URDF, placed by forward kinematics.

Rerun loads meshes itself. Its own URDF loader (`rerun.urdf`) is not used: it finds the meshes of a
``package://`` path through ROS_PACKAGE_PATH alone, sends the collision shapes along, and moves
joints where the base frame and the closing of the fingers come from the profile.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import coal
import numpy as np
import pinocchio as pin
import rerun as rr

from vla_zenoh.errors import NodeError, ResourceError, VlaZenohError
from vla_zenoh.kinematics.fingers import Fingers
from vla_zenoh.kinematics.kinematics import make_kinematics
from vla_zenoh.kinematics.so3 import Pose, rotation_from_rpy
from vla_zenoh.nodes.camera.geometry import Geometry
from vla_zenoh.profile import Profile
from vla_zenoh.types import FloatArray
from vla_zenoh_view import paths

MEDIA_TYPES = {
    ".dae": "model/vnd.collada+xml",
    ".glb": "model/gltf-binary",
    ".gltf": "model/gltf+json",
    ".obj": "model/obj",
    ".stl": "model/stl",
}
CAMERA_AXIS_M, IMAGE_PLANE_M = 0.05, 0.12
"""Axes of a camera's optical frame, and how far in front of it its image is drawn."""


class RobotMeshes:
    """Shapes of the profile's robot, and the poses of their links in the base frame.

    Raises:
        ResourceError: the description or all of its shapes are missing.
        ProfileError: frames or joints that the description does not have.
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
        signs = self.kinematics.finger_signs.tolist()
        self._finger_signs = dict(zip(robot.finger_joints, signs, strict=True))
        gripper = robot.gripper
        self._fingers = gripper and Fingers(gripper, len(robot.finger_joints))
        self._shapes = _load_shapes(self.kinematics.urdf)
        links = dict.fromkeys(link for link, _, _ in self._shapes)
        self._cameras = {
            name: camera
            for name, camera in profile.cameras.items()
            if camera.mount is not None and self._model.existBodyName(camera.mount.link)
        }
        mounts = [camera.mount for camera in self._cameras.values()]
        links |= dict.fromkeys(mount.link for mount in mounts if mount is not None)
        self._frames = {link: self._model.getFrameId(link, pin.FrameType.BODY) for link in links}

    def _index(self, joint: str) -> int:
        return self._model.joints[self.kinematics.joint_id(joint)].idx_q

    def log_shapes(self, stream: rr.RecordingStream, root: str) -> None:
        """Log every shape, static below the entity of its link below `root`.

        Raises:
            ResourceError: a shape that Rerun cannot draw.
        """
        for index, (link, shape, placement) in enumerate(self._shapes):
            scaled = placement.rotation * np.asarray(shape.meshScale).ravel()
            placed = rr.Transform3D(translation=placement.translation, mat3x3=scaled)
            path = f"{paths.below(root, link)}/{index}"
            stream.log(path, placed, archetype_of(shape), static=True)

    def log_cameras(self, stream: rr.RecordingStream, root: str) -> None:
        """Log every camera that has a mount below its link: its axes, and what its lens sees."""
        for name, camera in self._cameras.items():
            assert camera.mount is not None
            mount = camera.mount
            path = f"{paths.below(root, mount.link)}/{paths.below(paths.CAMERA, name)}"
            turn = rotation_from_rpy(np.array(mount.rpy_rad))
            placed = rr.Transform3D(translation=mount.position_m, mat3x3=turn)
            stream.log(path, placed, rr.TransformAxes3D(CAMERA_AXIS_M), static=True)
            try:
                lens = Geometry(camera).intrinsics()
            except NodeError:  # a recording from another host: its file is not here
                continue
            if lens is None:
                continue
            pinhole = rr.Pinhole(
                resolution=[lens.width, lens.height],
                focal_length=[lens.fx_px, lens.fy_px],
                principal_point=[lens.cx_px, lens.cy_px],
                image_plane_distance=IMAGE_PLANE_M,
            )
            stream.log(f"{path}/lens", pinhole, static=True)

    def move(self, positions: Mapping[str, float]) -> None:
        """Set joint positions (rad, or m) by name; joints of another robot are ignored."""
        for name, value in positions.items():
            if name in self._joints:
                self._q[self._joints[name]] = value

    def open(self, width_m: float) -> None:
        """Open all fingers equally to a width."""
        if self._fingers is None:
            return
        position = self._fingers.position(width_m)
        self.move({name: sign * position for name, sign in self._finger_signs.items()})

    def placements(self) -> Iterator[tuple[str, Pose]]:
        """Every link with a shape or a camera, and its pose in the base frame."""
        pin.forwardKinematics(self._model, self._data, self._q)
        base = self.kinematics.base_placement
        for link, frame in self._frames.items():
            placement = base.actInv(pin.updateFramePlacement(self._model, self._data, frame))
            yield link, Pose(placement.translation.copy(), placement.rotation.copy())


def _load_shapes(urdf: Path) -> list[tuple[str, Any, Any]]:
    """Link, shape and its placement in the link: visual shapes, else collision shapes.

    Raises:
        ResourceError: no shape can be loaded.
    """
    model = pin.buildModelFromUrdf(str(urdf))
    folders = [str(folder) for folder in urdf.resolve().parents]
    why = "it has none"
    for kind in (pin.GeometryType.VISUAL, pin.GeometryType.COLLISION):
        try:
            found = pin.buildGeomFromUrdf(model, str(urdf), kind, package_dirs=folders)
        except (ValueError, RuntimeError) as error:
            why = str(error)
            continue
        frames = [(shape, model.frames[shape.parentFrame]) for shape in found.geometryObjects]
        if frames:
            return [
                (frame.name, shape, frame.placement.actInv(shape.placement))
                for shape, frame in frames
            ]
    raise ResourceError(f"no shape of {urdf.name} can be shown: {why}")


def archetype_of(shape: Any) -> Any:
    """What Rerun draws for a shape of Pinocchio. Raises ResourceError: Rerun cannot draw it."""
    geometry, colour = shape.geometry, [int(255 * part) for part in shape.meshColor.ravel()]
    solid: dict[str, Any] = {"colors": [colour], "fill_mode": "solid"}
    suffix = Path(shape.meshPath).suffix.lower()
    if suffix in MEDIA_TYPES:
        tint = colour if shape.overrideMaterial else None
        return rr.Asset3D(
            contents=Path(shape.meshPath).read_bytes(),
            media_type=MEDIA_TYPES[suffix],
            albedo_factor=tint,
        )
    if isinstance(geometry, coal.Box):
        return rr.Boxes3D(half_sizes=[geometry.halfSide.ravel()], **solid)
    if isinstance(geometry, coal.Sphere):
        return rr.Ellipsoids3D(half_sizes=[[geometry.radius] * 3], **solid)
    if isinstance(geometry, coal.Cylinder):
        length_m = 2 * geometry.halfLength
        return rr.Cylinders3D(lengths=[length_m], radii=[geometry.radius], **solid)
    if isinstance(geometry, coal.Capsule):  # Rerun's begins at its origin, Coal's is centred
        half_m = geometry.halfLength
        return rr.Capsules3D(
            lengths=[2 * half_m], radii=[geometry.radius], translations=[[0, 0, -half_m]], **solid
        )
    raise ResourceError(
        f"the shape {shape.name} ({suffix or type(geometry).__name__}) cannot be drawn; drawn are "
        f"{', '.join(MEDIA_TYPES)}, box, cylinder, sphere and capsule"
    )


def load_robot_model(
    profile: Profile, stream: rr.RecordingStream, root: str
) -> tuple[RobotMeshes | None, str]:
    """The arm with its shapes logged below `root`, or None and why not: all else is shown."""
    try:
        model = RobotMeshes(profile)
        model.log_shapes(stream, root)
        model.log_cameras(stream, root)
        return model, ""
    except VlaZenohError as error:
        return None, str(error)
