"""A map of bounded size, for what is kept under names that others choose."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable
from typing import TypeVar

Key = TypeVar("Key")
Value = TypeVar("Value")


class Bounded(OrderedDict[Key, Value]):
    """At most `size` entries: of those of the lowest `rank` the one set longest ago makes room.

    Attributes:
        dropped: number of entries that made room, a newcomer of too low a rank among them.
    """

    def __init__(self, size: int, rank: Callable[[Key], int] = lambda _: 0) -> None:
        super().__init__()
        self._size, self._rank = size, rank
        self.dropped = 0

    def __setitem__(self, key: Key, value: Value) -> None:
        super().__setitem__(key, value)
        self.move_to_end(key)
        if len(self) > self._size:
            del self[min(self, key=self._rank)]
            self.dropped += 1
