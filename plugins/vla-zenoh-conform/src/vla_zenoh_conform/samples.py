"""Samples as they arrived, decoded and judged by nobody yet."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

from vla_zenoh.codec import records
from vla_zenoh.codec.image import decode_depth, decode_jpeg, decode_raw
from vla_zenoh.errors import CodecError
from vla_zenoh.lab.recording.record_types import record_of
from vla_zenoh.types import Header, shown

IMAGES: Mapping[str, tuple[str, Callable[[bytes, str], Any]]] = {
    "raw": ("zenoh/bytes", decode_raw),
    "jpeg": ("image/jpeg", lambda payload, schema: decode_jpeg(payload)),
    "depth": ("image/png", decode_depth),
}
"""End of a camera's key -> encoding, and decoder of payload and the encoding's schema."""


class Raw(NamedTuple):
    """A sample as it arrived at `received_ns`, wall clock; `key` is below the robot."""

    key: str
    payload: bytes
    attachment: bytes | None
    encoding: str
    received_ns: int


@dataclass(frozen=True, slots=True)
class Arrived:
    """One sample.

    Args:
        header, record: None where they do not decode.
        why: it does not.
        unknown: fields that this version does not know.
    """

    key: str
    received_ns: int
    header: Header | None
    record: Any
    why: str = ""
    unknown: tuple[str, ...] = ()


def arrived(raw: Raw) -> Arrived:
    """The sample of its bytes."""
    unknown: list[str] = []
    header = None
    try:
        header = records.decode_header(raw.attachment)
        record = _record(raw, unknown)
    except CodecError as error:
        return Arrived(raw.key, raw.received_ns, header, None, f"{error.reason}: {error}")
    return Arrived(raw.key, raw.received_ns, header, record, unknown=tuple(unknown))


def _record(raw: Raw, unknown: list[str]) -> Any:
    kind = record_of(raw.key)
    if kind is not None:
        return records.decode(kind, raw.payload, unknown)
    encoding, _, schema = raw.encoding.partition(";")
    wanted, decode = IMAGES[raw.key.rpartition("/")[2]]
    if encoding != wanted:
        raise CodecError("malformed", f"encoding {shown(raw.encoding)}, wanted: {wanted}")
    return decode(raw.payload, schema)


def of_key(samples: Iterable[Arrived], key: str) -> list[Arrived]:
    """The samples of a key, in the order of their arrival."""
    return [sample for sample in samples if sample.key == key]
