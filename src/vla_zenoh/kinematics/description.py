"""A robot description (URDF), read and checked before Pinocchio gets it.

Pinocchio's own reader says "does not contain a valid URDF model" for every fault and takes what is
implausible; here the joint, link or attribute is named, and what to do about it.

Source of the format: https://wiki.ros.org/urdf/XML
"""

from __future__ import annotations

import math
import xml.etree.ElementTree as ElementTree
from collections import Counter
from collections.abc import Collection, Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from vla_zenoh import resources
from vla_zenoh.errors import MissingExtraError, ProfileError, ResourceError, nearest

if TYPE_CHECKING:
    from vla_zenoh.profile import RobotProfile

MOVING = ("revolute", "prismatic", "continuous")
"""Types of joints that have one degree of freedom."""
KINDS = (*MOVING, "fixed", "floating", "planar")
SHAPES: Mapping[str, Mapping[str, int]] = {
    "box": {"size": 3},
    "sphere": {"radius": 1},
    "cylinder": {"radius": 1, "length": 1},
    "mesh": {},
}
"""Collision shapes, with how many numbers above 0 each attribute has."""
NUMBERS = frozenset({"xyz", "rpy", "size", "radius", "length", "scale", "damping", "friction"})
"""Attributes of links and joints that hold numbers and nothing else; of inertia all are, of mass
its value."""
MOST_RPY_RAD, MOST_XYZ_M = 10.0, 1e6
"""Larger angles are degrees, and larger numbers no place on this planet."""
PLACE = ("robot", "description")
COMPRESSED = (b"\x1f\x8b", b"PK\x03\x04", b"BZh", b"\xfd7zXZ")
"""How files of gzip, zip, bzip2 and xz begin."""
WORLD = "universe"
"""What Pinocchio calls that which does not move."""
TO_URDF = {
    "mujoco": "MJCF, the format of MuJoCo: `vla-zenoh profile new` makes a URDF of it",
    "sdf": "SDF, the format of Gazebo: give the maker's URDF",
    "COLLADA": "a mesh (COLLADA): give the URDF that names it",
    "srdf": "an SRDF, which only adds to a description: give the URDF",
}
XACRO = (
    "is a xacro, a template: expand it, as `xacrodoc {name} -s -o {stem}.urdf` "
    "(pip install xacrodoc)"
)


class Mimic(NamedTuple):
    """A joint follows another one: ``position = multiplier * position of joint + offset``."""

    joint: str
    multiplier: float
    offset: float


class DescribedJoint(NamedTuple):
    """A joint of a description; m and m/s where it slides, else rad and rad/s.

    Args:
        name: its name.
        kind: its type in the URDF.
        parent: link that it is attached to.
        child: link that it moves.
        offset_m: from the joint before to this one.
        axis: that it turns about or slides along, of length 1 if it moves; in its own frame.
        lower: end of its range, narrowed by the soft limit of a ``safety_controller``;
            -inf: continuous.
        upper: the other end.
        velocity: at most.
        mimic: the joint that it follows; None: it moves by itself.
    """

    name: str
    kind: str
    parent: str
    child: str
    offset_m: tuple[float, float, float]
    axis: tuple[float, float, float]
    lower: float
    upper: float
    velocity: float
    mimic: Mimic | None

    @property
    def moves(self) -> bool:
        return self.kind != "fixed"

    @property
    def unit(self) -> str:
        return "m" if self.kind == "prismatic" else "rad"


