"""Type of the record that each key carries."""

from __future__ import annotations

import json
from base64 import b64decode, b64encode
from collections.abc import Mapping
from functools import lru_cache
from typing import Any

from vla_zenoh.codec import message
from vla_zenoh.errors import CodecError
from vla_zenoh.keys import KEY_PATHS, NOT_PARTS, PART_KEYS, Keys
from vla_zenoh.policy import ModelSpec
from vla_zenoh.types import (
    ActionChunk,
    Event,
    GripperCommand,
    GripperState,
    InferenceDebug,
    JointCommand,
    JointState,
    NodeStatus,
    ObjectPoses,
    PoseCommand,
    PoseState,
    PrivilegedState,
    SceneState,
    Task,
)

RECORD_OF: Mapping[str, type] = {
    "state/joint": JointState,
    "state/pose": PoseState,
    "state/gripper": GripperState,
    "state/privileged": PrivilegedState,
    "command/pose": PoseCommand,
    "command/joint": JointCommand,
    "command/gripper": GripperCommand,
    "task": Task,
    "delta/*": ActionChunk,
    "spec/*": ModelSpec,
    "status/*": NodeStatus,
    "event/*": Event,
    "sim/scene": SceneState,
    "sim/objects": ObjectPoses,
    "seen/*": InferenceDebug,
}
"""Key below the robot -> its record; a star is the name of a node or worker."""
RECORDS = tuple(RECORD_OF.values())
"""Every record that has a key."""
OF_PARTS = frozenset(KEY_PATHS[name].path for name in PART_KEYS)


@lru_cache(maxsize=1000)
def record_of(key: str) -> type | None:
    """The record of a key below the robot; None for images, plain text and unknown keys."""
    first, _, rest = key.partition("/")
    if first not in NOT_PARTS:
        return RECORD_OF.get(rest) if rest in OF_PARTS else None
    of_name = f"{first}/*" if rest and "/" not in rest else ""
    return RECORD_OF.get(key) or RECORD_OF.get(of_name)


def part_of(keys: Keys, key: str) -> str:
    """The robot's part whose state or command `key` is; empty: it is of no part by name."""
    first, _, rest = keys.short(key).partition("/")
    return first if rest and first not in NOT_PARTS and keys.short(key) != key else ""


def group_of(keys: Keys, key: str) -> str:
    """What follows robot and part: ``camera``, ``state``, ``prompt``; empty for other keys."""
    own = keys.short(key).removeprefix(f"{part_of(keys, key)}/")
    return own.split("/")[0] if keys.short(key) != key else ""


PAYLOAD, ATTACHMENT = "_payload", "_attachment"


def record_to_json(kind: type, payload: bytes) -> tuple[str, dict[str, Any]]:
    """JSON text of a record's payload, and the decoded fields; their values are not validated.

    Raises:
        CodecError: the payload is no map of values that JSON can express.
    """
    fields = message.unpack(payload)
    if not isinstance(fields, dict) or any(str(name).startswith("_") for name in fields):
        raise CodecError("malformed", f"{kind.__name__} is a map with the names of its fields")
    try:
        text = _dumps(fields)
        exact = message.pack(json.loads(text)) == payload
    except (TypeError, ValueError) as error:
        raise CodecError("malformed", f"{kind.__name__}: {error}") from error
    return text if exact else _dumps({**fields, PAYLOAD: _base64(payload)}), fields


def record_from_json(kind: type, text: str) -> tuple[bytes, dict[str, Any]]:
    """The payload that `record_to_json` was given, and the decoded fields.

    Raises:
        CodecError: the text is not such JSON.
    """
    fields = _loads(text)
    try:
        if PAYLOAD not in fields:
            return message.pack(fields), fields
        payload = b64decode(fields[PAYLOAD])
        fields = message.unpack(payload)
        if isinstance(fields, dict):
            return payload, fields
        raise CodecError("malformed", f"{kind.__name__} is a map")
    except (TypeError, ValueError, OverflowError) as error:
        raise CodecError("malformed", f"{kind.__name__}: {str(error)[:200]}") from error


def bytes_to_json(payload: bytes, attachment: bytes | None) -> str:
    """JSON text of a sample that is no record."""
    found = {PAYLOAD: _base64(payload)}
    if attachment is not None:
        found[ATTACHMENT] = _base64(attachment)
    return _dumps(found)


def bytes_from_json(text: str) -> tuple[bytes, bytes | None]:
    """Payload and attachment that `bytes_to_json` was given.

    Raises:
        CodecError: the text is not such JSON.
    """
    found = _loads(text)
    try:
        attachment = found.get(ATTACHMENT)
        return b64decode(found[PAYLOAD]), None if attachment is None else b64decode(attachment)
    except (KeyError, TypeError, ValueError) as error:
        raise CodecError("malformed", f"no bytes in base64: {str(error)[:200]}") from error


def _dumps(value: dict[str, Any]) -> str:
    return json.dumps(value, default=_plain, allow_nan=False, separators=(",", ":"))


def _loads(text: str) -> dict[str, Any]:
    try:
        found = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise CodecError("malformed", f"not valid JSON: {str(error)[:200]}") from error
    if not isinstance(found, dict):
        raise CodecError("malformed", "a record is a JSON object")
    return found


def _base64(data: bytes) -> str:
    return b64encode(data).decode()


def _plain(value: Any) -> Any:
    if isinstance(value, bytes):
        return _base64(value)
    raise TypeError(f"{type(value).__name__} has no JSON form")
