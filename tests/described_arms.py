"""Small descriptions of arms as their makers write them, each made from a few rows.

No file of a maker is among them: the shapes are spheres and the numbers are rounded; what is like
theirs is the structure, with the traps that it has.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import NamedTuple

import numpy as np

from vla_zenoh.profile import JointEnds
from vla_zenoh.types import FloatArray

X, Y, Z = (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)
Vector = tuple[float, float, float]


class Row(NamedTuple):
    """A joint and the link that it moves.

    Args:
        name: of the joint.
        parent: link; "": the one of the row before.
        child: link; "": ``NAME_link``.
        kind: its type.
        axis: in the frame of the joint.
        at_m: its origin.
        ends: of its range.
        velocity: its limit.
        mimic: joint, multiplier and offset.
        inside: more elements of the joint.
        limit: replaces the whole element ``limit``.
    """

    name: str
    at_m: Vector = (0.0, 0.0, 0.2)
    axis: Vector = Z
    kind: str = "revolute"
    parent: str = ""
    child: str = ""
    ends: tuple[float, float] = (-2.5, 2.5)
    velocity: float = 2.0
    mimic: tuple[str, float, float] | None = None
    inside: str = ""
    limit: str | None = None

    @property
    def link(self) -> str:
        return self.child or f"{self.name}_link"


def parents(rows: list[Row]) -> list[str]:
    """The parent link of each row."""
    before = ["base", *(row.link for row in rows)]
    return [row.parent or link for row, link in zip(rows, before, strict=False)]


def urdf(rows: list[Row], shapes: bool = True) -> str:
    """The description as a text."""
    shape = '<collision><geometry><sphere radius="0.02"/></geometry></collision>' if shapes else ""
    links = dict.fromkeys(["base", *(row.link for row in rows)])
    parts = [f'<link name="{link}">{shape}</link>' for link in links]
    for row, parent in zip(rows, parents(rows), strict=True):
        low, high = row.ends
        limit = (
            f'<limit lower="{low}" upper="{high}" velocity="{row.velocity}" effort="10"/>'
            if row.limit is None
            else row.limit
        )
        mimic = ""
        if row.mimic is not None:
            joint, multiplier, offset = row.mimic
            mimic = f'<mimic joint="{joint}" multiplier="{multiplier}" offset="{offset}"/>'
        x, y, z = row.at_m
        parts.append(
            f'<joint name="{row.name}" type="{row.kind}"><parent link="{parent}"/>'
            f'<child link="{row.link}"/><origin xyz="{x} {y} {z}"/>'
            f'<axis xyz="{" ".join(map(str, row.axis))}"/>'
            f"{limit if row.kind != 'fixed' else ''}{mimic}{row.inside}</joint>"
        )
    return f'<?xml version="1.0"?><robot name="made">{"".join(parts)}</robot>'


def tcp_in_base(rows: list[Row], link: str, positions: dict[str, float]) -> FloatArray:
    """(4, 4) pose of a link by the product of its joints' transforms; an oracle of its own."""
    above = {row.link: (row, parent) for row, parent in zip(rows, parents(rows), strict=True)}
    pose = np.eye(4)
    while link in above:
        row, link = above[link]
        pose = _moved(row, _position(rows, row, positions)) @ pose
    return pose


def _position(rows: list[Row], row: Row, positions: dict[str, float]) -> float:
    if row.mimic is None:
        return positions.get(row.name, 0.0)
    leader, multiplier, offset = row.mimic
    found = next(each for each in rows if each.name == leader)
    return multiplier * _position(rows, found, positions) + offset


def _moved(row: Row, position: float) -> FloatArray:
    pose = np.eye(4)
    pose[:3, 3] = row.at_m
    axis = np.array(row.axis)
    if row.kind == "prismatic":
        pose[:3, 3] += axis * position
    elif row.kind != "fixed":
        cross = np.cross(np.eye(3), axis)  # times v: axis x v
        turn = np.eye(3) + np.sin(position) * cross + (1 - np.cos(position)) * cross @ cross
        pose[:3, :3] = turn
    return pose


