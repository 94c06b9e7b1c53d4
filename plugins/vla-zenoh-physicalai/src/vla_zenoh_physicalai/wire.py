"""The wire of physicalai 0.3: keys and records of a robot's owner and its clients.

An owner publishes the state of one robot and follows the newest action; records are msgpack maps.
An owner listens at a port of this computer that follows from the robot's name; there is no
authentication.
"""

from __future__ import annotations

import hashlib
import math
import re
from typing import Any

import msgspec
import numpy as np
from msgspec import Struct, field

from vla_zenoh.errors import CodecError, VlaZenohError
from vla_zenoh.types import FloatArray

VERSION = 1
"""``protocol_version`` of the metadata."""
MAX_BYTES = 1 << 20
FIRST_PORT, PORTS = 20_000, 40_000
NAME = re.compile(r"[A-Za-z0-9_-]+")


class Array(Struct):
    """A numpy array in a record."""

    dtype: str
    shape: list[int]
    data: bytes
    is_array: bool = field(default=True, name="__np__")


class Metadata(Struct):
    """What an owner replies on ``metadata``. It names no unit: `robot_class` implies one."""

    protocol_version: int
    name: str
    robot_class: str
    host: str
    joint_names: tuple[str, ...]
    num_joints: int
    state_dim: int


class State(Struct):
    """What an owner publishes on ``state``; `timestamp` is monotonic, in s, of its computer."""

    joint_positions: Array
    state: Array
    timestamp: float
    sensor_data: dict[str, Array] | None = None


class Action(Struct):
    """Absolute joint targets, to be reached in `goal_time` s; `ts`: when sent, as of a state."""

    action: Array
    goal_time: float
    ts: float


def key(name: str, what: str) -> str:
    """The key of ``state``, ``action`` or ``metadata`` of a robot.

    Raises:
        VlaZenohError: the robot cannot have this name.
    """
    if not NAME.fullmatch(name):
        raise VlaZenohError(f"{name!r} is no robot of physicalai: letters, digits, _ and - only")
    return f"physicalai/robot/{name}/{what}"


def local_endpoint(name: str) -> str:
    """Where the owner of a robot listens on its own computer."""
    digest = hashlib.sha256(f"physicalai/robot/{name}".encode()).digest()
    return f"tcp/127.0.0.1:{FIRST_PORT + int.from_bytes(digest[:4], 'big') % PORTS}"


def encode(record: Struct) -> bytes:
    """The bytes of a record."""
    return msgspec.msgpack.encode(record)


def decode_metadata(data: bytes) -> Metadata:
    """The metadata of a robot.

    Raises:
        CodecError: a field is missing or wrong, by name; or another version of the wire.
    """
    found = _decode(Metadata, data)
    if found.protocol_version != VERSION:
        raise CodecError(
            "version", f"protocol_version is {found.protocol_version}, allowed: {VERSION}"
        )
    count = len(found.joint_names)
    if not count or len(set(found.joint_names)) != count:
        raise CodecError("joints", f"joint_names are {found.joint_names}, wanted names that differ")
    if found.num_joints != count:
        raise CodecError("joints", f"num_joints is {found.num_joints}, but joint_names has {count}")
    return found


def decode_state(data: bytes, count: int) -> tuple[FloatArray, float]:
    """Joint positions (count,) of a state, and its monotonic time in s.

    Raises:
        CodecError: a field is missing or wrong, by name.
    """
    found = _decode(State, data)
    positions = _vector("joint_positions", found.joint_positions, count)
    return positions, _finite("timestamp", found.timestamp)


def decode_action(data: bytes, count: int) -> tuple[FloatArray, float]:
    """Joint targets (count,) of an action, and when it was sent, monotonic in s.

    Raises:
        CodecError: a field is missing or wrong, by name.
    """
    found = _decode(Action, data)
    _finite("goal_time", found.goal_time)
    return _vector("action", found.action, count), _finite("ts", found.ts)


def array_of(values: FloatArray) -> Array:
    """`values` as they travel."""
    values = np.ascontiguousarray(values, np.float64)
    return Array("float64", list(values.shape), values.tobytes())


def _decode(kind: type[Any], data: bytes) -> Any:
    if len(data) > MAX_BYTES:
        raise CodecError("size", f"a record of {len(data)} bytes, allowed: {MAX_BYTES}")
    try:
        return msgspec.msgpack.decode(data, type=kind)
    except (msgspec.DecodeError, UnicodeDecodeError) as error:
        raise CodecError("decode", str(error)) from error


def _finite(name: str, value: float) -> float:
    if not math.isfinite(value):
        raise CodecError("not_finite", f"{name} is {value}, wanted a finite number")
    return value


def _vector(name: str, array: Array, count: int) -> FloatArray:
    if array.dtype not in ("float16", "float32", "float64", "int32", "int64"):
        raise CodecError("dtype", f"{name} has dtype {array.dtype!r}, wanted numbers")
    if array.shape != [count]:
        raise CodecError("shape", f"{name} has shape {array.shape}, wanted [{count}]")
    if len(array.data) != count * np.dtype(array.dtype).itemsize:
        raise CodecError(
            "shape", f"{name} has {len(array.data)} bytes for {count} of {array.dtype}"
        )
    values = np.frombuffer(array.data, array.dtype).astype(np.float64)
    if not np.isfinite(values).all():
        raise CodecError("not_finite", f"{name} is {values.tolist()}, wanted finite numbers")
    return values
