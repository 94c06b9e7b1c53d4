"""What is on a key, as a person reads it. Used by echo and keys."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import zenoh

from vla_zenoh.bus.buffers import bytes_of, header_of
from vla_zenoh.codec import message
from vla_zenoh.errors import CodecError

MAX_TEXT = 400


def plain(value: Any) -> Any:
    """Arrays as lists, bytes as their number, so that JSON can carry it."""
    if isinstance(value, np.ndarray):
        return [round(float(v), 6) for v in value] if value.ndim == 1 else value.tolist()
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, dict):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(item) for item in value]
    if isinstance(value, bytes):
        return f"<{len(value)} bytes>"
    return value


def encoding_of(sample: zenoh.Sample) -> str:
    """Encoding as text, the way Zenoh writes it."""
    return str(sample.encoding)


def content(sample: zenoh.Sample) -> Any:
    """The payload decoded as its encoding says, else as text, else its size."""
    encoding = encoding_of(sample)
    try:
        return read(bytes_of(sample.payload, message.MAX_PAYLOAD_BYTES), encoding)
    except CodecError as error:
        return f"<{encoding}: {error}>"


def read(payload: bytes, encoding: str) -> Any:
    """Likewise, of bytes and an encoding as text."""
    if encoding.startswith("application/msgpack"):
        try:
            return plain(message.unpack(payload))
        except CodecError as error:
            return f"<{error}>"
    if "rgb8" in encoding or encoding.startswith("image/"):
        return f"<{encoding}, {len(payload)} bytes>"
    try:
        return payload[:MAX_TEXT].decode("utf-8")
    except UnicodeDecodeError:
        return f"<{len(payload)} bytes>"


def head(sample: zenoh.Sample) -> dict[str, Any] | None:
    """The header, None where there is none that can be read."""
    try:
        header = header_of(sample)
    except CodecError:
        return None
    return dataclasses.asdict(header)


def text(payload: zenoh.ZBytes) -> str:
    """A setting's words, at most `MAX_TEXT` of them; what is no UTF-8 is replaced."""
    return bytes_of(payload)[:MAX_TEXT].decode("utf-8", "replace")
