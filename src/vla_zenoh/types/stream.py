"""Samples of a stream: their header, and the filter that lets one writer through at a time."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Generic, Literal, TypeVar

from vla_zenoh.errors import CodecError
from vla_zenoh.types.checks import integer, set_field, text


@dataclass(frozen=True, slots=True)
class Header:
    """Header of a streamed sample; it travels as the sample's attachment.

    Args:
        stamp_wall_ns: time of capture, nanoseconds since the Unix epoch on the writer's clock.
        seq: sequence number, one more for every sample of this source on this key.
        source: node name and a number that differs after every restart.
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
    """A record as received.

    Args:
        header: of the sample.
        record: the record.
        received_ns: time of arrival here, same clock as the caller's ``now_ns``.
    """

    header: Header
    record: Record
    received_ns: int


class SingleWriterFilter:
    """Passes the samples of one source at a time, and each of them once.

    The first source becomes the writer. Samples of any other source are rejected until the writer
    is released or has been silent, so no other source can interfere with a live stream. Times are
    of any clock that never goes back.

    Args:
        silence_s: a writer that is silent for this long is forgotten; None: never.
        sources: sources whose last sequence number is remembered, at least 1. With more than one
            no source becomes the writer: they may take turns.

    Attributes:
        writer: source whose samples pass, empty if any may begin.
    """

    def __init__(self, silence_s: float | None = None, sources: int = 1) -> None:
        self._silence_ns = None if silence_s is None else int(silence_s * 1e9)
        self._sources = sources
        self._last_seq: dict[str, int] = {}  # the source that wrote last comes last
        self._accepted_ns = 0
        self.writer = ""

    def objection(
        self, header: Header, now_ns: int = 0, writer: str = ""
    ) -> Literal["foreign", "replayed"] | None:
        """Why a sample is to be rejected, None if it may be accepted.

        Args:
            header: of the sample.
            now_ns: when it arrived.
            writer: the only source that may write, if the caller knows it.
        """
        if self._silent(now_ns):
            return None
        writer = writer or self.writer
        if writer and header.source != writer:
            return "foreign"
        return "replayed" if header.seq <= self._last_seq.get(header.source, -1) else None

    def is_next(self, header: Header) -> bool:
        """Whether a sample is of the writer, and newer than all that were accepted."""
        return header.source == self.writer and header.seq > self._last_seq.get(header.source, -1)

    def check(self, header: Header, now_ns: int = 0, writer: str = "") -> None:
        """Raise an error for a sample that is to be rejected, see `objection`.

        Raises:
            CodecError: ``foreign`` or ``replayed``.
        """
        reason = self.objection(header, now_ns, writer)
        if reason == "foreign":
            writer = writer or self.writer
            raise CodecError(
                reason, f"from {header.source[:60]!r}, but {writer[:60]!r} is writing this stream"
            )
        if reason == "replayed":
            raise CodecError(reason, f"sample {header.seq} is a repetition or out of order")

    def accept(self, header: Header, now_ns: int = 0) -> None:
        """Note that a sample was accepted."""
        if self._silent(now_ns):
            self._last_seq.clear()
        self._last_seq.pop(header.source, None)
        self._last_seq[header.source] = header.seq
        if len(self._last_seq) > self._sources:
            del self._last_seq[next(iter(self._last_seq))]
        self._accepted_ns = now_ns
        self.writer = header.source if self._sources == 1 else ""

    def release(self) -> None:
        """Let any source begin; samples accepted before are still replays."""
        self.writer = ""

    def reset(self) -> None:
        """Forget every source."""
        self.writer = ""
        self._last_seq.clear()

    def _silent(self, now_ns: int) -> bool:
        return self._silence_ns is not None and now_ns - self._accepted_ns >= self._silence_ns
