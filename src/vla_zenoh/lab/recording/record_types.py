"""Type of the record that each key carries."""

from __future__ import annotations

import json
from base64 import b64decode, b64encode
from typing import Any

from vla_zenoh.codec import message
from vla_zenoh.errors import CodecError, ProfileError
from vla_zenoh.keys import NOT_PARTS, PART_KEYS, Keys, last_chunk
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

RECORDS: tuple[type, ...] = (
    JointState,
    PoseState,
    GripperState,
    PrivilegedState,
    PoseCommand,
    JointCommand,
    GripperCommand,
    Task,
    ActionChunk,
    ModelSpec,
    NodeStatus,
    Event,
    SceneState,
    ObjectPoses,
    InferenceDebug,
)
"""Every record that has a key."""


def part_of(keys: Keys, key: str) -> str:
    """The robot's part whose state or command `key` is; empty: it is of no part by name."""
    first, _, rest = keys.short(key).partition("/")
    return first if rest and first not in NOT_PARTS and keys.short(key) != key else ""


def group_of(keys: Keys, key: str) -> str:
    """What follows robot and part: ``camera``, ``state``, ``prompt``; empty for other keys."""
    own = keys.short(key).removeprefix(f"{part_of(keys, key)}/")
    return own.split("/")[0] if keys.short(key) != key else ""


class RecordTypes:
    """Record types of the keys of one robot; look-ups are cached."""

    def __init__(self, keys: Keys) -> None:
        self._keys = keys
        self._of_parts = {getattr(keys, member) for member in PART_KEYS}
        self._known: dict[str, type | None] = {
            keys.state_joint: JointState,
            keys.state_pose: PoseState,
            keys.state_gripper: GripperState,
            keys.state_privileged: PrivilegedState,
            keys.command_pose: PoseCommand,
            keys.command_joint: JointCommand,
            keys.command_gripper: GripperCommand,
            keys.task: Task,
            keys.sim_scene: SceneState,
            keys.sim_objects: ObjectPoses,
        }

    def of(self, key: str) -> type | None:
        """The record type of `key`; None for images, plain text and unknown keys."""
        if key not in self._known:
            self._known[key] = self._look_up(key)
        return self._known[key]

    def _look_up(self, key: str) -> type | None:
        families = (
            (self._keys.delta, ActionChunk),
            (self._keys.spec, ModelSpec),
            (self._keys.status, NodeStatus),
            (self._keys.event, Event),
            (self._keys.seen_record, InferenceDebug),
        )
        name = last_chunk(key)
        part, _, rest = self._keys.short(key).partition("/")
        of_part = self._keys.full(rest)
        if part not in NOT_PARTS and of_part in self._of_parts:
            return self._known[of_part]
        try:
            return next((kind for make, kind in families if make(name) == key), None)
        except ProfileError:
            return None


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
