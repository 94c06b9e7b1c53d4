"""Messages of ROS 2 in CDR, by rosbags; decoding raises nothing but `CodecError`."""

from __future__ import annotations

import struct
from collections.abc import Mapping
from typing import Any

from rosbags.serde import SerdeError

from vla_zenoh.errors import CodecError

MAX_MESSAGE_BYTES = 4 * 1024 * 1024
HEADER_BYTES = 4
"""In front of CDR: two for its representation, two of options, which nobody uses."""
_BIG_ENDIAN, _LITTLE_ENDIAN = b"\0\0", b"\0\1"


class CdrMessages:
    """The messages of a type store of rosbags."""

    def __init__(self, store: Any) -> None:
        self._store = store

    @property
    def types(self) -> Mapping[str, Any]:
        """Type -> its class, which takes all fields in order."""
        return self._store.types

    def definition(self, kind: str) -> str:
        """Text of a message and of all that it is made of, as bags and MCAP files keep it."""
        return self._store.generate_msgdef(kind, ros_version=2)[0]

    def encode(self, message: Any) -> bytes:
        """CDR, little-endian, with its header; a `CodecError` if a value does not fit its field."""
        kind: str = message.__msgtype__
        try:
            return bytes(self._store.serialize_cdr(message, kind, little_endian=True))
        except (SerdeError, struct.error, ValueError, TypeError, AttributeError) as error:
            raise CodecError("unencodable", f"{kind}: {str(error)[:200]}") from error

    def decode(self, kind: str, payload: bytes, limit: int = MAX_MESSAGE_BYTES) -> Any:
        """A message of `kind`; its arrays are views into `payload` and read-only.

        As ROS subscribers do, it leaves out what stands behind the message: padding, or the rest
        of a buffer that was larger.

        Raises:
            CodecError: ``oversize`` (more than `limit` bytes) or ``malformed``.
        """
        if len(payload) > limit:
            raise CodecError("oversize", f"{kind} of {len(payload)} bytes, at most {limit}")
        try:
            return self._deserialize(kind, payload)
        except (SerdeError, struct.error, ValueError, IndexError, OverflowError) as error:
            raise CodecError("malformed", f"{kind}: {str(error)[:200]}") from error

    def _deserialize(self, kind: str, payload: bytes) -> Any:
        representation = payload[:2]
        if representation not in (_BIG_ENDIAN, _LITTLE_ENDIAN) or len(payload) < HEADER_BYTES:
            raise CodecError(
                "malformed", f"{kind}: no plain CDR, but representation {representation.hex()!r}"
            )
        of = self._store.get_msgdef(kind)
        read = of.deserialize_cdr_le if representation == _LITTLE_ENDIAN else of.deserialize_cdr_be
        return read(memoryview(payload)[HEADER_BYTES:], 0, of.cls, self._store)[0]
