"""Samples of a stream: their header, and the filter that lets one writer through at a time."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Generic, TypeVar

from vla_zenoh.errors import CodecError
from vla_zenoh.types.checks import integer, set_field, text


@dataclass(frozen=True, slots=True)
class Header:
    """What stands beside every streamed record.

    Args:
        stamp_wall_ns: time of capture, nanoseconds since the Unix epoch on the writer's clock.
        seq: counts up by one for every record this source writes on this key.
        source: who wrote it: node name and a number that differs after every restart.
    """

    stamp_wall_ns: int
    seq: int
    source: str

    def __post_init__(self) -> None:
        set_field(self, "stamp_wall_ns", integer("stamp_wall_ns", self.stamp_wall_ns))
        set_field(self, "seq", integer("seq", self.seq))
        text("source", self.source, 128)


Record = TypeVar("Record")


@dataclass(frozen=True, slots=True)
class Stamped(Generic[Record]):
    """A record as it arrived.

    Args:
        header: what its writer said of it.
        record: the record.
        received_ns: when it arrived here, same clock as the caller's ``now_ns``.
    """

    header: Header
    record: Record
    received_ns: int


class SingleWriterFilter:
    """Remembers who speaks on a key.

    Another source is heard only when the known one has been silent for a while: it was started
    anew, or it is gone. Until then a stranger cannot put his word in, and what comes again or late
    is not taken for new.

    Args:
        silence_s: after this nobody speaks any more.
    """

    def __init__(self, silence_s: float) -> None:
        self._silence_ns = int(silence_s * 1e9)
        self._source: str | None = None
        self._seq = -1
        self._heard_ns = 0

    def check(self, header: Header, mono_ns: int) -> None:
        """Whether a record of this header may be taken.

        Args:
            header: the record's.
            mono_ns: when it arrived, on the monotonic clock.

        Raises:
            CodecError: ``foreign`` or ``replayed``.
        """
        if self._source is None or mono_ns - self._heard_ns >= self._silence_ns:
            return
        if header.source != self._source:
            raise CodecError(
                "foreign", f"by {header.source[:60]!r}, while {self._source[:60]!r} speaks"
            )
        if header.seq <= self._seq:
            raise CodecError("replayed", f"number {header.seq} came again or late")

    def heard(self, header: Header, mono_ns: int) -> None:
        """A record of this header was taken."""
        self._source, self._seq, self._heard_ns = header.source, header.seq, mono_ns