def arm(axes: str, **changed: Row) -> list[Row]:
    """Joints ``j1``, ``j2``, ... about the given axes; `changed` replaces some of them."""
    known = {"x": X, "y": Y, "z": Z}
    rows = [Row(f"j{n}", axis=known[axis]) for n, axis in enumerate(axes, 1)]
    return [changed.get(row.name, row) for row in rows]


TOOL = Row("tool", at_m=(0.0, 0.0, 0.1), kind="fixed", child="tcp")
SIX, SEVEN = "zyyxyx", "zyzyzyz"
JOINTS_6 = tuple(f"j{n}" for n in range(1, 7))
JOINTS_7 = tuple(f"j{n}" for n in range(1, 8))
SLIDE = Row("lift", axis=Z, kind="prismatic", ends=(0.0, 0.4), velocity=0.1)


def finger(name: str, low: float, high: float, **more: object) -> Row:
    """A finger that slides, at the link of joint 6."""
    return Row(name, axis=Y, kind="prismatic", parent="j6_link", ends=(low, high), **more)  # type: ignore[arg-type]


NOTHING: Mapping[str, float] = MappingProxyType({})


class Taken(NamedTuple):
    """A description that is taken, and what it means.

    Args:
        rows: its joints.
        joints: that are commanded.
        locked: of joints between base and TCP.
        fingers: of the hand.
        signs: of these.
        base: frame of the poses.
        ends: of the fingers, by the profile.
    """

    rows: list[Row]
    joints: tuple[str, ...] = JOINTS_6
    locked: Mapping[str, float] = NOTHING
    fingers: tuple[str, ...] = ()
    signs: tuple[float, ...] = ()
    base: str = "base"
    ends: JointEnds | None = None


