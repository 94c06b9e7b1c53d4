"""Events of a node: told at once, and a flood of the same thinned out and counted."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from typing import Any

from vla_zenoh.types import Event

PERIOD_S = 0.25
"""The same kind of event is written at most this often; what came between is counted in `count`."""
KINDS = 512
"""So many kinds are remembered; whoever makes up more begins anew."""

Kind = tuple[str, str, str]


class EventThrottle:
    """Decides when an event is written.

    Transitions always are. Of all others each kind has its turn; the refusal of a setting that had
    none is told when it has, for somebody waits for an answer.

    Args:
        write: writes an event.
        clock: seconds that only go up.
    """

    def __init__(
        self, write: Callable[[Event], Any], clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._put, self._clock = write, clock
        self._written_s: dict[Kind, float] = {}
        self._held: Counter[Kind] = Counter()
        self._answers: dict[Kind, Event] = {}

    def emit(self, event: Event, about: str = "") -> None:
        """Write an event, or count it.

        Args:
            event: what happened.
            about: what it is about; a flood about one thing does not silence another's.
        """
        answers = event.what.endswith("_refused")
        if answers:  # a person is told every reason of a refused setting, not only the first
            about = event.why
        kind = (event.kind, event.what, about)
        if len(self._written_s) > KINDS:
            self._written_s.clear()
            self._held.clear()
            self._answers.clear()
        if event.kind == "transition" or self._due(kind):
            self._write(kind, event, self._held.pop(kind, 0))
            return
        self._held[kind] += 1
        if answers:
            self._answers[kind] = event

    def tick(self) -> None:
        """Tell what was asked again too soon to be answered then."""
        for kind, event in list(self._answers.items()):
            if self._due(kind):
                self._write(kind, event, self._held.pop(kind, 1) - 1)

    def _due(self, kind: Kind) -> bool:
        return self._clock() - self._written_s.get(kind, -1e9) >= PERIOD_S

    def _write(self, kind: Kind, event: Event, others: int) -> None:
        self._written_s[kind] = self._clock()
        self._answers.pop(kind, None)
        self._put(replace(event, count=event.count + others) if others else event)
