"""Frames of a ROS graph (tf2): reading and writing transforms, and the tree that they make.

A transform is the pose of a frame in its parent, a (4, 4) matrix in m. As in tf2 a frame has one
parent, names have no leading slash, and a later transform replaces an earlier one.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Iterator, Mapping
from typing import Any, NamedTuple

import numpy as np

from vla_zenoh.errors import CodecError
from vla_zenoh.kinematics.so3 import quat_from_rotation, rotation_from_quat
from vla_zenoh.sanitize import one_line
from vla_zenoh.types import FloatArray
from vla_zenoh_ros2.messages import SECOND_NS, Messages
from vla_zenoh_ros2.writers import Stamp, header

TF, TF_STATIC, TF_MESSAGE = "/tf", "/tf_static", "tf2_msgs/msg/TFMessage"
MAX_NAME = 256
MAX_FRAMES, MAX_PARENTS = 2000, 8
NORM_TOLERANCE = 0.01
"""Of a quaternion's squared norm, as tf2 tolerates it."""
FURTHEST_M = 1e6
RESTARTED_NS = 1_000_000_000
"""A stamp that is older by more means a clock that was set back: moving transforms begin anew."""
STALE_S = 2.0
"""A moving transform that is older than the newest one by more says nothing about now."""


class Edge(NamedTuple):
    """Pose (4, 4) of the frame `child` in `parent`; fixed: it never moves."""

    parent: str
    child: str
    pose: FloatArray
    fixed: bool
    stamp_ns: int = 0


def read_transforms(message: Any, *, fixed: bool) -> tuple[list[Edge], list[CodecError]]:
    """The transforms of a TFMessage, and what is wrong with each of the others."""
    edges: list[Edge] = []
    faults: list[CodecError] = []
    for each in message.transforms:
        try:
            edges.append(_edge(each, fixed))
        except CodecError as fault:
            faults.append(fault)
    return edges, faults


def _edge(transform: Any, fixed: bool) -> Edge:
    stamp = transform.header.stamp
    names = (transform.header.frame_id.lstrip("/"), transform.child_frame_id.lstrip("/"))
    parent, child = names
    what = f"transform of {child[:60]!r} in {parent[:60]!r}"
    if not all(names) or max(map(len, names)) > MAX_NAME:
        raise CodecError("frame", f"{what}: a frame has no name, or one of over {MAX_NAME} letters")
    if parent == child:
        raise CodecError("frame", f"{what}: a frame cannot be its own parent")
    if stamp.sec < 0 or stamp.nanosec >= SECOND_NS:
        raise CodecError("invalid", f"{what}: a stamp of {stamp.sec} s and {stamp.nanosec} ns")
    at, turn = transform.transform.translation, transform.transform.rotation
    position, quat = (at.x, at.y, at.z), (turn.x, turn.y, turn.z, turn.w)
    if not all(math.isfinite(value) and abs(value) < FURTHEST_M for value in (*position, *quat)):
        raise CodecError("invalid", f"{what}: a number that is NaN, infinite or above 1e6")
    if abs(sum(value * value for value in quat) - 1.0) > NORM_TOLERANCE:
        raise CodecError("invalid", f"{what}: the quaternion {quat} is not of length 1")
    stamp_ns = stamp.sec * SECOND_NS + stamp.nanosec
    return Edge(
        parent, child, placed(position, rotation_from_quat(np.array(quat))), fixed, stamp_ns
    )


def placed(position_m: Iterable[float], rotation: FloatArray) -> FloatArray:
    """A pose as a (4, 4) matrix."""
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, tuple(position_m)
    return pose


def tf_message(messages: Messages, edges: Iterable[Edge], stamp_ns: int) -> Any:
    """A TFMessage of these transforms, all of one time."""
    made = []
    for edge in edges:
        x, y, z = edge.pose[:3, 3].tolist()
        at = messages.new("geometry_msgs/msg/Vector3", x=x, y=y, z=z)
        x, y, z, w = quat_from_rotation(edge.pose[:3, :3]).tolist()
        turn = messages.new("geometry_msgs/msg/Quaternion", x=x, y=y, z=z, w=w)
        made.append(
            messages.new(
                "geometry_msgs/msg/TransformStamped",
                header=header(messages, Stamp(stamp_ns, edge.parent)),
                child_frame_id=edge.child,
                transform=messages.new(
                    "geometry_msgs/msg/Transform", translation=at, rotation=turn
                ),
            )
        )
    return messages.new(TF_MESSAGE, transforms=made)


