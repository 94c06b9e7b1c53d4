"""Decoders of received ROS messages. A new type is a function and a row in `READERS`.

Numbers are as they came: finiteness and meaning are checked where a record is made of them.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from vla_zenoh.codec.cdr import MAX_MESSAGE_BYTES
from vla_zenoh.errors import CodecError
from vla_zenoh.types import MAX_NAMES, FloatArray
from vla_zenoh.types.records import Joints
from vla_zenoh_ros2.keys import BOOL, TEXT
from vla_zenoh_ros2.messages import MAX_PICTURE_BYTES, SECOND_NS, Messages
from vla_zenoh_ros2.pictures import (
    COMPRESSED_IMAGE,
    IMAGE,
    read_compressed_depth_m,
    read_compressed_rgb,
    read_depth_m,
    read_rgb,
)
from vla_zenoh_ros2.writers import GRASP, GRIPPER_COMMAND, PARALLEL_COMMAND

JOINT_STATE, WRENCH = "sensor_msgs/msg/JointState", "geometry_msgs/msg/WrenchStamped"
SUCCEEDED = 4
"""action_msgs/GoalStatus.STATUS_SUCCEEDED."""


class RosImage(NamedTuple):
    """Image of a camera, with stamp and frame of its header; `rgb` may be a read-only view."""

    stamp_ns: int
    frame: str
    rgb: NDArray[np.uint8]


class RosDepth(NamedTuple):
    """Depth of a camera in m, 0 or not finite where nothing was measured."""

    stamp_ns: int
    frame: str
    depth_m: NDArray[np.float32]


class Wanted(NamedTuple):
    """What a ROS user requests at once; None: unchanged. The answer repeats the `id`."""

    id: str | None = None
    prompt: str | None = None
    worker: str | None = None
    rate_hz: float | None = None
    active: bool | None = None


class Wrench(NamedTuple):
    """A geometry_msgs/WrenchStamped: (6,) N and Nm in the axes of `frame`."""

    stamp_ns: int
    frame: str
    wrench: FloatArray


class GripperOutcome(NamedTuple):
    """Result of a goal, with the driver's message."""

    reached: bool
    holding: bool
    message: str


def read(messages: Messages, kind: str, payload: bytes) -> Any:
    """Decode CDR bytes of a type in `READERS`; a `CodecError` whatever else the bytes are."""
    limit = MAX_PICTURE_BYTES if kind in (IMAGE, COMPRESSED_IMAGE) else MAX_MESSAGE_BYTES
    message = messages.decode(kind, payload, limit)
    try:
        return READERS[kind](message)
    except (ValueError, OverflowError) as error:
        if isinstance(error, CodecError):
            raise
        raise CodecError("malformed", f"{kind}: {str(error)[:200]}") from error


def _stamp_ns(header: Any) -> int:
    """Nanoseconds since the epoch of a header's stamp."""
    stamp = header.stamp
    if stamp.sec < 0 or stamp.nanosec >= SECOND_NS:
        raise CodecError("invalid", f"a stamp of {stamp.sec} s and {stamp.nanosec} ns")
    return stamp.sec * SECOND_NS + stamp.nanosec


_WANTED = {"id": str, "prompt": str, "worker": str, "rate_hz": (int, float), "active": bool}
_EXAMPLE = '{"id": "7", "prompt": "go up", "active": true}'


def read_request(text: str) -> Wanted:
    """The JSON of a request by topic, or a `CodecError` that says what is allowed."""
    try:
        given = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise CodecError("malformed", f"no JSON: {str(error)[:80]}; wanted: {_EXAMPLE}") from error
    if not isinstance(given, dict):
        raise CodecError("malformed", f"no JSON object; wanted: {_EXAMPLE}")
    for name, value in given.items():
        kinds = _WANTED.get(name)
        if kinds is None:
            raise CodecError("invalid", f"{name[:40]!r} is none of {', '.join(_WANTED)}")
        if not isinstance(value, kinds) or (name == "rate_hz" and isinstance(value, bool)):
            raise CodecError("invalid", f"{name} is {str(value)[:40]!r}; wanted: {_EXAMPLE}")
    return Wanted(**given)


# -- state ----------------------------------------------------------------------------------------
def _joints(message: Any) -> Joints:
    """Joints of a message; velocities and efforts may be missing, positions may not."""
    names = tuple(message.name)
    if not 0 < len(names) <= MAX_NAMES or len(set(names)) != len(names):
        raise CodecError("invalid", f"{len(names)} joint names, or one of them twice")
    position, velocity, effort = (
        _values(name, getattr(message, name), len(names))
        for name in ("position", "velocity", "effort")
    )
    if position is None:
        raise CodecError("invalid", "joints without positions")
    return Joints(_stamp_ns(message.header), names, position, velocity, effort)


def _values(what: str, given: Any, count: int) -> FloatArray | None:
    if len(given) == 0:
        return None
    if len(given) != count:
        raise CodecError("invalid", f"{len(given)} numbers of {what} for {count} joints")
    return np.asarray(given, np.float64)


def _wrench(message: Any) -> Wrench:
    force, torque = message.wrench.force, message.wrench.torque
    return Wrench(
        _stamp_ns(message.header),
        message.header.frame_id,
        np.array([force.x, force.y, force.z, torque.x, torque.y, torque.z]),
    )


# -- images ---------------------------------------------------------------------------------------
def _image(message: Any) -> RosImage:
    return RosImage(_stamp_ns(message.header), message.header.frame_id, read_rgb(message))


def _compressed_image(message: Any) -> RosImage:
    rgb = read_compressed_rgb(message)
    return RosImage(_stamp_ns(message.header), message.header.frame_id, rgb)


def read_depth(messages: Messages, kind: str, payload: bytes) -> RosDepth:
    """Decode CDR bytes of `IMAGE` or `COMPRESSED_IMAGE` as depth; a `CodecError` if it is none."""
    message = messages.decode(kind, payload, MAX_PICTURE_BYTES)
    depth_m = read_depth_m(message) if kind == IMAGE else read_compressed_depth_m(message)
    return RosDepth(_stamp_ns(message.header), message.header.frame_id, depth_m)


READERS: dict[str, Callable[[Any], Any]] = {
    JOINT_STATE: _joints,
    WRENCH: _wrench,
    IMAGE: _image,
    COMPRESSED_IMAGE: _compressed_image,
    TEXT: lambda message: message.data,
    BOOL: lambda message: bool(message.data),
}
"""Type -> decoder: message -> sample; raises `CodecError` or `ValueError`."""


def outcome(action: str, response: Any) -> GripperOutcome:
    """Outcome of a goal by the answer of get_result."""
    result = response.result
    reached = response.status == SUCCEEDED
    if action in (GRIPPER_COMMAND, PARALLEL_COMMAND):
        return GripperOutcome(reached and bool(result.reached_goal), bool(result.stalled), "")
    success = reached and bool(result.success)
    return GripperOutcome(success, success and action == GRASP, str(result.error)[:300])
