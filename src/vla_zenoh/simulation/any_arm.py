"""Any arm for the simulator, from its URDF alone: its joints and masses, and the barriers' shapes.

MuJoCo reads neither COLLADA meshes nor ``package://``; the shapes are those that Pinocchio reads
for the collision barriers, so that the simulator shows and touches what the command node avoids.
"""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from collections.abc import Collection, Sequence
from typing import Any

import coal
import mujoco
import numpy as np

from vla_zenoh.errors import ResourceError
from vla_zenoh.kinematics.collision import collision_shapes
from vla_zenoh.kinematics.description import DescribedJoint, Description
from vla_zenoh.kinematics.kinematics import Kinematics
from vla_zenoh.types import FloatArray

LEAST_MASS_KG, LEAST_INERTIA_KG_M2 = 1e-3, 1e-6
"""MuJoCo needs some of both in all that moves, and descriptions of thin parts have none."""
MUJOCO_WORLD = "world"
"""A link of this name would be lost: it is what MuJoCo calls that which does not move."""


def arm_spec(kinematics: Kinematics, fingers: Sequence[str]) -> mujoco.MjSpec:
    """The arm with its base frame at the origin; joints that are not commanded are fixed.

    Args:
        kinematics: of the arm.
        fingers: joints of the gripper, which move as well.

    Raises:
        ResourceError: a joint follows another one between base and TCP, or the shapes cannot be
            loaded.
    """
    described = kinematics.described
    if kinematics.followers:
        raise ResourceError(
            f"the simulator cannot move {', '.join(kinematics.followers)} of {described.name}, "
            "which the description lets follow a joint of the arm (mimic)"
        )
    hand = described.led_by(fingers)
    moving = {*kinematics.arm_joints, *hand}
    spec = mujoco.MjSpec.from_string(_bare(described, moving))
    spec.compiler.fusestatic = False  # links keep their names and frames
    spec.compiler.balanceinertia = True
    spec.compiler.boundmass = LEAST_MASS_KG
    spec.compiler.boundinertia = LEAST_INERTIA_KG_M2
    for name, joint in described.joints.items():
        if joint.moves and name not in moving:
            _fix(spec, joint, kinematics.stands_at(name))
    base = kinematics.base_placement.inverse()
    spec.bodies[1].pos = base.translation
    spec.bodies[1].quat = _quat_wxyz(base.rotation)
    _add_shapes(spec, kinematics)
    for name in set(hand) - set(fingers):
        leader, multiplier, offset = described.follows(name)
        line = np.zeros(mujoco.mjNEQDATA)
        line[:2] = offset, multiplier
        spec.add_equality(
            type=mujoco.mjtEq.mjEQ_JOINT,
            objtype=mujoco.mjtObj.mjOBJ_JOINT,
            name1=name,
            name2=leader,
            data=line,
        )
    for index, name in enumerate(kinematics.arm_joints):
        made = spec.joint(name)
        made.limited = not kinematics.endless[index]
        if made.limited:
            made.range = kinematics.lower_rad[index], kinematics.upper_rad[index]
    for name in moving:
        # Of the effort of a description, which is often made up, an arm would fall.
        spec.joint(name).actfrclimited = mujoco.mjtLimited.mjLIMITED_FALSE
    return spec


def _bare(described: Description, moving: Collection[str]) -> str:
    """The URDF without shapes and extensions, in which only the joints `moving` move."""
    found = ElementTree.parse(described.path).getroot()
    bare = ElementTree.Element("robot", name="arm")
    for link in found.findall("link"):
        name = link.attrib["name"]
        made = ElementTree.SubElement(bare, "link", name=_link(name))
        if any(joint.name in moving for joint in described.chain(described.root, name)):
            made.extend(each for each in link.findall("inertial") if _is_possible(each))
    for joint in found.findall("joint"):
        name = joint.attrib["name"]
        kind = joint.attrib["type"] if name in moving else "fixed"
        made = ElementTree.SubElement(bare, "joint", name=name, type=kind)
        for tag in ("origin", "axis", "limit"):
            made.extend(joint.findall(tag))
        for end in ("parent", "child"):
            link = getattr(described.joints[name], end)
            ElementTree.SubElement(made, end, link=_link(link))
    return ElementTree.tostring(bare, encoding="unicode")


def _is_possible(inertial: ElementTree.Element) -> bool:
    """Whether a body can have this inertia; without one MuJoCo takes that of the shapes."""
    found = inertial.find("inertia")
    if found is None:
        return False
    xx, xy, xz, yy, yz, zz = (
        float(found.get(name, "0")) for name in ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
    )
    return bool(np.linalg.eigvalsh([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])[0] > 0)


def _link(name: str) -> str:
    return f"{MUJOCO_WORLD}_link" if name == MUJOCO_WORLD else name


def _fix(spec: mujoco.MjSpec, joint: DescribedJoint, position: float) -> None:
    """Let a joint that does not move stand at `position`, m or rad."""
    body = spec.body(_link(joint.child))
    axis = np.array(joint.axis)
    quat_wxyz = np.array(body.quat)
    if joint.kind == "prismatic":
        way_m = np.empty(3)
        mujoco.mju_rotVecQuat(way_m, axis * position, quat_wxyz)
        body.pos = body.pos + way_m
        return
    mujoco.mju_quatIntegrate(quat_wxyz, axis, position)
    body.quat = quat_wxyz


def _add_shapes(spec: mujoco.MjSpec, kinematics: Kinematics) -> None:
    frames = kinematics.full_model.frames
    shapes = collision_shapes(kinematics.full_model, kinematics.urdf).geometryObjects
    for index, shape in enumerate(shapes):
        frame = frames[shape.parentFrame]
        placement = frame.placement.inverse() * shape.placement
        geom = spec.body(_link(frame.name)).add_geom(
            pos=placement.translation, quat=_quat_wxyz(placement.rotation)
        )
        _set_shape(spec, geom, shape, f"shape{index}")


def _set_shape(spec: mujoco.MjSpec, geom: Any, shape: Any, name: str) -> None:
    solid = shape.geometry
    if isinstance(solid, coal.Box):
        geom.type, geom.size = mujoco.mjtGeom.mjGEOM_BOX, solid.halfSide
    elif isinstance(solid, coal.Sphere):
        geom.type, geom.size = mujoco.mjtGeom.mjGEOM_SPHERE, [solid.radius, 0.0, 0.0]
    elif isinstance(solid, coal.Cylinder):
        geom.type = mujoco.mjtGeom.mjGEOM_CYLINDER
        geom.size = [solid.radius, solid.halfLength, 0.0]
    elif isinstance(solid, coal.BVHModelBase):
        vertices = np.array(solid.vertices())
        spec.add_mesh(name=name, uservert=vertices.ravel())
        geom.type, geom.meshname = mujoco.mjtGeom.mjGEOM_MESH, name
    else:
        raise ResourceError(f"the simulator has no shape like {type(solid).__name__}")


def _quat_wxyz(rotation: FloatArray) -> FloatArray:
    quat_wxyz = np.empty(4)
    mujoco.mju_mat2Quat(quat_wxyz, np.ascontiguousarray(rotation).ravel())
    return quat_wxyz
