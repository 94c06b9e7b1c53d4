"""A robot description (URDF, xacro or MJCF) with what we need and descriptions often lack.

Joints without a velocity get one, endless joints of fingers get ends, meshes that cannot be found
are replaced by plain shapes. What was changed is said; a description that lacks nothing is used as
it is.
"""

from __future__ import annotations

import math
import tempfile
import xml.etree.ElementTree as ElementTree
import xml.parsers.expat as expat
from collections.abc import Collection, Iterator, Mapping, Sequence
from functools import cache
from pathlib import Path

import coal
import numpy as np

from vla_zenoh.errors import ProfileError, in_words
from vla_zenoh.kinematics.description import Description, is_xacro
from vla_zenoh.types import FloatArray

ENDLESS_RAD = 3.1416
"""End of the range of an endless joint of a finger, to both sides."""
SLOW_RAD_S, SLOW_M_S = 1.0, 0.1
"""Velocity of a joint that has none."""
THIN_M, THICK_M = 0.02, 0.05
"""Least and greatest radius of a shape that is made up."""
SLENDER = 0.2
"""Its radius as a share of its length."""
MESHES = (".stl", ".dae", ".obj")


class Mended:
    """A description that can be used, of a URDF, a xacro or an MJCF.

    Args:
        source: the file.
        arguments: of a xacro.
        meshes: folder for the meshes of an MJCF.

    Attributes:
        changes: what was changed and is no guess, as sentences.
        guesses: what was made up, as sentences.

    Raises:
        ResourceError: it cannot be read.
        ProfileError: it is none, or not one robot; says what to do.
    """

    def __init__(self, source: Path, arguments: Mapping[str, str], meshes: Path) -> None:
        self.source = source
        root, undeclared = _root(source)
        self.changes: list[str] = []
        if undeclared:
            marked = ", ".join(f"{prefix}:..." for prefix in undeclared)
            self.changes.append(
                f"what begins with {marked} is left out: the file does not declare the XML prefix "
                "(xmlns); joints and links are not affected"
            )
        if root is not None and root.tag == "mujoco":
            from vla_zenoh_newarm.mjcf import FromMjcf

            made = FromMjcf(source, meshes)
            self._robot = made.robot
            self.changes += made.changes
        elif root is not None and is_xacro(root):
            self._robot = _expanded(source, arguments)
            self.changes.append(f"{source.name} is a xacro: it was expanded")
        else:
            self._robot = _robot(source, root)
        self.guesses = [*_give_velocities(self._robot), *_give_shapes(self._robot, source)]

    def described(self) -> Description:
        """Its links and joints."""
        if not (self.changes or self.guesses):
            return Description(self.source)
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / self.source.name
            self._write(path)
            return Description(path)

    def complete(self, arm: Collection[str], fingers: Collection[str]) -> None:
        """Give those joints that turn endlessly a velocity, and those of `fingers` ends."""
        endless = list(_give_ends(self._robot, fingers))
        if endless:
            self.changes.append(f"{', '.join(endless)}: endless, here from -pi to pi")
        self.guesses += _give_velocities(self._robot, {*arm, *fingers})

    def save(self, copy: Path) -> Path:
        """The description to use: the given file, or where something was changed, a copy."""
        if not (self.changes or self.guesses):
            return self.source
        self._write(copy)
        return copy

    def _write(self, path: Path) -> None:
        _name_meshes(self._robot, self.source, path.parent)
        path.write_text(ElementTree.tostring(self._robot, encoding="unicode"), "utf-8")


def _root(source: Path) -> tuple[ElementTree.Element | None, Sequence[str]]:
    """The outermost element of a file, and prefixes in it that no namespace was declared for.

    None: there is no element, and the reader of URDFs says why.
    """
    try:
        return ElementTree.parse(source).getroot(), ()
    except OSError:
        return None, ()
    except ElementTree.ParseError:
        return _without_prefixes(source)


def _without_prefixes(source: Path) -> tuple[ElementTree.Element | None, Sequence[str]]:
    """The same where prefixes mean nothing, as ROS's reader of URDFs takes them."""
    builder, prefixes = ElementTree.TreeBuilder(), dict[str, None]()

    def start(tag: str, attributes: dict[str, str]) -> None:
        known = {name: value for name, value in attributes.items() if ":" not in name}
        prefixes.update((name.split(":")[0], None) for name in (tag, *attributes) if ":" in name)
        builder.start(tag, known)

    parser = expat.ParserCreate()
    parser.StartElementHandler, parser.EndElementHandler = start, builder.end
    try:
        parser.Parse(source.read_bytes(), True)
        root = builder.close()
        for parent in list(root.iter()):
            for child in [each for each in parent if ":" in each.tag]:
                parent.remove(child)
        return root, [prefix for prefix in prefixes if prefix != "xmlns"]
    except (expat.ExpatError, AssertionError):
        return None, ()


def _robot(source: Path, root: ElementTree.Element | None) -> ElementTree.Element:
    if root is None or root.tag != "robot":
        Description(source)  # says what it is instead
        raise ProfileError(f"{source.name} is no URDF")
    return root


def _expanded(source: Path, arguments: Mapping[str, str]) -> ElementTree.Element:
    """The URDF that a xacro stands for."""
    try:
        from xacrodoc import XacroDoc

        made = XacroDoc.from_file(str(source), subargs=dict(arguments))
        return ElementTree.fromstring(str(made.to_urdf_string(use_protocols=False)))
    except Exception as error:
        raise ProfileError(
            f"{source.name} is a xacro and cannot be expanded: {in_words(error)}. Give its "
            "arguments with --set name=value; packages are looked for in the folders above it"
        ) from error


