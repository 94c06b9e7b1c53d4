"""Which words of a topic of booleans are a person's: programs say the same again and again."""

from __future__ import annotations

QUIET_S = 2.0
"""A word that comes again sooner is a program's: ``ros2 topic pub`` repeats once a second unless it
is told otherwise, people press more slowly."""


class ActivationFilter:
    """What may be switched off by every ``false``, and on by a person's ``true`` alone.

    An arm that was lost or stopped must not begin anew because some program has gone on saying
    ``true``, nor because that program is heard again after a link was gone or we were started anew.
    So ``true`` counts when none was heard for `QUIET_S`, the time before the first word included;
    and once a program has repeated it, ``false`` has to come first, however long the silence.

    Args:
        mono_ns: when it is first listened to; monotonic, as all times here.
    """

    def __init__(self, mono_ns: int) -> None:
        self._true_ns = mono_ns
        self._repeated = False

    def take(self, word: bool, mono_ns: int) -> bool:
        """Whether this word, which arrived then, is to be obeyed."""
        if not word:
            self._repeated = False
            return True
        quiet = mono_ns - self._true_ns >= QUIET_S * 1e9
        self._true_ns = mono_ns
        if not quiet:
            self._repeated = True
        return quiet and not self._repeated
