"""A picture of an arm at home as SVG: from the side, from above and from the front, to scale, with
its frames, its workspace and the table."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape
from itertools import product
from typing import NamedTuple

import numpy as np
import pinocchio as pin

from vla_zenoh.kinematics.collision import CollisionModel
from vla_zenoh.kinematics.kinematics import Kinematics
from vla_zenoh.types import FloatArray
from vla_zenoh_newarm.arm import Arm

PANEL_PX, EDGE_PX, HEAD_PX = 460, 24, 56
GRID_M = 0.1
AXIS_M, END_AXIS_M = 0.04, 0.12
"""Lengths of the axes of a joint's frame, and of those of base and TCP."""
FRAME_COLOURS = ("#d33", "#2a2", "#25d")
"""Of x, y and z."""
SHAPE, WORKSPACE, TABLE, GRID, INK = "#8fa3bd", "#c60", "#9a7b4f", "#e4e7ec", "#222"


class View(NamedTuple):
    """A direction from which the arm is seen.

    Args:
        name: of it.
        right, up: axis of the base frame that points there, and its sign.
    """

    name: str
    right: tuple[int, float]
    up: tuple[int, float]

    def flat(self, points_m: FloatArray) -> FloatArray:
        """(m, 2) of points (m, 3)."""
        axes = (self.right, self.up)
        return np.stack([sign * points_m[:, axis] for axis, sign in axes], axis=1)


VIEWS = (
    View("from the side", (0, 1.0), (2, 1.0)),
    View("from above", (0, 1.0), (1, 1.0)),
    View("from the front", (1, 1.0), (2, 1.0)),
)


class Frame(NamedTuple):
    """A frame in the base frame: its name, origin (3,), axes as columns (3, 3) and their length."""

    name: str
    at_m: FloatArray
    axes: FloatArray
    length_m: float


def picture(title: str, arm: Arm) -> str:
    """The picture as the text of an SVG file.

    Raises:
        ResourceError: the shapes of the description cannot be loaded.
    """
    links = arm.structure
    kinematics = Kinematics(arm.file, links.tcp, links.arm, base_frame=links.base)
    home_rad = np.array(arm.posture.home_rad)
    shapes, frames = _shapes(kinematics, home_rad), _frames(kinematics, home_rad, arm)
    box = np.array(list(product(*arm.posture.workspace_m)))
    table = [] if arm.table_z_m is None else [np.array([[0.0, 0.0, arm.table_z_m]])]
    origins = np.array([frame.at_m for frame in frames])
    everything = np.concatenate([*shapes, box, origins, *table])
    low, high = everything.min(axis=0) - GRID_M, everything.max(axis=0) + GRID_M
    px_m = PANEL_PX / float((high - low).max())
    drawn = [
        _Panel(view, low, high, px_m).draw(shapes, frames, box, arm.table_z_m) for view in VIEWS
    ]
    width = len(VIEWS) * (PANEL_PX + EDGE_PX) + EDGE_PX
    panels = [
        f'<g transform="translate({EDGE_PX + index * (PANEL_PX + EDGE_PX)},{HEAD_PX})">{panel}</g>'
        for index, panel in enumerate(drawn)
    ]
    legend = (
        f"{title}: base {links.base}, TCP {links.tcp}; axes x red, y green, z blue; "
        f"workspace dashed; a square is {GRID_M:g} m"
    )
    return "\n".join(
        (
            f'<svg xmlns="http://www.w3.org/2000/svg" width="{width}" '
            f'height="{HEAD_PX + PANEL_PX + EDGE_PX}" font-family="sans-serif" font-size="12">',
            '<rect width="100%" height="100%" fill="white"/>',
            f'<text x="{EDGE_PX}" y="22" font-size="14" fill="{INK}">{escape(legend)}</text>',
            *panels,
            "</svg>\n",
        )
    )


def _shapes(kinematics: Kinematics, home_rad: FloatArray) -> list[FloatArray]:
    """Corners (m, 3) of the hull of each link in the base frame."""
    geometry = CollisionModel(kinematics, near_m=0.0).links()
    places = geometry.createData()
    pin.updateGeometryPlacements(kinematics.model, kinematics.data, geometry, places, home_rad)
    base = kinematics.base_placement.inverse()
    found = []
    for shape, place in zip(geometry.geometryObjects, places.oMg, strict=True):
        at = base * place
        points = np.array(shape.geometry.points())
        found.append(points @ at.rotation.T + at.translation)
    return found