TAKEN: dict[str, Taken] = {
    "six joints": Taken([*arm(SIX), TOOL]),
    "seven joints": Taken([*arm(SEVEN), TOOL], JOINTS_7),
    "on a pedestal": Taken(
        [Row("mount", at_m=(0.3, 0.1, 0.9), kind="fixed", child="foot"), *arm(SIX), TOOL],
        base="foot",
    ),
    "joints and links of one name": Taken(
        [row._replace(child=row.name) for row in arm(SIX)] + [TOOL]
    ),
    "a joint with the name of another link": Taken(
        [row._replace(child=f"j{n % 6 + 1}") for n, row in enumerate(arm(SIX), 1)] + [TOOL]
    ),
    "a joint with the name of the world": Taken(
        [Row("universe"), *arm(SIX)[1:], TOOL], ("universe", *JOINTS_6[1:])
    ),
    "a torso that lifts": Taken([SLIDE, *arm(SIX), TOOL], locked={"lift": 0.25}),
    "a torso that turns": Taken(
        [Row("waist", at_m=(0.1, 0.0, 0.8)), *arm(SEVEN), TOOL], JOINTS_7, {"waist": -0.3}
    ),
    "a torso without limits": Taken(
        [Row("waist", kind="continuous", limit=""), *arm(SIX), TOOL], locked={"waist": 2.0}
    ),
    "a wrist that is locked": Taken(
        [*arm(SEVEN), TOOL], ("j1", "j2", "j3", "j4", "j6", "j7"), {"j5": 0.4}
    ),
    "a joint that keeps the hand level": Taken(
        [*arm("zyyyx", j4=Row("j4", axis=Y, mimic=("j3", -1.0, 0.2))), TOOL],
        ("j1", "j2", "j3", "j5"),
    ),
    "a joint that follows one that follows": Taken(
        [
            *arm(
                SIX,
                j3=Row("j3", axis=Y, mimic=("j2", 0.5, 0.1)),
                j5=Row("j5", axis=Y, mimic=("j3", -2.0, 0.0)),
            ),
            TOOL,
        ],
        ("j1", "j2", "j4", "j6"),
    ),
    "a joint that follows a locked one": Taken(
        [SLIDE, Row("lift_2", kind="prismatic", mimic=("lift", 1.0, 0.0)), *arm(SIX), TOOL],
        locked={"lift": 0.1},
    ),
    "an arm on rails": Taken(
        [Row("rail", axis=X, kind="prismatic", ends=(-0.5, 0.5)), *arm("yzy"), TOOL],
        ("rail", "j1", "j2", "j3"),
    ),
    "a SCARA": Taken(
        [*arm("zz"), Row("j3", axis=Z, kind="prismatic", ends=(-0.2, 0.0)), Row("j4"), TOOL],
        ("j1", "j2", "j3", "j4"),
    ),
    "two arms": Taken(
        [
            *arm(SIX),
            TOOL,
            Row("l1", parent="base", at_m=(0.0, 0.4, 0.2)),
            Row("l2", axis=Y),
            Row("l3", axis=Y),
        ]
    ),
    "wheels": Taken(
        [*arm(SIX), TOOL, Row("wheel", parent="base", axis=Y, kind="continuous", limit="")]
    ),
    "a head that follows nothing known": Taken(
        [*arm(SIX), TOOL, Row("neck", parent="base", mimic=("chin", 1.0, 0.0))]
    ),
    "axes that point backwards": Taken(
        [*arm(SIX, j2=Row("j2", axis=(0.0, -1.0, 0.0)), j5=Row("j5", axis=(0.0, -1.0, 0.0))), TOOL]
    ),
    "an axis that is askew": Taken([*arm(SIX, j4=Row("j4", axis=(0.6, 0.0, 0.8))), TOOL]),
    "joints listed in another order": Taken([*arm(SIX), TOOL], tuple(reversed(JOINTS_6))),
    "links without shapes on the way": Taken(
        [*arm(SIX), Row("flange", at_m=(0.0, 0.0, 0.0), kind="fixed"), TOOL]
    ),
    "fingers that slide alike": Taken(
        [*arm(SIX), TOOL, finger("left", 0.0, 0.04), finger("right", 0.0, 0.04)],
        fingers=("left", "right"),
        signs=(1.0, 1.0),
    ),
    "fingers of opposite sign": Taken(
        [*arm(SIX), TOOL, finger("left", 0.0, 0.035), finger("right", -0.035, 0.0)],
        fingers=("left", "right"),
        signs=(1.0, -1.0),
    ),
    "one finger of negative range": Taken(
        [*arm(SIX), TOOL, finger("left", -0.044, 0.0)], fingers=("left",), signs=(-1.0,)
    ),
    "a finger that mimics the other, mirrored": Taken(
        [
            *arm(SIX),
            TOOL,
            finger("left", 0.021, 0.057),
            finger("right", -0.057, -0.021, mimic=("left", -1.0, 0.0)),
        ],
        fingers=("left", "right"),
        signs=(1.0, -1.0),
        ends=JointEnds(0.057, 0.021, "m"),
    ),
    "a finger that mimics one that is not listed": Taken(
        [
            *arm(SIX),
            TOOL,
            finger("left", 0.0, 0.04),
            finger("right", 0.0, 0.04, mimic=("left", 1.0, 0.0)),
        ],
        fingers=("left",),
        signs=(1.0,),
    ),
    "knuckles that turn against each other": Taken(
        [
            *arm(SIX),
            TOOL,
            Row("left", axis=X, parent="j6_link", ends=(0.0, 0.8)),
            Row("right", axis=X, parent="j6_link", ends=(-0.8, 0.0), mimic=("left", -1.0, 0.0)),
        ],
        fingers=("left", "right"),
        signs=(1.0, -1.0),
        ends=JointEnds(0.0, 0.8, "rad"),
    ),
}
