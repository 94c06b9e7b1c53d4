"""Distinguishes operators from repeating programs on the boolean activation topic."""

from __future__ import annotations

QUIET_S = 2.0
"""A faster repetition comes from a program: ``ros2 topic pub`` repeats once a second by default,
operators are slower."""


class ActivationFilter:
    """Lets every ``false`` deactivate, and only an operator's ``true`` activate.

    An arm that was lost or stopped must not restart because a program keeps publishing ``true``,
    nor because that program is received again after a lost link or a restart of this node. ``true``
    counts after `QUIET_S` without any, the time before the first message included; once a program
    has repeated it, a ``false`` has to come first, however long the silence.

    Args:
        mono_ns: start of the subscription; monotonic, as all times here.
    """

    def __init__(self, mono_ns: int) -> None:
        self._true_ns = mono_ns
        self._repeated = False

    def take(self, word: bool, mono_ns: int) -> bool:
        """Whether to apply this message, received at `mono_ns`."""
        if not word:
            self._repeated = False
            return True
        quiet = mono_ns - self._true_ns >= QUIET_S * 1e9
        self._true_ns = mono_ns
        if not quiet:
            self._repeated = True
        return quiet and not self._repeated
