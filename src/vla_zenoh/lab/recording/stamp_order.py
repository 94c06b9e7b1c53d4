"""Stamps of a recording in the order of its samples, also where a writer's clock was set back."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace

from vla_zenoh.keys import Keys
from vla_zenoh.lab.recording.sample import Sample, stamps_moved
from vla_zenoh.types import Header

CLOCK_STEP_NS = 20_000_000
"""Stamps of one key that go back by less are of writers whose clocks differ a little."""


class StampOrder:
    """Finds where the stamps on a key go back, and sets the later ones forward by as much.

    The times of reception are the measure: they are of one monotonic clock.
    """

    def __init__(self, keys: Keys) -> None:
        self.steps: list[str] = []
        """Messages about clocks that were set back."""
        self._keys, self._began_ns = keys, 0
        self._newest: dict[str, tuple[Header, int]] = {}
        self._back_ns: Counter[str] = Counter()

    def take(self, entry: Sample) -> Sample:
        """The next sample, with all its stamps on the clock with which its key began."""
        self._began_ns = self._began_ns or entry.received_ns
        now, key = entry.header, entry.key
        if now is None:
            return entry
        before, received_ns = self._newest.get(key, (now, 0))
        if now.source != before.source or now.seq >= before.seq:  # else it was sent before it
            back_ns = before.stamp_wall_ns - now.stamp_wall_ns
            if back_ns > CLOCK_STEP_NS:
                back_ns += entry.received_ns - received_ns
                self._back_ns[key] += back_ns
                self.steps.append(
                    f"{(entry.received_ns - self._began_ns) / 1e9:.1f} s after its beginning the "
                    f"stamps on {self._keys.short(key)} go back by {back_ns / 1e9:.3f} s: the "
                    f"clock of {now.source!r} was set back, or another host's differs; times "
                    "across that moment are wrong"
                )
            self._newest[key] = now, entry.received_ns
        by_ns = self._back_ns[key]
        if not by_ns:
            return entry
        header = replace(now, stamp_wall_ns=now.stamp_wall_ns + by_ns)
        fields = entry.fields and stamps_moved(entry.fields, lambda at_ns: at_ns and at_ns + by_ns)
        return replace(entry, header=header, fields=fields)
