"""One sample of one key, as it was heard."""

from __future__ import annotations

from dataclasses import dataclass

from vla_zenoh.codec import records
from vla_zenoh.errors import CodecError
from vla_zenoh.types import Header

MSGPACK, JPEG, TEXT = "application/msgpack", "image/jpeg", "text/plain"
RAW = "zenoh/bytes;rgb8;"
"""Beginning of a raw picture's encoding; its height and width follow."""


@dataclass(frozen=True, slots=True)
class Sample:
    """What a key said once.

    Args:
        key: the whole key.
        payload: bytes.
        encoding: as Zenoh writes it, for example ``image/jpeg``.
        header: what the writer said of it, None for settings.
        heard_ns: when it arrived, wall clock of whoever heard it.
        attachment: bytes that came in a header's place and are none; None with a header, or
            without any attachment.
    """

    key: str
    payload: bytes
    encoding: str
    header: Header | None
    received_ns: int
    attachment: bytes | None = None

    @property
    def stamp_ns(self) -> int:
        """Its header's stamp, or when it was heard."""
        return self.received_ns if self.header is None else self.header.stamp_wall_ns

    @property
    def attached(self) -> bytes | None:
        """The attachment to put it with."""
        return self.attachment if self.header is None else records.encode_header(self.header)


def heard(
    key: str, payload: bytes, encoding: str, attachment: bytes | None, received_ns: int
) -> Sample:
    """A sample of what came from the wire, whatever it is."""
    header = None
    if attachment is not None:
        try:
            header = records.decode_header(attachment)
        except CodecError:
            return Sample(key, payload, encoding, None, received_ns, attachment)
    return Sample(key, payload, encoding, header, received_ns)