class Description:
    """Links and joints of a URDF: one tree, with every number that is needed.

    Args:
        path: the file.

    Raises:
        ResourceError: there is no such file, or it cannot be read.
        ProfileError: it is no URDF, or not one robot; says what to do.
    """

    def __init__(self, path: Path) -> None:
        self.path, self.name = path, path.name
        root = self._root()
        self.links = tuple(self._named(link, "link") for link in root.findall("link"))
        for link in root.findall("link"):
            whose = f"link {link.attrib['name']!r}"
            self._check_numbers(link, whose)
            for collision in link.findall("collision"):
                self._check_shape(collision, whose)
        found = [self._joint(joint) for joint in root.findall("joint")]
        self._check_names(found)
        self.joints: Mapping[str, DescribedJoint] = {joint.name: joint for joint in found}
        self._above = {joint.child: joint for joint in found}
        self._check_tree(found)

    def chain(self, first: str, last: str) -> tuple[DescribedJoint, ...]:
        """Joints on the way from one link to another."""
        to_first, to_last = self._to_root(first), self._to_root(last)
        inwards = [joint for joint in to_first if joint not in to_last]
        outwards = [joint for joint in to_last if joint not in to_first]
        return (*inwards, *reversed(outwards))

    def follows(self, name: str) -> Mimic:
        """How joint `name` follows the joint that moves by itself; that may be the joint itself.

        Raises:
            ProfileError: it mimics a joint that is not there, or itself in a circle.
        """
        multiplier, offset, passed = 1.0, 0.0, {name}
        leader = name
        while (mimic := self.joints[leader].mimic) is not None:
            if mimic.joint not in self.joints:
                raise self._error(
                    f"has joint {leader!r} that mimics {mimic.joint!r}, which it does not have"
                    f"{nearest(mimic.joint, self.joints)}"
                )
            if mimic.joint in passed:
                raise self._error(f"has joint {name!r} that mimics itself in a circle")
            passed.add(mimic.joint)
            offset += multiplier * mimic.offset
            multiplier *= mimic.multiplier
            leader = mimic.joint
        return Mimic(leader, multiplier, offset)

    def led_by(self, joints: Collection[str]) -> tuple[str, ...]:
        """These joints, and those that follow them."""
        return tuple(
            name
            for name, joint in self.joints.items()
            if name in joints
            or (
                joint.moves
                and joint.mimic is not None
                and joint.mimic.joint in self.joints
                and self.follows(name).joint in joints
            )
        )

    def model_name(self, joint: str) -> str:
        """Name of a joint in Pinocchio's model, which needs another one than every link has."""
        name, taken = joint, {WORLD, *self.links}
        while name in taken or (name != joint and name in self.joints):
            name += "_"
        return name

    def text(self, followers: Mapping[str, Mimic]) -> str:
        """The URDF with joints named by `model_name`, of which only `followers` mimic another.

        Those that turn without an end are angles there, too, not points of a circle.
        """
        root = self._root()
        for element in root.findall("joint"):
            name = element.attrib["name"]
            element.set("name", self.model_name(name))
            if element.get("type") == "continuous":
                element.set("type", "revolute")
                for limit in element.findall("limit"):
                    element.remove(limit)
                ElementTree.SubElement(element, "limit", effort="0", velocity="0")
            for mimic in element.findall("mimic"):
                element.remove(mimic)
            if (follows := followers.get(name)) is not None:
                attributes = {
                    "joint": self.model_name(follows.joint),
                    "multiplier": str(follows.multiplier),
                    "offset": str(follows.offset),
                }
                ElementTree.SubElement(element, "mimic", attributes)
        return ElementTree.tostring(root, encoding="unicode")

    @property
    def meshes(self) -> list[tuple[str, str]]:
        """Link and file of each collision mesh."""
        return [
            (link.attrib["name"], mesh.attrib["filename"])
            for link in self._root().findall("link")
            for mesh in link.findall("collision/geometry/mesh")
        ]

    @property
    def shapeless(self) -> list[str]:
        """Links that can be seen, and have no collision shape."""
        return [
            link.attrib["name"]
            for link in self._root().findall("link")
            if link.find("collision") is None and link.find("visual") is not None
        ]

    @property
    def root(self) -> str:
        """The link that no joint moves."""
        return next(link for link in self.links if link not in self._above)

    # -- reading ----------------------------------------------------------------------------------
    def _root(self) -> ElementTree.Element:
        try:
            data = self.path.read_bytes()
        except OSError as error:
            raise ResourceError(f"{self.path} cannot be read: {error.strerror}") from error
        if not data.strip():
            raise self._error("is empty")
        if data.startswith(COMPRESSED):
            raise self._error("is compressed: unpack it, and name the URDF in it")
        try:
            data.decode()
        except UnicodeDecodeError as error:
            line = data.count(b"\n", 0, error.start) + 1
            raise self._error(f"is not UTF-8 (line {line}): save it as UTF-8") from error
        try:
            root = ElementTree.fromstring(data)
        except ElementTree.ParseError as error:
            if b"xacro" in data:
                raise self._error(XACRO.format(name=self.name, stem=self.path.stem)) from error
            raise self._error(f"is no XML: {error}") from error
        space, _, tag = root.tag.rpartition("}")
        if tag != "robot":
            raise self._error(f"is {TO_URDF.get(tag, f'no URDF: it begins with <{tag[:40]}>')}")
        if space:
            raise self._error(f"has the namespace {space[1:]!r}: a URDF has none, remove xmlns")
        if is_xacro(root):
            raise self._error(XACRO.format(name=self.name, stem=self.path.stem))
        return root

    def _error(self, why: str) -> ProfileError:
        return ProfileError(f"{self.name} {why}", PLACE)

    def _named(self, element: ElementTree.Element, what: str) -> str:
        name = element.get("name")
        if not name:
            raise self._error(f"has a {what} without a name")
        return name

    def _joint(self, element: ElementTree.Element) -> DescribedJoint:
        name = self._named(element, "joint")
        kind = element.get("type", "")
        if kind not in KINDS:
            raise self._error(f"has joint {name!r} of type {kind!r}; types are: {', '.join(KINDS)}")
        ends: list[str] = []
        for end in ("parent", "child"):
            link = element.find(end)
            if link is None or not link.get("link"):
                raise self._error(f"has joint {name!r} without <{end} link=...>")
            ends.append(str(link.get("link")))
        whose, origin = f"joint {name!r}", element.find("origin")
        self._check_numbers(element, whose)
        x, y, z = self._vector(origin, "xyz", whose)
        self._vector(origin, "rpy", whose)
        axis = (1.0, 0.0, 0.0)
        if kind in MOVING and (given := element.find("axis")) is not None:
            x_axis, y_axis, z_axis = self._vector(given, "xyz", whose)
            length = math.hypot(x_axis, y_axis, z_axis)
            if not length:
                raise self._error(f"has joint {name!r} with an axis of length 0")
            axis = (x_axis / length, y_axis / length, z_axis / length)
        lower, upper, velocity = self._limits(element, name, kind)
        mimic = self._mimic(element.find("mimic"), whose)
        return DescribedJoint(
            name, kind, ends[0], ends[1], (x, y, z), axis, lower, upper, velocity, mimic
        )

    def _check_shape(self, collision: ElementTree.Element, whose: str) -> None:
        """Pinocchio leaves a shape out that it does not understand, and so would every barrier."""
        origin = collision.find("origin")
        self._vector(origin, "xyz", whose)
        self._vector(origin, "rpy", whose)
        geometry = collision.find("geometry")
        shapes = [] if geometry is None else list(geometry)
        if len(shapes) != 1 or shapes[0].tag not in SHAPES:
            found = ", ".join(f"<{shape.tag}>" for shape in shapes) or "nothing"
            raise self._error(
                f"has {whose} with a collision shape that is {found}; shapes are: "
                f"{', '.join(SHAPES)}. A link that must not have one needs no <collision>"
            )
        shape = shapes[0]
        if shape.tag == "mesh" and not shape.get("filename"):
            raise self._error(f"has {whose} with a collision mesh without a filename")
        if shape.tag == "mesh" and not all(self._vector(shape, "scale", whose, "1 1 1")):
            given = shape.get("scale")
            raise self._error(f"has {whose} with scale {given!r}: give three numbers other than 0")
        for attribute, count in SHAPES[shape.tag].items():
            sizes = self._numbers(shape.get(attribute, ""), attribute, whose, count)
            if min(sizes) <= 0:
                given = shape.get(attribute)
                raise self._error(f"has {whose} with {attribute} {given!r}: give metres above 0")

    def _check_numbers(self, part: ElementTree.Element, whose: str) -> None:
        """Numbers of a link or joint that nothing here needs, and Pinocchio's reader does."""
        for element in part.iter():
            for attribute, text in element.attrib.items():
                mass = element.tag == "mass" and attribute == "value"
                if not (mass or element.tag == "inertia" or attribute in NUMBERS):
                    continue
                what = element.tag if mass else attribute
                values = [self._number(each, what, whose) for each in text.split()]
                largest = max(map(abs, values), default=0.0)
                if attribute == "rpy" and largest > MOST_RPY_RAD:
                    raise self._error(
                        f"has {whose} with rpy {text[:40]!r}: a URDF is in rad, are these degrees?"
                    )
                if attribute == "xyz" and largest > MOST_XYZ_M:
                    raise self._error(
                        f"has {whose} with xyz {text[:40]!r}: a URDF is in metres, and that is far"
                    )

    def _vector(
        self,
        element: ElementTree.Element | None,
        attribute: str,
        whose: str,
        without: str = "0 0 0",
    ) -> tuple[float, float, float]:
        text = without if element is None else element.get(attribute, without)
        x, y, z = self._numbers(text, attribute, whose, 3)
        return x, y, z

    def _numbers(self, text: str, attribute: str, whose: str, count: int) -> list[float]:
        values = [self._number(each, attribute, whose) for each in text.split()]
        if len(values) != count:
            many = "three numbers" if count == 3 else "one number"
            raise self._error(f"has {whose} with {attribute} {text!r}: give {many}")
        return values

    def _number(self, text: str, attribute: str, whose: str) -> float:
        try:
            value = float(text)
        except ValueError:
            value = math.nan
        if not math.isfinite(value):
            raise self._error(f"has {whose} with {attribute} {text[:40]!r}: no number")
        return value

    def _limits(
        self, element: ElementTree.Element, name: str, kind: str
    ) -> tuple[float, float, float]:
        if kind not in MOVING:
            return 0.0, 0.0, 0.0
        limit, whose = element.find("limit"), f"joint {name!r}"
        if kind == "continuous":
            given = None if limit is None else limit.get("velocity")
            velocity = math.inf if given is None else self._number(given, "velocity", whose)
            return -math.inf, math.inf, velocity
        attributes = {} if limit is None else limit.attrib
        lacking = [each for each in ("effort", "velocity") if each not in attributes]
        if lacking:
            raise self._error(
                f"has joint {name!r} without {' and '.join(lacking)} in its <limit>: "
                "every joint that turns or slides needs lower, upper, effort and velocity"
            )
        self._number(attributes["effort"], "effort", whose)
        velocity = self._number(attributes["velocity"], "velocity", whose)
        if velocity < 0:
            raise self._error(f"has {whose} with velocity {velocity:g}: give one above 0")
        lower = self._number(attributes.get("lower", "0"), "lower", whose)
        upper = self._number(attributes.get("upper", "0"), "upper", whose)
        soft = element.find("safety_controller")
        if soft is not None and {"soft_lower_limit", "soft_upper_limit"} & soft.attrib.keys():
            low = self._number(soft.get("soft_lower_limit", "0"), "soft_lower_limit", whose)
            high = self._number(soft.get("soft_upper_limit", "0"), "soft_upper_limit", whose)
            lower, upper = max(lower, low), min(upper, high)
        return lower, upper, velocity

    def _mimic(self, element: ElementTree.Element | None, whose: str) -> Mimic | None:
        if element is None:
            return None
        leader = element.get("joint", "")
        multiplier = self._number(element.get("multiplier", "1"), "multiplier", whose)
        offset = self._number(element.get("offset", "0"), "offset", whose)
        return Mimic(leader, multiplier, offset)

    # -- checks -----------------------------------------------------------------------------------
    def _check_names(self, joints: list[DescribedJoint]) -> None:
        for what, names in (("link", self.links), ("joint", [each.name for each in joints])):
            for name, count in Counter(names).items():
                if count > 1:
                    raise self._error(f"has {count} {what}s named {name!r}")
        if not self.links:
            raise self._error("has no links")
        if WORLD in self.links:
            raise self._error(f"has a link named {WORLD!r}, which means the world: rename it")
        for joint in joints:
            for link in (joint.parent, joint.child):
                if link not in self.links:
                    raise self._error(
                        f"has joint {joint.name!r} at link {link!r}, which it does not have"
                        f"{nearest(link, self.links)}"
                    )

    def _check_tree(self, joints: list[DescribedJoint]) -> None:
        for link, count in Counter(joint.child for joint in joints).items():
            if count > 1:
                names = ", ".join(repr(each.name) for each in joints if each.child == link)
                raise self._error(
                    f"has a closed chain: joints {names} all end at link {link!r}. A URDF is a "
                    "tree: cut the loop and let the passive joints mimic a driven one"
                )
        roots = [link for link in self.links if link not in self._above]
        if len(roots) != 1:
            raise self._error(
                f"has {len(roots)} links without a joint above them ({', '.join(roots[:8])}): "
                "connect them by fixed joints, so that one root is left"
                if roots
                else "has a closed chain: no link is the root"
            )
        for link in self.links:
            self._to_root(link)

    def _to_root(self, link: str) -> tuple[DescribedJoint, ...]:
        return tuple(self._upwards(link))

    def _upwards(self, link: str) -> Iterator[DescribedJoint]:
        passed: set[str] = set()
        while link in self._above:
            if link in passed:
                raise self._error(f"has a closed chain through link {link!r}: a URDF is a tree")
            passed.add(link)
            yield self._above[link]
            link = self._above[link].parent


def is_xacro(root: ElementTree.Element) -> bool:
    """Whether links and joints are still to be made; expanded files may keep other remains."""
    parts = [element for tag in ("link", "joint") for element in root.findall(tag)]
    texts = [text for part in parts for element in part.iter() for text in element.attrib.values()]
    if any("${" in text or "$(" in text for text in texts):
        return True
    return not parts and any("xacro" in str(element.tag) for element in root.iter())


def sliding_joints(robot: RobotProfile) -> frozenset[str]:
    """Joints that slide, whose positions are m; none where the robot's description is not here."""
    try:
        joints = Description(resources.robot_urdf(robot.description)).joints
    except (ResourceError, MissingExtraError):
        return frozenset()
    arm = [joints[name] for name in robot.arm_joints if name in joints]
    return frozenset(joint.name for joint in arm if joint.unit == "m")