# -- joints ---------------------------------------------------------------------------------------
def _give_ends(robot: ElementTree.Element, joints: Collection[str]) -> Iterator[str]:
    """Names of those of `joints` that turned endlessly."""
    for joint in robot.findall("joint"):
        if joint.get("type") != "continuous" or joint.get("name") not in joints:
            continue
        joint.set("type", "revolute")
        limit = _limit(joint)
        limit.set("lower", str(-ENDLESS_RAD))
        limit.set("upper", str(ENDLESS_RAD))
        yield str(joint.get("name"))


def _give_velocities(robot: ElementTree.Element, endless: Collection[str] = ()) -> Iterator[str]:
    """Of joints with a range, and of those that are `endless`."""
    lacking: list[str] = []
    for joint in robot.findall("joint"):
        given = joint.get("type") in ("revolute", "prismatic")
        if not given and not (joint.get("type") == "continuous" and joint.get("name") in endless):
            continue
        limit = _limit(joint)
        limit.set("effort", limit.get("effort", "10"))
        if _number(limit.get("velocity")) > 0:
            continue
        slides = joint.get("type") == "prismatic"
        limit.set("velocity", str(SLOW_M_S if slides else SLOW_RAD_S))
        lacking.append(str(joint.get("name")))
    if lacking:
        yield (
            f"velocity of {', '.join(lacking)}: {SLOW_RAD_S:g} rad/s ({SLOW_M_S:g} m/s where it "
            "slides), since the description has none"
        )


def _limit(joint: ElementTree.Element) -> ElementTree.Element:
    found = joint.find("limit")
    return ElementTree.SubElement(joint, "limit") if found is None else found


def _number(text: str | None) -> float:
    try:
        return float(text or "0")
    except ValueError:
        return math.nan  # the reader of descriptions names it


# -- shapes ---------------------------------------------------------------------------------------
def _give_shapes(robot: ElementTree.Element, source: Path) -> Iterator[str]:
    """Shapes for links whose meshes are not there, and for all where no link has one."""
    links = robot.findall("link")
    if not any(link.findall("collision") for link in links):
        for link in links:
            for visual in link.findall("visual"):
                collision = ElementTree.SubElement(link, "collision")
                collision.extend(visual.findall("origin") + visual.findall("geometry"))
        moved = {child.get("link") for child in robot.findall("joint/child")}
        bare = [link for link in links if link.get("name") in moved]
        bare = [link for link in bare if not link.findall("collision")]
    else:
        bare = []
    missing: list[str] = []
    for link in links:
        meshes = link.findall("collision/geometry/mesh")
        if link in bare or any(_mesh(mesh.get("filename", ""), source) is None for mesh in meshes):
            for collision in link.findall("collision"):
                link.remove(collision)
            ends = list(_ends(robot, str(link.get("name"))))
            if link not in bare and not ends:
                ends = [np.zeros(3)]
            link.extend(_plain_shape(end) for end in ends)
            missing += [str(link.get("name"))] if ends else []
    if missing:
        yield (
            f"shapes of {', '.join(missing)}: cylinders from joint to joint, since their meshes "
            "cannot be read"
        )


def _ends(robot: ElementTree.Element, link: str) -> Iterator[FloatArray]:
    """Where the joints of a link are that is on the way to others."""
    for joint in robot.findall("joint"):
        parent, origin = joint.find("parent"), joint.find("origin")
        if parent is None or parent.get("link") != link:
            continue
        text = "0 0 0" if origin is None else origin.get("xyz", "0 0 0")
        yield np.array([_number(word) for word in text.split()])


def _plain_shape(end: FloatArray) -> ElementTree.Element:
    """A cylinder from the origin of a link to `end`, or a ball there if that is near."""
    length_m = float(np.linalg.norm(end))
    radius_m = min(max(SLENDER * length_m, THIN_M), THICK_M)
    collision = ElementTree.Element("collision")
    geometry = ElementTree.SubElement(collision, "geometry")
    if not length_m > radius_m:
        ElementTree.SubElement(geometry, "sphere", radius=str(radius_m))
        return collision
    ElementTree.SubElement(geometry, "cylinder", radius=str(radius_m), length=str(length_m))
    x, y, z = (end / length_m).tolist()
    pitch, yaw = math.acos(max(-1.0, min(1.0, z))), math.atan2(y, x)
    middle = " ".join(map(str, (end / 2).tolist()))
    ElementTree.SubElement(collision, "origin", xyz=middle, rpy=f"0 {pitch} {yaw}")
    return collision


def _mesh(name: str, source: Path) -> Path | None:
    """The file of a mesh, looked for as Pinocchio does; None: there is none that can be read."""
    if Path(name).suffix.lower() not in MESHES:
        return None
    kind, _, rest = name.rpartition("://")
    folders: Sequence[Path] = source.resolve().parents
    if kind == "file":
        folders, rest = [Path("/")], rest.lstrip("/")
    for folder in folders:
        if (found := folder / rest).is_file():
            return found if _is_readable(found) else None
    return None


@cache
def _is_readable(file: Path) -> bool:
    try:
        coal.MeshLoader().load(str(file), np.ones(3))
    except (RuntimeError, ValueError):
        return False
    return True


def _name_meshes(robot: ElementTree.Element, source: Path, folder: Path) -> None:
    """Name every mesh below `folder`, where the copy is, from there: both may be moved together.

    Any other gets the whole path of its file.
    """
    for mesh in robot.iter("mesh"):
        found = _mesh(mesh.get("filename", ""), source)
        if found is None:
            continue
        inside = found.is_relative_to(folder.resolve())
        mesh.set(
            "filename",
            f"package://{found.relative_to(folder.resolve())}" if inside else str(found),
        )
