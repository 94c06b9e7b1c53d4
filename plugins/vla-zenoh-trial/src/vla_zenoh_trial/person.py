"""The operator of a trial: a person at a terminal, or a script that writes lines.

Questions go to stderr; a line typed while the arm moves ends the episode. A script may write all
lines in advance: while the arm moves only an empty line is read, and an invalid line ends the
trial, because the lines after it would be out of step.
"""

from __future__ import annotations

import os
import select
import termios
import threading
import time
from contextlib import suppress

from rich.live import Live
from rich.text import Text

from vla_zenoh.cli.output import errors, printable
from vla_zenoh.errors import NodeError
from vla_zenoh.lab.episode import Interrupted
from vla_zenoh_trial.episode_fsm import EpisodeFsm, Phase
from vla_zenoh_trial.plan import TrialPlan
from vla_zenoh_trial.verdict import END_WORDS

WAIT_S = 0.1
REFRESH_S = 0.2
MAX_LINE_BYTES = 64 * 1024
VERDICTS = "y / n / x (void, repeated), and a note"
EXPECTED = {
    Phase.SETUP: "an empty line when it is set up",
    Phase.BLOCKED: "an empty line to try again, or x and a note",
    Phase.JUDGE: VERDICTS,
}


class Lines:
    """Lines of a file descriptor, with a timeout."""

    def __init__(self, fd: int) -> None:
        self._fd, self._buffer, self._eof = fd, b"", False

    @property
    def over(self) -> bool:
        """End of file, and no line is left."""
        return self._eof and not self._buffer

    def peek(self, timeout_s: float) -> str | None:
        """The next line without consuming it; None after the timeout."""
        if not self._whole() and select.select([self._fd], [], [], timeout_s)[0]:
            data = b""
            with suppress(OSError):  # a terminal that is gone
                data = os.read(self._fd, MAX_LINE_BYTES)
            self._buffer += data
            self._eof = not data
        if not self._whole():
            return None
        return self._buffer.partition(b"\n")[0].decode("utf-8", "replace").rstrip("\r")

    def take(self, timeout_s: float) -> str | None:
        """Consume the next line; None after the timeout."""
        line = self.peek(timeout_s)
        if line is not None:
            self._buffer = self._buffer.partition(b"\n")[2]
        return line

    def forget(self) -> None:
        """Discard what was typed before the next question."""
        termios.tcflush(self._fd, termios.TCIFLUSH)
        self._buffer = b""

    def _whole(self) -> bool:
        # Text without a line feed is a line at end of file, or when it is too long.
        too_long = len(self._buffer) >= MAX_LINE_BYTES
        return b"\n" in self._buffer or too_long or (self._eof and bool(self._buffer))


class TrialPerson:
    """The operator at a terminal or behind a pipe; implements `Operator`.

    Args:
        lays: setups are prepared: ask only after an episode that something else ended.
    """

    def __init__(self, plan: TrialPlan, fd: int, stop: threading.Event, *, lays: bool) -> None:
        self._plan, self._stop, self._lays = plan, stop, lays
        self._lines, self._terminal = Lines(fd), os.isatty(fd)
        self._screen = errors()
        self._live: Live | None = None
        self._refreshed_s = 0.0

    # -- questions ----------------------------------------------------------------------------
    def ask(self, episode: EpisodeFsm) -> str:
        phase = episode.phase
        if phase is Phase.SETUP:
            self._say(self._setup(episode), style="bold")
            if self._lays and not episode.needs_confirmation:
                return ""
            question = "set it up, then press Enter:"
            if episode.needs_confirmation:
                question = "the arm was deactivated: set it up, check that it may move, then Enter:"
        elif phase is Phase.BLOCKED:
            self._say(self._plan.hide(episode.reasons), style="yellow")
            question = "fix it, then press Enter; or x (void, repeated), and a note:"
        else:
            question = f"did it succeed? {VERDICTS}:"
        if self._terminal and phase is not Phase.JUDGE:
            self._lines.forget()  # a surplus Enter must not move the arm
        self._say(question, end=" " if self._terminal else "\n")
        return self._wait()

    def _setup(self, episode: EpisodeFsm) -> str:
        plan, due = self._plan, episode.due
        at = (due.setup - 1) * len(plan.workers) + due.turn
        said = f"episode {at} of {plan.episodes}: setup {due.setup}"
        words = plan.words(due.setup)
        said += f", {words}" if words else ""
        return said if plan.blind else f"{said} (worker {due.worker})"

    def _wait(self) -> str:
        while (line := self._lines.take(WAIT_S)) is None:
            if self._stop.is_set():
                raise Interrupted
            if self._lines.over:
                raise NodeError(
                    "standard input has ended before the trial; the same command continues it"
                )
        return line

    def reject_line(self, line: str, phase: Phase) -> None:
        """See `Operator`. Raises NodeError: it is a line of a script."""
        said = f"{line[:80]!r} is not valid here: {EXPECTED[phase]}"
        if not self._terminal:
            raise NodeError(f"{said}; the same command continues the trial")
        self._say(said, style="yellow")

    # -- while the arm moves ------------------------------------------------------------------
    def poll_line(self) -> str | None:
        """See `Operator`. Raises NodeError: a script has ended, so there is no judge."""
        if self._terminal:
            line = self._lines.take(0.0)
            return "" if line is None and self._lines.over else line
        if self._lines.peek(0.0) == "":
            return self._lines.take(0.0)
        if self._lines.over:
            raise NodeError(
                "standard input has ended while an episode runs; the same command continues the "
                "trial"
            )
        return None

    def show(self, episode: EpisodeFsm) -> None:
        if not (self._terminal and self._screen.is_terminal):
            return
        if self._live is None:
            self._live = Live(console=self._screen, auto_refresh=False, transient=True)
            self._live.start()
        now_s = time.monotonic()
        if now_s - self._refreshed_s >= REFRESH_S:
            self._refreshed_s = now_s
            seen = episode.view
            said = f"{episode.time_s:5.1f} of {episode.seconds:g} s  {seen.state}  "
            said += f"{seen.chunks} chunks  {self._plan.hide(seen.why)}  (Enter ends it)"
            self._live.update(
                Text(printable(said), no_wrap=True, overflow="ellipsis"), refresh=True
            )

    def show_end(self, episode: EpisodeFsm) -> None:
        self._calm()
        assert episode.end is not None
        why = self._plan.hide(episode.why)
        said = f"{END_WORDS[episode.end]}{f': {why}' if why else ''}"
        self._say(f"{said}; {episode.time_s:.1f} s, {episode.view.chunks} chunks")

    def notify(self, text: str) -> None:
        self._calm()
        self._say(text, style="yellow")

    def _calm(self) -> None:
        if self._live is not None:
            self._live.stop()
            self._live = None

    def _say(self, text: str, *, style: str = "", end: str = "\n") -> None:
        self._screen.print(Text(printable(text), style=style), end=end, soft_wrap=True)
