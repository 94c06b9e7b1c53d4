"""Moves recorded samples to another time, robot and source.

All stamps move alike: that of the header, and every field of the record whose name ends in ``_ns``
(of the observation, the end of validity, ...). At the original speed they move by one constant, so
all latencies stay the same. At another speed ages scale as all other times do.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from vla_zenoh.codec import message
from vla_zenoh.keys import Keys
from vla_zenoh.lab.recording.sample import Sample
from vla_zenoh.types import Header

STAMP = "_ns"


class Restamper:
    """Moves samples of one pass over a file.

    Args:
        began_ns: start of the recording, wall clock of its recorder.
        starts_ns: start of the pass, wall clock here.
        speed: 2 is twice as fast.
        here: the recorded robot's keys.
        there: of the robot it is replayed as.
        suffix: of the sources, another one in each pass: subscribers drop repeated sequence numbers
            of the same source.
    """

    def __init__(
        self, began_ns: int, starts_ns: int, speed: float, here: Keys, there: Keys, suffix: str
    ) -> None:
        self._began_ns, self._starts_ns, self._speed = began_ns, starts_ns, speed
        self._here, self._there, self._suffix = here, there, suffix

    def moved_ns(self, stamp_ns: int) -> int:
        """A stamp of the recording moved to the pass; 0 means none and stays."""
        if stamp_ns == 0:
            return 0
        since_ns = stamp_ns - self._began_ns
        if self._speed != 1.0:
            since_ns = round(since_ns / self._speed)
        return max(0, self._starts_ns + since_ns)

    def move(self, entry: Sample) -> Sample:
        """The sample to publish, at the time `received_ns`."""
        header = entry.header
        if header is not None:
            node, _, _ = header.source.partition("#")
            source = f"{node}#{self._suffix}"
            header = Header(self.moved_ns(header.stamp_wall_ns), header.seq, source)
        payload = entry.payload
        if entry.fields is not None:
            payload = message.pack(_stamps_moved(entry.fields, self.moved_ns))
        return Sample(
            self._there.full(self._here.short(entry.key)),
            payload,
            entry.encoding,
            header,
            self.moved_ns(entry.received_ns),
            entry.attachment,
        )


def _stamps_moved(fields: Mapping[str, Any], moved_ns: Callable[[int], int]) -> dict[str, Any]:
    """Fields with moved stamps, also in the only nested map of records, the cause of a command."""
    out = dict(fields)
    for name, value in fields.items():
        if name.endswith(STAMP) and type(value) is int:
            out[name] = moved_ns(value)
        elif name == "cause" and isinstance(value, Mapping):
            out[name] = _stamps_moved(value, moved_ns)
    return out
