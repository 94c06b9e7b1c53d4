"""What an examination needs of the place where the model runs."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol, TypeVar

Result = TypeVar("Result")


class Failed(Exception):
    """The model raised."""

    def __init__(self, error: BaseException) -> None:
        super().__init__(f"{type(error).__name__}: {error}")
        self.error = error


class Hung(Exception):
    """The model did not come back in time; nothing more can be asked of it."""


class Bench(Protocol):
    """Where the model runs: who has the clock, the patience, and knows the memory."""

    def call(self, what: Callable[[], Result]) -> tuple[Result, float]:
        """What `what` returns, and the seconds it took.

        Raises:
            Failed: it raised.
            Hung: it did not come back.
        """
        ...

    def memory_kib(self) -> float:
        """Resident memory of the process."""
        ...

    def spent_s(self) -> float:
        """Seconds since the examination began."""
        ...
