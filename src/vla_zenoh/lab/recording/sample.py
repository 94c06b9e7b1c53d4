"""A sample of one key, as it was received."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any

from vla_zenoh.codec import records
from vla_zenoh.codec.image import decode_depth
from vla_zenoh.errors import CodecError
from vla_zenoh.types import Depth, Header

MSGPACK, JPEG, TEXT = "application/msgpack", "image/jpeg", "text/plain"
RAW = "zenoh/bytes;rgb8;"
"""Prefix of the encoding of raw images; height and width follow."""
DEPTH = "image/png;depth16;"
"""Prefix of the encoding of depth pictures; the metres of a count follow."""


@dataclass(frozen=True, slots=True)
class Sample:
    """Payload, encoding and header of one sample of a key.

    Args:
        encoding: as Zenoh writes it, for example ``image/jpeg``.
        header: its header, None for settings.
        received_ns: time of reception, wall clock of the receiver.
        attachment: bytes of an attachment that is no header; None with a header, or without any
            attachment.
        kind: type of the record; None for images, settings, unknown bytes, and off the wire.
        fields: of the record as decoded, not validated; None as `kind`.
        client: number of the Zenoh session that put a setting, as that session says; empty: it
            does not, or it is off a recording.
    """

    key: str
    payload: bytes
    encoding: str
    header: Header | None
    received_ns: int
    attachment: bytes | None = None
    kind: type | None = field(default=None, compare=False)
    fields: Mapping[str, Any] | None = field(default=None, compare=False)
    client: str = field(default="", compare=False)

    @property
    def stamp_ns(self) -> int:
        """The header's stamp; without a header the time of reception."""
        return self.received_ns if self.header is None else self.header.stamp_wall_ns

    @property
    def attached(self) -> bytes | None:
        """The attachment to publish the sample with."""
        return self.attachment if self.header is None else records.encode_header(self.header)

    @property
    def text(self) -> str:
        return self.payload.decode("utf-8", "replace")

    def record(self) -> Any:
        """The validated record of type `kind`.

        Raises:
            CodecError: the payload is no record, or a value is not allowed.
        """
        if self.kind is None:
            raise CodecError("malformed", f"{self.key} carries no record")
        return records.from_map(self.kind, self.fields)

    def depth(self) -> Depth:
        """The depth image, whose encoding begins with `DEPTH`.

        Raises:
            CodecError: it cannot be decoded.
        """
        return decode_depth(self.payload, self.encoding.partition(";")[2])


def stamps_moved(fields: Mapping[str, Any], moved_ns: Callable[[int], int]) -> dict[str, Any]:
    """Fields with moved stamps, also in the only nested map of records, the cause of a command."""
    return {
        name: moved_ns(value)
        if name.endswith("_ns") and type(value) is int
        else stamps_moved(value, moved_ns)
        if name == "cause" and isinstance(value, Mapping)
        else value
        for name, value in fields.items()
    }


def received_sample(
    key: str,
    payload: bytes,
    encoding: str,
    attachment: bytes | None,
    received_ns: int,
    client: str = "",
) -> Sample:
    """A sample off the wire; an attachment that is no header is kept as bytes."""
    header = None
    if attachment is not None:
        with suppress(CodecError):
            header, attachment = records.decode_header(attachment), None
    return Sample(key, payload, encoding, header, received_ns, attachment, client=client)
