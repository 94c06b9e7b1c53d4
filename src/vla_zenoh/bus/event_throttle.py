"""Throttle for the events of a node: new events go out at once, repetitions are counted."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from typing import Any

from vla_zenoh.types import Event

PERIOD_S = 0.25
"""An event of one kind is published at most this often; `count` says how many it stands for."""
KINDS = 512
"""Kinds that are remembered; with more the memory is cleared."""

Kind = tuple[str, str, str]


class EventThrottle:
    """Decides when an event is published.

    Transitions always are. The rejection of a setting is published late rather than never, because
    a client waits for the answer.

    Args:
        publish: publishes an event.
        clock: seconds that never go back.
    """

    def __init__(
        self, publish: Callable[[Event], Any], clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._publish, self._clock = publish, clock
        self._published_s: dict[Kind, float] = {}
        self._held: Counter[Kind] = Counter()
        self._answers: dict[Kind, Event] = {}

    def emit(self, event: Event, about: str = "") -> None:
        """Publish an event, or count it.

        Args:
            event: what happened.
            about: what it is about; each is throttled by itself.
        """
        answers = event.what.endswith("_refused")
        if answers:  # a client gets every reason against its setting, not only the first
            about = event.why
        kind = (event.kind, event.what, about)
        if len(self._published_s) > KINDS:
            self._published_s.clear()
            self._held.clear()
            self._answers.clear()
        if event.kind == "transition" or self._due(kind):
            self._send(kind, event, self._held.pop(kind, 0))
            return
        self._held[kind] += 1
        if answers:
            self._answers[kind] = event

    def poll(self) -> None:
        """Publish the answers that are due."""
        for kind, event in list(self._answers.items()):
            if self._due(kind):
                self._send(kind, event, self._held.pop(kind, 1) - 1)

    def _due(self, kind: Kind) -> bool:
        return self._clock() - self._published_s.get(kind, -1e9) >= PERIOD_S

    def _send(self, kind: Kind, event: Event, others: int) -> None:
        self._published_s[kind] = self._clock()
        self._answers.pop(kind, None)
        self._publish(replace(event, count=event.count + others) if others else event)