class FrameTree:
    """The tree of the transforms that others publish."""

    def __init__(self) -> None:
        self.edges: dict[str, Edge] = {}
        """Frame -> how it is placed in its parent."""
        self.parents: dict[str, set[str]] = {}
        """Frame with several parents -> these."""

    def add(self, edge: Edge) -> None:
        """Take a transform, or raise a `CodecError`: ``out_of_order``, ``too_many``, ``cycle``."""
        before = self.edges.get(edge.child)
        if before is None and len(self.edges) >= MAX_FRAMES:
            raise CodecError("too_many", f"more than {MAX_FRAMES} frames")
        if before is not None and before.parent != edge.parent:
            known = self.parents.setdefault(edge.child, {before.parent})
            known |= {edge.parent} if len(known) < MAX_PARENTS else set()
        elif before is not None and not edge.fixed and edge.stamp_ns < before.stamp_ns:
            if before.stamp_ns - edge.stamp_ns < RESTARTED_NS:
                why = f"a transform of {edge.child[:60]!r} that is older than the one before"
                raise CodecError("out_of_order", why)
            self.edges = {child: each for child, each in self.edges.items() if each.fixed}
        if edge.child in self.above(edge.parent):
            why = f"{edge.child[:60]!r} in {edge.parent[:60]!r}: it is above its own parent"
            raise CodecError("cycle", why)
        self.edges[edge.child] = edge

    def above(self, frame: str) -> Iterator[str]:
        """A frame and all above it, upwards."""
        passed: set[str] = set()
        while frame not in passed:
            passed.add(frame)
            yield frame
            edge = self.edges.get(frame)
            if edge is None:
                return
            frame = edge.parent

    def pose(self, frame: str, of: str) -> FloatArray:
        """Pose (4, 4) of `frame` in the frame `of`.

        Raises:
            CodecError: ``frame``, they are not connected; ``stale``, a transform between is old.
        """
        to_frame, to_other = list(self.above(frame)), list(self.above(of))
        if to_frame[-1] != to_other[-1]:
            raise CodecError("frame", f"no transforms lead from {of[:60]!r} to {frame[:60]!r}")
        shared = next(each for each in to_frame if each in to_other)
        down, up = self._within(shared, to_frame), self._within(shared, to_other)
        return np.linalg.inv(up) @ down

    def _within(self, root: str, upwards: Iterable[str]) -> FloatArray:
        """Pose of the first frame of `upwards` in `root`, which is one of the others."""
        pose = np.eye(4)
        newest_ns = max(
            (edge.stamp_ns for edge in self.edges.values() if not edge.fixed), default=0
        )
        for frame in upwards:
            if frame == root:
                break
            edge = self.edges[frame]
            if not edge.fixed and newest_ns - edge.stamp_ns > STALE_S * SECOND_NS:
                age_s = (newest_ns - edge.stamp_ns) / SECOND_NS
                raise CodecError("stale", f"the transform of {frame[:60]!r} is {age_s:.1f} s old")
            pose = edge.pose @ pose
        return pose

    def mount(self, frame: str, links: Collection[str], base: str) -> tuple[str, FloatArray]:
        """The link that a frame is fixed to, and its pose (4, 4) in it.

        That is the first of `links` above it, or else `base`, to which transforms have to lead.
        """
        pose = np.eye(4)
        for above in self.above(frame):
            if above in links:
                return above, pose
            edge = self.edges.get(above)
            if edge is None or not edge.fixed:
                break
            pose = edge.pose @ pose
        return base, self.pose(frame, base)


def publishable(ours: Iterable[Edge], theirs: FrameTree) -> tuple[list[Edge], Mapping[str, str]]:
    """Which of our transforms may be published, and why not the others: frame -> reason.

    A frame that somebody else publishes would get two authorities, and a transform that closes a
    cycle would cut the tree.
    """
    allowed: list[Edge] = []
    refused: dict[str, str] = {}
    together = FrameTree()
    together.edges = dict(theirs.edges)
    for edge in ours:
        published = theirs.edges.get(edge.child)
        if published is not None:
            refused[edge.child] = f"another node publishes it, in {one_line(published.parent, 80)}"
        elif edge.child in together.above(edge.parent):
            refused[edge.child] = f"it is above {edge.parent} already"
        else:
            together.edges[edge.child] = edge
            allowed.append(edge)
    return allowed, refused


def difference(a: FloatArray, b: FloatArray) -> tuple[float, float]:
    """How far two poses (4, 4) are apart: m and rad."""
    turned = quat_from_rotation(a[:3, :3].T @ b[:3, :3])
    angle_rad = 2.0 * math.atan2(float(np.linalg.norm(turned[:3])), abs(float(turned[3])))
    return float(np.linalg.norm(a[:3, 3] - b[:3, 3])), angle_rad
