"""Stamps of a recording in the order of its samples, also where the clocks of writers differ."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from typing import NamedTuple

from vla_zenoh.keys import Keys
from vla_zenoh.lab.recording.sample import Sample, stamps_moved
from vla_zenoh.types import Header

CLOCK_STEP_NS = 20_000_000
"""Stamps of one key that go back by less are of writers whose clocks differ a little."""


class _Newest(NamedTuple):
    """Of a key: who wrote last, its stamp as set forward, and when it was received."""

    source: str
    stamp_ns: int
    received_ns: int


class StampOrder:
    """Finds where the stamps on a key go back, and sets those of that writer forward by as much.

    The times of reception are the measure: they are of one monotonic clock.
    """

    def __init__(self, keys: Keys) -> None:
        self.steps: list[str] = []
        """Messages about clocks that were set back, or differ."""
        self._keys, self._began_ns = keys, 0
        self._newest: dict[str, _Newest] = {}
        # Of a key and a source:
        self._headers: dict[tuple[str, str], Header] = {}
        self._back_ns: Counter[tuple[str, str]] = Counter()

    def take(self, entry: Sample) -> Sample:
        """The next sample, with all its stamps in order with those before it on its key."""
        self._began_ns = self._began_ns or entry.received_ns
        now = entry.header
        if now is None:
            return entry
        of = entry.key, now.source
        before = self._headers.get(of, now)
        if now.seq >= before.seq:  # else it was sent before it
            self._headers[of] = now
            self._note(entry, now, was_set=now.stamp_wall_ns < before.stamp_wall_ns)
        by_ns = self._back_ns[of]
        if not by_ns:
            return entry
        header = replace(now, stamp_wall_ns=now.stamp_wall_ns + by_ns)
        fields = entry.fields and stamps_moved(entry.fields, lambda at_ns: at_ns and at_ns + by_ns)
        return replace(entry, header=header, fields=fields)

    def _note(self, entry: Sample, now: Header, *, was_set: bool) -> None:
        """Compare the newest sample of a writer with the one before it on its key."""
        key, of = entry.key, (entry.key, now.source)
        stamp_ns = now.stamp_wall_ns + self._back_ns[of]
        last = self._newest.get(key, _Newest(now.source, stamp_ns, entry.received_ns))
        back_ns = last.stamp_ns - stamp_ns
        if back_ns > CLOCK_STEP_NS:
            back_ns += entry.received_ns - last.received_ns
            self._back_ns[of] += back_ns
            stamp_ns += back_ns
            why = "was set back" if was_set else f"is behind that of {last.source!r}"
            self.steps.append(
                f"{(entry.received_ns - self._began_ns) / 1e9:.1f} s after its beginning the "
                f"stamps on {self._keys.short(key)} go back by {back_ns / 1e9:.3f} s: the clock of "
                f"{now.source!r} {why}; its stamps are set forward by as much"
            )
        self._newest[key] = _Newest(now.source, stamp_ns, entry.received_ns)
