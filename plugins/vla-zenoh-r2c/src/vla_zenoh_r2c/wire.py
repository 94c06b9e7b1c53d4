"""The wire of R2C 0.2: keys and messages between a robot and the policy that it asks.

A robot publishes an observation, and executes the actions that repeat its id. Messages are
protobuf; fields that nothing here reads are not declared, and are ignored. No message says in
which unit its numbers are, or how long a step lasts: see `vla_zenoh_r2c.declared`.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from google.protobuf.descriptor_pb2 import FieldDescriptorProto, FileDescriptorProto
from google.protobuf.descriptor_pool import DescriptorPool
from google.protobuf.message import DecodeError
from google.protobuf.message_factory import GetMessages

from vla_zenoh.errors import CodecError
from vla_zenoh.types import MAX_TEXT, FloatArray, shown

MAX_BYTES = 32 << 20
"""Of an observation: its images are files."""
MAX_ACTION_BYTES = 1 << 20
MAX_IMAGES = 16
MAX_NUMBERS = 64
MAX_STEPS = 1000
"""Their robots queue no more."""
RAW = ("", "raw")
"""``image_encoding`` of images that are files of their own."""

_PACKAGE = "r2c_sdk"
_FIELDS = {
    "Image": "1 string name, 2 bytes file",
    "Images": "1 *Image color",
    "Joints": "1 *string names, 2 *double position",
    "Film": "1 bytes stream",
    "Observations": (
        "1 int64 timestamp, 2 string task, 3 int64 id, 4 string image_encoding, "
        "5 Images raw_images, 6 Film h264_images, 7 Joints joint_states"
    ),
    "Step": "1 *double data",
    "JointSteps": "1 *string names, 2 *Step position",
    "Poses": "1 string name",
    "Actions": (
        "1 int64 timestamp, 2 int64 id, 3 int32 chunk_size, 4 JointSteps joint_states, "
        "5 *Poses end_effector_poses"
    ),
}
"""Message -> its fields: number, type (``*``: repeated), name."""
_FIELD = re.compile(r"(\d+) (\*?)(\w+) (\w+)")


def observations_key(project: str, device: str) -> str:
    """Where a robot publishes its observations."""
    return f"{project}/{device}/inference/observations"


def actions_key(project: str, device: str) -> str:
    """Where a policy publishes its answers."""
    return f"{project}/{device}/inference/actions"


@dataclass(frozen=True, slots=True, eq=False)
class Seen:
    """An observation.

    Args:
        stamp_ms: when it was taken, wall clock of the robot.
        id: that the answer must repeat.
        task: the prompt.
        images: camera -> a JPEG file.
        names: of `position`, or none.
        position: (n,) in the robot's own units and order.
    """

    stamp_ms: int
    id: int
    task: str
    images: Mapping[str, bytes]
    names: tuple[str, ...]
    position: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class Steps:
    """An answer to one observation.

    Args:
        stamp_ms: when it was made, wall clock of the policy.
        id: of the observation.
        names: of the columns, or none.
        position: (H, n) absolute positions in the robot's own units and order.
    """

    stamp_ms: int
    id: int
    names: tuple[str, ...]
    position: FloatArray


def encode_observation(seen: Seen) -> bytes:
    """The bytes of an observation."""
    message = _MESSAGES["Observations"](
        timestamp=seen.stamp_ms, task=seen.task, id=seen.id, image_encoding="raw"
    )
    for name, file in seen.images.items():
        message.raw_images.color.add(name=name, file=file)
    message.joint_states.names.extend(seen.names)
    message.joint_states.position.extend(seen.position.tolist())
    return message.SerializeToString()


def decode_observation(data: bytes) -> Seen:
    """An observation.

    Raises:
        CodecError: a field is missing or wrong, by name.
    """
    message = _parse("Observations", data, MAX_BYTES)
    stamp_ms, identity = _begun(message)
    if len(message.task) > MAX_TEXT:
        raise CodecError("task", f"task has {len(message.task)} characters, at most {MAX_TEXT}")
    encoding = message.image_encoding
    if encoding not in RAW or message.HasField("h264_images"):
        raise CodecError(
            "image_encoding",
            f"image_encoding is {shown(encoding)}; only raw images (JPEG files) are read: publish "
            'with image_encode="raw"',
        )
    files = message.raw_images.color
    if len(files) > MAX_IMAGES:
        raise CodecError("images", f"{len(files)} images, at most {MAX_IMAGES} are read")
    images = {each.name: each.file for each in files}
    if len(images) != len(files):
        raise CodecError("images", "raw_images.color names a camera twice")
    joints = message.joint_states
    position = _numbers("joint_states.position", joints.position)
    names = _names(joints.names, len(position))
    return Seen(stamp_ms, identity, message.task, images, names, position)


def encode_actions(steps: Steps) -> bytes:
    """The bytes of an answer."""
    message = _MESSAGES["Actions"](
        timestamp=steps.stamp_ms, id=steps.id, chunk_size=len(steps.position)
    )
    message.joint_states.names.extend(steps.names)
    for row in steps.position.tolist():
        message.joint_states.position.add(data=row)
    return message.SerializeToString()


def decode_actions(data: bytes) -> Steps:
    """An answer of a policy.

    Raises:
        CodecError: a field is missing or wrong, by name.
    """
    message = _parse("Actions", data, MAX_ACTION_BYTES)
    stamp_ms, identity = _begun(message)
    joints, count = message.joint_states, len(message.joint_states.position)
    if not 1 <= count <= MAX_STEPS:
        also = "; end_effector_poses are not read" if message.end_effector_poses else ""
        raise CodecError(
            "shape", f"joint_states.position has {count} steps, wanted 1 to {MAX_STEPS}{also}"
        )
    if message.chunk_size != count:
        raise CodecError(
            "shape", f"chunk_size is {message.chunk_size}, but joint_states.position has {count}"
        )
    rows = [
        _numbers(f"joint_states.position[{nth}]", step.data)
        for nth, step in enumerate(joints.position)
    ]
    for nth, row in enumerate(rows):
        if len(row) != len(rows[0]):
            raise CodecError(
                "shape",
                f"joint_states.position[{nth}] has {len(row)} numbers, step 0 has {len(rows[0])}",
            )
    return Steps(stamp_ms, identity, _names(joints.names, len(rows[0])), np.array(rows))


def _begun(message: Any) -> tuple[int, int]:
    """Time and id of a message; both are needed to know an old one."""
    if message.timestamp < 1:
        raise CodecError("timestamp", f"timestamp is {message.timestamp}, wanted ms since 1970")
    if message.id < 1:
        raise CodecError("id", f"id is {message.id}, wanted a number from 1 up")
    return message.timestamp, message.id


def _names(names: Sequence[str], count: int) -> tuple[str, ...]:
    if names and len(names) != count:
        raise CodecError("shape", f"joint_states has {len(names)} names for {count} numbers")
    if len(set(names)) != len(names):
        raise CodecError("joints", f"joint_states.names are {list(names)}, wanted no name twice")
    return tuple(names)


def _numbers(name: str, values: Sequence[float]) -> FloatArray:
    if not 1 <= len(values) <= MAX_NUMBERS:
        raise CodecError("shape", f"{name} has {len(values)} numbers, wanted 1 to {MAX_NUMBERS}")
    array = np.array(values, np.float64)
    if not np.isfinite(array).all():
        raise CodecError("not_finite", f"{name} is {array.tolist()}, wanted finite numbers")
    return array


def _parse(kind: str, data: bytes, limit: int) -> Any:
    if len(data) > limit:
        raise CodecError("oversize", f"a message of {len(data)} bytes, at most {limit}")
    message = _MESSAGES[kind]()
    try:
        message.ParseFromString(data)
    except DecodeError as error:
        raise CodecError("malformed", f"no message {kind} of R2C: {error}") from error
    return message


def _messages() -> dict[str, Any]:
    """The classes of the messages."""
    file = FileDescriptorProto(name="vla_zenoh_r2c.proto", package=_PACKAGE, syntax="proto3")
    for kind, fields in _FIELDS.items():
        message = file.message_type.add(name=kind)
        for number, repeated, what, name in _FIELD.findall(fields):
            field = message.field.add(name=name, number=int(number))
            field.label = (
                FieldDescriptorProto.LABEL_REPEATED
                if repeated
                else FieldDescriptorProto.LABEL_OPTIONAL
            )
            if what in _FIELDS:
                field.type = FieldDescriptorProto.TYPE_MESSAGE
                field.type_name = f".{_PACKAGE}.{what}"
            else:
                field.type = getattr(FieldDescriptorProto, f"TYPE_{what.upper()}")
    # A pool of its own: their package declares messages of the same names in the common one.
    found = GetMessages([file], pool=DescriptorPool())
    return {kind: found[f"{_PACKAGE}.{kind}"] for kind in _FIELDS}


_MESSAGES = _messages()