def _frames(kinematics: Kinematics, home_rad: FloatArray, arm: Arm) -> list[Frame]:
    """Those of base, joints and TCP."""
    tcp = kinematics.forward(home_rad)
    base = kinematics.base_placement.inverse()
    found = [Frame("base", np.zeros(3), np.eye(3), END_AXIS_M)]
    for name in kinematics.arm_joints:
        at = base * kinematics.data.oMi[kinematics.model.getJointId(name)]
        found.append(Frame(name, at.translation, at.rotation, AXIS_M))
    return [*found, Frame("TCP", tcp.position_m, tcp.rotation, END_AXIS_M)]


class _Panel:
    """One view of the arm, in pixels from the panel's upper left corner."""

    def __init__(self, view: View, low: FloatArray, high: FloatArray, px_m: float) -> None:
        ends = view.flat(np.array([low, high]))
        self._view, self._low, self._high = view, ends.min(axis=0), ends.max(axis=0)
        self._px_m = px_m

    def draw(
        self,
        shapes: Sequence[FloatArray],
        frames: Sequence[Frame],
        box: FloatArray,
        table_z_m: float | None,
    ) -> str:
        parts = [*self._grid()]
        if table_z_m is not None and self._view.up[0] == 2:
            y = self._place(np.array([self._low[0], table_z_m]))[1]
            right = self._place(self._high)[0]
            parts.append(f'<path d="M0,{y:.1f}H{right:.1f}" stroke="{TABLE}" stroke-width="3"/>')
        for points_m in shapes:
            ring = outline(self._view.flat(points_m))
            style = f'fill="{SHAPE}" fill-opacity="0.35" stroke="{SHAPE}"'
            parts.append(f'<polygon points="{self._path(ring)}" {style}/>')
        style = f'fill="none" stroke="{WORKSPACE}" stroke-width="1.5" stroke-dasharray="6 4"'
        ring = outline(self._view.flat(box))
        parts.append(f'<polygon points="{self._path(ring)}" {style}/>')
        for frame in frames:
            parts += self._frame(frame)
        parts.append(
            f'<text x="0" y="-10" font-weight="bold" fill="{INK}">{self._view.name}</text>'
        )
        return "\n".join(parts)

    def _grid(self) -> list[str]:
        right, bottom = self._place(np.array([self._high[0], self._low[1]]))
        lines = []
        for at_m in np.arange(np.ceil(self._low[0] / GRID_M), self._high[0] / GRID_M) * GRID_M:
            x = self._place(np.array([at_m, 0.0]))[0]
            lines.append(f"M{x:.1f},0V{bottom:.1f}")
        for at_m in np.arange(np.ceil(self._low[1] / GRID_M), self._high[1] / GRID_M) * GRID_M:
            y = self._place(np.array([0.0, at_m]))[1]
            lines.append(f"M0,{y:.1f}H{right:.1f}")
        return [f'<path d="{"".join(lines)}" stroke="{GRID}"/>']

    def _frame(self, frame: Frame) -> list[str]:
        start = self._place(self._view.flat(frame.at_m[None])[0])
        parts = []
        for axis, colour in enumerate(FRAME_COLOURS):
            end_m = frame.at_m + frame.length_m * frame.axes[:, axis]
            end = self._place(self._view.flat(end_m[None])[0])
            line = f"M{start[0]:.1f},{start[1]:.1f}L{end[0]:.1f},{end[1]:.1f}"
            parts.append(f'<path d="{line}" stroke="{colour}" stroke-width="2"/>')
        if frame.length_m == END_AXIS_M:
            at = f'x="{start[0] + 6:.1f}" y="{start[1] + 14:.1f}"'
            parts.append(f'<text {at} fill="{INK}">{escape(frame.name)}</text>')
        else:
            at = f'cx="{start[0]:.1f}" cy="{start[1]:.1f}"'
            name = f"<title>{escape(frame.name)}</title>"
            parts.append(f'<circle {at} r="3" fill="{INK}">{name}</circle>')
        return parts

    def _path(self, ring: FloatArray) -> str:
        return " ".join(f"{x:.1f},{y:.1f}" for x, y in (self._place(point) for point in ring))

    def _place(self, point_m: FloatArray) -> FloatArray:
        return (point_m - (self._low[0], self._high[1])) * (self._px_m, -self._px_m)


def outline(points: FloatArray) -> FloatArray:
    """Convex hull (k, 2) of points (m, 2), counterclockwise, by Andrew's monotone chain."""
    ordered = np.unique(points.round(6), axis=0)
    if len(ordered) < 3:
        return ordered
    halves = [_half(ordered), _half(ordered[::-1])]
    return np.array([point for half in halves for point in half[:-1]])


def _half(ordered: FloatArray) -> list[FloatArray]:
    kept: list[FloatArray] = []
    for point in ordered:
        while len(kept) > 1:
            (ax, ay), (bx, by) = kept[-1] - kept[-2], point - kept[-1]
            if ax * by - ay * bx > 0:
                break
            kept.pop()
        kept.append(point)
    return kept
