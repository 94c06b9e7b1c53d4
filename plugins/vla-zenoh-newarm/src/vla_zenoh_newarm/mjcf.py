"""A URDF of an MJCF: links, joints, inertias and shapes of the model that MuJoCo compiles of it.

Sources: MuJoCo's documentation, "XML Reference" and "Kinematic tree"; https://wiki.ros.org/urdf/XML
"""

from __future__ import annotations

import math
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from vla_zenoh.errors import ProfileError
from vla_zenoh.types import FloatArray

KINDS = {mujoco.mjtJoint.mjJNT_HINGE: "revolute", mujoco.mjtJoint.mjJNT_SLIDE: "prismatic"}
LEFT_OUT = {"actuator": "nu", "sensor": "nsensor", "tendon": "ntendon", "camera": "ncam"}
"""What a URDF has no place for, with the sizes of a model that count it."""
EFFORT = "10"
"""Of a joint: a URDF needs a number, and nothing here uses it."""
STL_TRIANGLE = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])


class FromMjcf:
    """The URDF of an MJCF, with the links, joint positions and frames that MuJoCo computes.

    Args:
        source: the MJCF.
        meshes: folder that meshes are written into, as STL.

    Attributes:
        robot: the URDF.
        changes: what the MJCF has and the URDF has otherwise or not at all, as sentences.

    Raises:
        ProfileError: MuJoCo cannot compile it, or a URDF cannot have one of its joints.
    """

    def __init__(self, source: Path, meshes: Path) -> None:
        self._name, self._meshes = source.name, meshes.resolve()
        try:
            self._model: Any = mujoco.MjModel.from_xml_path(str(source))
        except ValueError as error:
            raise ProfileError(
                f"MuJoCo cannot compile {source.name}: {' '.join(str(error).split())}. Its meshes "
                "and what it includes must be where it names them"
            ) from error
        self.changes = [f"{source.name} is MJCF: it was made a URDF, with MuJoCo's numbers"]
        self.robot = ElementTree.Element("robot", name=source.stem)
        self._link_names: set[str] = set()
        self._joint_names: set[str] = set()
        self._bodies = self._kept()
        self._links = {
            body: _new(self._link_names, self._model.body(body).name or f"body_{body}")
            for body in self._bodies
        }
        self._joints = {
            joint: _new(self._joint_names, self._model.joint(joint).name or f"{link}_joint")
            for body, link in self._links.items()
            for joint in self._own_joints(body)
        }
        for body in self._bodies:
            self._add_body(body)
        for site in range(self._model.nsite):
            self._add_site(site)
        self._follow()
        self._name_left_out()

    # -- which bodies -----------------------------------------------------------------------------
    def _kept(self) -> list[int]:
        """Bodies of the arm, the root first: the world, or the one body that carries all."""
        model = self._model
        trees = [body for body in range(1, model.nbody) if model.body_parentid[body] == 0]
        moving = [body for body in trees if any(self._own_joints(each) for each in self._of(body))]
        if not moving:
            raise ProfileError(f"{self._name} has no joint that moves: it is no arm")
        standing = [body for body in moving if not self._is_free(body)] or moving[:1]
        if left := [body for body in trees if body not in standing]:
            names = ", ".join(model.body(body).name or f"body_{body}" for body in left)
            self.changes.append(f"left out, as they stand or lie beside the arm: {names}")
        if self._is_free(standing[0]):
            name = model.body(standing[0]).name
            self.changes.append(f"{name}: moves freely in the MJCF, here it stands still")
        kept = [each for body in standing for each in self._of(body)]
        carried = len(standing) == 1 and not self._own_joints(standing[0])
        return kept if carried else [0, *kept]

    def _of(self, root: int) -> list[int]:
        """A body and all that hang on it, parents first."""
        found = [root]
        for body in range(root + 1, self._model.nbody):
            if self._model.body_parentid[body] in found:
                found.append(body)
        return found

    def _all_joints(self, body: int) -> range:
        first = int(self._model.body_jntadr[body])
        return range(first, first + int(self._model.body_jntnum[body]))

    def _own_joints(self, body: int) -> list[int]:
        """Joints of a body but the one that lets it move freely."""
        free = mujoco.mjtJoint.mjJNT_FREE
        return [each for each in self._all_joints(body) if self._model.jnt_type[each] != free]

    def _is_free(self, body: int) -> bool:
        return len(self._own_joints(body)) < len(self._all_joints(body))

    # -- links and joints -------------------------------------------------------------------------
    def _add_body(self, body: int) -> None:
        model, name = self._model, self._links[body]
        link = ElementTree.SubElement(self.robot, "link", name=name)
        if model.body_mass[body] > 0:
            self._add_inertia(link, body)
        first = int(model.body_geomadr[body])
        for geom in range(first, first + int(model.body_geomnum[body])):
            self._add_geom(link, geom)
        if body == self._bodies[0]:
            return
        parent = self._links[int(model.body_parentid[body])]
        way = _pose(model.body_pos[body], model.body_quat[body])
        joints = self._own_joints(body)
        for joint in joints:
            anchor = _pose(model.jnt_pos[joint])
            # A link whose frame is not in its joint hangs on one that is.
            last = joint == joints[-1] and not model.jnt_pos[joint].any()
            child = name if last else _new(self._link_names, f"{self._joints[joint]}_moved")
            if not last:
                ElementTree.SubElement(self.robot, "link", name=child)
            self._add_joint(joint, parent, child, way @ anchor)
            if last:
                return
            way, parent = _pose(-model.jnt_pos[joint]), child
        self._fix(parent, name, way)

    def _add_joint(self, joint: int, parent: str, child: str, reference: FloatArray) -> None:
        """A joint between two links, from its place in the reference pose."""
        model, name = self._model, self._joints[joint]
        kind = KINDS.get(mujoco.mjtJoint(model.jnt_type[joint]))
        if kind is None:
            raise ProfileError(
                f"{self._name} has ball joint {name!r}, which a URDF has not: give it hinges in "
                "a copy, or remove it"
            )
        limited = bool(model.jnt_limited[joint])
        if kind == "prismatic" and not limited:
            self.changes.append(f"{name}: slides endlessly, here it stands still")
            self._joint(name, "fixed", parent, child, reference)
            del self._joints[joint]
            return
        axis = model.jnt_axis[joint]
        origin = reference @ _moved(kind, axis, -self._reference(joint))
        kind = kind if limited else "continuous"
        made = self._joint(name, kind, parent, child, origin)
        ElementTree.SubElement(made, "axis", xyz=_text(axis))
        limit = {"effort": EFFORT, "velocity": "0"}  # an MJCF has none: one is guessed later
        if limited:
            limit["lower"], limit["upper"] = map(repr, model.jnt_range[joint].tolist())
        ElementTree.SubElement(made, "limit", limit)

    def _reference(self, joint: int) -> float:
        """Position of a joint in the pose that the MJCF describes."""
        return float(self._model.qpos0[self._model.jnt_qposadr[joint]])

    def _fix(self, parent: str, child: str, way: FloatArray) -> None:
        name = _new(self._joint_names, f"{child}_fixed")
        self._joint(name, "fixed", parent, child, way)

    def _joint(
        self, name: str, kind: str, parent: str, child: str, origin: FloatArray
    ) -> ElementTree.Element:
        made = ElementTree.SubElement(self.robot, "joint", name=name, type=kind)
        ElementTree.SubElement(made, "parent", link=parent)
        ElementTree.SubElement(made, "child", link=child)
        _add_origin(made, origin)
        return made

    def _add_inertia(self, link: ElementTree.Element, body: int) -> None:
        model = self._model
        inertial = ElementTree.SubElement(link, "inertial")
        _add_origin(inertial, _pose(model.body_ipos[body], model.body_iquat[body]))
        ElementTree.SubElement(inertial, "mass", value=repr(float(model.body_mass[body])))
        moments = map(repr, model.body_inertia[body].tolist())
        principal = dict(zip(("ixx", "iyy", "izz"), moments, strict=True))
        rest = dict.fromkeys(("ixy", "ixz", "iyz"), "0")
        ElementTree.SubElement(inertial, "inertia", {**principal, **rest})

    def _add_site(self, site: int) -> None:
        """A link for a named place on a body, such as that of a TCP."""
        model = self._model
        body, name = int(model.site_bodyid[site]), model.site(site).name
        if not name or body not in self._links:
            return
        link = _new(self._link_names, name)
        ElementTree.SubElement(self.robot, "link", name=link)
        way = _pose(model.site_pos[site], model.site_quat[site])
        self._fix(self._links[body], link, way)

    # -- shapes -----------------------------------------------------------------------------------
    def _add_geom(self, link: ElementTree.Element, geom: int) -> None:
        """What can touch is a collision shape; the rest is only seen."""
        model = self._model
        touches = bool(model.geom_contype[geom] or model.geom_conaffinity[geom])
        tag = "collision" if touches else "visual"
        place = _pose(model.geom_pos[geom], model.geom_quat[geom])
        for way_m, shape, sizes in self._shapes(geom):
            element = ElementTree.SubElement(link, tag)
            _add_origin(element, place @ _pose([0.0, 0.0, way_m]))
            geometry = ElementTree.SubElement(element, "geometry")
            ElementTree.SubElement(geometry, shape, sizes)

    def _shapes(self, geom: int) -> Iterator[tuple[float, str, dict[str, str]]]:
        """Shapes of a URDF that a geom is: how far along its z-axis, which, and its sizes."""
        model, kinds = self._model, mujoco.mjtGeom
        kind = mujoco.mjtGeom(model.geom_type[geom])
        a_m, b_m, _ = sizes_m = model.geom_size[geom].tolist()
        if kind == kinds.mjGEOM_SPHERE:
            yield 0.0, "sphere", {"radius": repr(a_m)}
        elif kind in (kinds.mjGEOM_CYLINDER, kinds.mjGEOM_CAPSULE):
            yield 0.0, "cylinder", {"radius": repr(a_m), "length": repr(2 * b_m)}
            for end_m in (b_m, -b_m) if kind == kinds.mjGEOM_CAPSULE else ():
                yield end_m, "sphere", {"radius": repr(a_m)}
        elif kind in (kinds.mjGEOM_BOX, kinds.mjGEOM_ELLIPSOID):
            yield 0.0, "box", {"size": _text(2 * np.array(sizes_m))}
            if kind == kinds.mjGEOM_ELLIPSOID:
                self._note_geom(geom, "an ellipsoid, here the box around it")
        elif kind == kinds.mjGEOM_MESH:
            yield 0.0, "mesh", {"filename": str(self._mesh(int(model.geom_dataid[geom])))}
        else:
            self._note_geom(geom, "a plane or field, left out")

    def _note_geom(self, geom: int, what: str) -> None:
        name = self._model.geom(geom).name
        body = self._links[int(self._model.geom_bodyid[geom])]
        self.changes.append(f"shape {name or geom} of {body}: {what}")

    def _mesh(self, mesh: int) -> Path:
        """File of a mesh, as MuJoCo has turned and scaled it."""
        file = self._meshes / f"{mesh}.stl"
        if not file.exists():
            model = self._model
            first, count = int(model.mesh_vertadr[mesh]), int(model.mesh_vertnum[mesh])
            corners_m = model.mesh_vert[first : first + count]
            face, faces = int(model.mesh_faceadr[mesh]), int(model.mesh_facenum[mesh])
            triangles = np.zeros(faces, STL_TRIANGLE)
            triangles["corners"] = corners_m[model.mesh_face[face : face + faces]]
            self._meshes.mkdir(parents=True, exist_ok=True)
            counted = np.uint32(faces).tobytes()
            file.write_bytes(bytes(80) + counted + triangles.tobytes())
        return file

    # -- what holds joints and bodies together ----------------------------------------------------
    def _follow(self) -> None:
        """Let joints follow others as the MJCF's equalities make them."""
        model = self._model
        made = {joint.get("name"): joint for joint in self.robot.findall("joint")}
        leaders: dict[int, int] = {}
        for equality in range(model.neq):
            name = model.equality(equality).name or f"{equality}"
            if not model.eq_active0[equality]:
                continue
            if model.eq_type[equality] != mujoco.mjtEq.mjEQ_JOINT:
                self.changes.append(f"equality {name}: left out, a URDF has none but of two joints")
                continue
            follower, leader = int(model.eq_obj1id[equality]), int(model.eq_obj2id[equality])
            if follower not in self._joints:
                continue
            constant, slope, *curve = model.eq_data[equality, :5].tolist()
            if leader not in self._joints or any(curve) or _leads(leaders, follower, leader):
                self.changes.append(f"equality {name}: left out, it is no line through two joints")
                continue
            leaders[follower] = leader
            offset = self._reference(follower) + constant - slope * self._reference(leader)
            how = {"multiplier": repr(slope), "offset": repr(offset)}
            joint = made[self._joints[follower]]
            ElementTree.SubElement(joint, "mimic", {"joint": self._joints[leader], **how})

    def _name_left_out(self) -> None:
        counts = {what: int(getattr(self._model, size)) for what, size in LEFT_OUT.items()}
        found = [f"{count} {what}{'s'[: count > 1]}" for what, count in counts.items() if count]
        if found:
            self.changes.append(f"left out, a URDF has none: {', '.join(found)}")


