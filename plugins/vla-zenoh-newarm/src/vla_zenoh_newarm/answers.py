"""What a person answers in place of a guess: by an option, or when asked on a terminal."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import typer

from vla_zenoh.errors import ProfileError

NONE = "none"


class Guess(NamedTuple):
    """Something in a profile that nobody has confirmed.

    Args:
        place: in the profile, as ``robot.home_rad``.
        what: the guess, and what it rests on.
    """

    place: str
    what: str


class Answers:
    """Answers of a person, and the guesses for which there is none.

    Args:
        given: option -> its text; None: not given.
        ask: whether a person can be asked.
    """

    def __init__(self, given: Mapping[str, str | None], *, ask: bool) -> None:
        self._given, self._ask = given, ask
        self.guesses: list[Guess] = []

    def text(self, option: str, guess: str, place: str, what: str) -> str:
        """The answer that `option` gives, or a person; else `guess`, which is noted.

        Whoever presses Enter has not confirmed the guess.
        """
        given = self._given[option]
        if given is None and self._ask:
            answer = typer.prompt(f"{place}: {what}", default=guess, err=True)
            given = None if answer == guess else answer
        if given is None:
            self.guesses.append(Guess(place, f"{guess}; {what}"))
            return guess
        return given

    def numbers(
        self, option: str, guess: Sequence[float], place: str, what: str, counts: Sequence[int]
    ) -> tuple[float, ...]:
        """An answer of as many numbers as one of `counts`; none where that is 0."""
        text = self.text(option, ",".join(f"{value:g}" for value in guess) or NONE, place, what)
        if text == NONE and 0 in counts:
            return ()
        try:
            numbers = tuple(float(word) for word in text.split(","))
        except ValueError:
            numbers = ()
        if len(numbers) not in counts:
            wanted = " or ".join(str(count) for count in counts if count)
            raise ProfileError(
                f"--{option} {text!r}: give {wanted} number(s), separated by commas"
                + (f", or {NONE}" if 0 in counts else "")
            )
        return numbers

    def option(self, option: str) -> str | None:
        """The text of an option; None: it is not given."""
        return self._given[option]
