"""Payloads to CDR messages and back, by way of rosbags' message types.

A payload becomes a message only where the message can give the same payload back; who cannot say
so raises `Unfit`, and the writer keeps the bytes.
"""

from __future__ import annotations

import dataclasses
from functools import cache
from typing import TYPE_CHECKING, Any

import numpy as np

from vla_zenoh.codec import message
from vla_zenoh.errors import CodecError, MissingExtraError
from vla_zenoh.lab.recording import definitions
from vla_zenoh.lab.recording.definitions import Unfit, fields_of, type_name
from vla_zenoh.lab.recording.record_types import RECORDS
from vla_zenoh.policy import ModelSpec
from vla_zenoh.types import Cause

if TYPE_CHECKING:
    from vla_zenoh.interop.ros2.messages import Messages

IMAGE, JPEG_IMAGE = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"
TEXT = "std_msgs/msg/String"
LAST_SECOND = 2**31
MAX_MESSAGE_BYTES = 256 * 1024 * 1024
DISTRIBUTION = "humble"
"""Its standard messages are those of all later ones."""


@cache
def messages() -> Messages:
    """The message types of ROS 2 and ours.

    Raises:
        MissingExtraError: rosbags is not installed.
    """
    try:
        from vla_zenoh.interop.ros2.messages import Messages
    except ImportError as error:
        raise MissingExtraError("rosbags", "record") from error
    ours = {type_name(kind): definitions.definition(kind) for kind in RECORDS}
    ours[type_name(Cause)] = definitions.definition(Cause, header=False)
    ours[definitions.SAMPLE_NAME] = definitions.SAMPLE
    return Messages(DISTRIBUTION, ours)


def schema_text(name: str) -> bytes:
    """A message's definition and those it is made of, in the form MCAP calls ``ros2msg``."""
    return messages().definition(name).encode()


def serialize(name: str, *values: Any) -> bytes:
    """CDR of a message whose fields are `values`, in order.

    Raises:
        CodecError: a value that does not fit its field.
    """
    every = messages()
    return every.encode(every.types[name](*values))


def deserialize(name: str, data: bytes) -> Any:
    """The message of `serialize`.

    Raises:
        CodecError: other bytes.
    """
    return messages().decode(name, data, MAX_MESSAGE_BYTES)


def header(stamp_ns: int, frame: str) -> Any:
    """A std_msgs/Header.

    Raises:
        Unfit: seconds after 2038 do not fit in.
    """
    types = messages().types
    seconds, nanoseconds = divmod(stamp_ns, 1_000_000_000)
    if not 0 <= seconds < LAST_SECOND:
        raise Unfit
    stamp = types["builtin_interfaces/msg/Time"](seconds, nanoseconds)
    return types["std_msgs/msg/Header"](stamp, frame)


def stamp_of(head: Any) -> int:
    """Nanoseconds of a std_msgs/Header."""
    return head.stamp.sec * 1_000_000_000 + head.stamp.nanosec


def fields_in(kind: type, payload: bytes) -> dict[str, Any]:
    """What a record's payload says, absent fields with their defaults; values are not judged.

    Raises:
        Unfit: it is no map with the fields of this record.
    """
    try:
        data = message.unpack(payload)
    except CodecError as error:
        raise Unfit from error
    if kind is ModelSpec:
        data = {"spec": data}
    names = {field.name: field for field in fields_of(kind)}
    if not isinstance(data, dict) or not data.keys() <= names.keys():
        raise Unfit
    for name, field in names.items():
        if name not in data:
            if field.default is dataclasses.MISSING:
                raise Unfit
            data[name] = field.default
    return data


def write_record(kind: type, data: dict[str, Any], stamp_ns: int, frame: str) -> bytes:
    """CDR of a record.

    Raises:
        Unfit: a value is of another type than the record's.
    """
    values: list[Any] = [header(stamp_ns, frame)]
    try:
        for field in fields_of(kind):
            value = field.write(data[field.name])
            if field.shaped:
                values += [value.ravel(), np.array(value.shape, np.uint32)]
            elif field.name == "cause":
                values.append([messages().types[type_name(Cause)](**each) for each in value])
            else:
                values.append(value)
        return serialize(type_name(kind), *values)
    except Exception as error:  # whatever generated code does with values that are not its own
        raise Unfit from error


def read_record(kind: type, data: bytes) -> tuple[Any, dict[str, Any]]:
    """The std_msgs/Header and the fields of a record, the latter as in a payload.

    Raises:
        CodecError: it is no such message.
    """
    found = deserialize(type_name(kind), data)
    fields: dict[str, Any] = {}
    try:
        for field in fields_of(kind):
            value = getattr(found, field.name)
            if field.shaped:
                value = value.reshape(getattr(found, f"{field.name}_shape"))
            fields[field.name] = field.read(value)
    except (ValueError, TypeError, OverflowError, RecursionError) as error:
        raise CodecError("malformed", f"{kind.__name__}: {str(error)[:200]}") from error
    return found.header, fields


def payload_of(kind: type, fields: dict[str, Any]) -> bytes:
    """The payload that says `fields`."""
    return message.pack(fields["spec"] if kind is ModelSpec else fields)
