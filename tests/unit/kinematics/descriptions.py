"""Small descriptions of arms as their makers write them, each made from a few rows.

No file of a maker is among them: the shapes are spheres and the numbers are rounded; what is like
theirs is the structure, with the traps that it has.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

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