def _leads(leaders: Mapping[int, int], joint: int, other: int) -> bool:
    """Whether a joint follows one already, or is what the other one follows."""
    while other in leaders and other != joint:
        other = leaders[other]
    return joint in leaders or other == joint


def _new(taken: set[str], wanted: str) -> str:
    """A name that is not taken, which is then."""
    while wanted in taken:
        wanted += "_"
    taken.add(wanted)
    return wanted


def _pose(
    position_m: Sequence[float] | FloatArray, quat_wxyz: FloatArray | None = None
) -> FloatArray:
    """(4, 4) transform."""
    pose = np.eye(4)
    pose[:3, 3] = position_m
    if quat_wxyz is not None:
        rotation = np.empty(9)
        mujoco.mju_quat2Mat(rotation, quat_wxyz)
        pose[:3, :3] = rotation.reshape(3, 3)
    return pose


def _moved(kind: str, axis: FloatArray, position: float) -> FloatArray:
    """(4, 4) transform of a joint at a position, m or rad."""
    if kind == "prismatic":
        return _pose(position * axis)
    quat_wxyz = np.empty(4)
    mujoco.mju_axisAngle2Quat(quat_wxyz, axis, position)
    return _pose(np.zeros(3), quat_wxyz)


def _add_origin(element: ElementTree.Element, pose: FloatArray) -> None:
    rotation = pose[:3, :3]
    pitch = math.atan2(-rotation[2, 0], math.hypot(rotation[0, 0], rotation[1, 0]))
    yaw = math.atan2(rotation[1, 0], rotation[0, 0])
    # What is left once yaw is taken off: exact where pitch is a right angle, too.
    sine, cosine = math.sin(yaw), math.cos(yaw)
    across = cosine * rotation[1] - sine * rotation[0]
    roll = math.atan2(-across[2], across[1])
    angles = {"xyz": _text(pose[:3, 3]), "rpy": _text([roll, pitch, yaw])}
    ElementTree.SubElement(element, "origin", angles)


def _text(values: Sequence[float] | FloatArray) -> str:
    return " ".join(repr(float(value)) for value in values)
