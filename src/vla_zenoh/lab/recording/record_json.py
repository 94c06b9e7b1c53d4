"""Records as JSON that people and tools read and that restores the exact payload.

A message of a recording is the JSON object of the record's fields, arrays as nested lists. Where
encoding these fields again does not give the original bytes, ``_payload`` holds them in base64. Of
bytes that are no record the object is ``_payload`` alone; ``_attachment`` holds the attachment
where it does not fit into the fields of an MCAP message.
"""

from __future__ import annotations

import json
import typing
from base64 import b64decode, b64encode
from functools import cache
from typing import Any

import numpy as np

from vla_zenoh.codec import message
from vla_zenoh.errors import CodecError
from vla_zenoh.policy import ModelSpec

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
        exact = message.pack(_with_arrays(kind, json.loads(text))) == payload
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
            fields = _with_arrays(kind, fields)
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


@cache
def _array_types(kind: type) -> dict[str, np.dtype[Any]]:
    """Element type of each array field of a record."""
    if kind is ModelSpec:
        return {}
    return {
        name: np.dtype("<f4" if "float32" in str(hint) else "<f8")
        for name, hint in typing.get_type_hints(kind).items()
        if "ndarray" in str(hint)
    }


def _with_arrays(kind: type, fields: dict[str, Any]) -> dict[str, Any]:
    types = _array_types(kind)
    return {
        name: _array(value, types[name]) if name in types and value is not None else value
        for name, value in fields.items()
    }


def _array(value: Any, dtype: np.dtype[Any]) -> Any:
    if isinstance(value, dict):  # of a field that maps names to arrays
        return {name: np.array(part, dtype) for name, part in value.items()}
    return np.array(value, dtype)


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
    return _base64(value) if isinstance(value, bytes) else value.tolist()
