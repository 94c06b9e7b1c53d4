"""One writer at a time on a key, and each of its records once."""

from __future__ import annotations

from vla_zenoh.errors import CodecError
from vla_zenoh.types import Header


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
