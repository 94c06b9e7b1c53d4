"""The terminal as a keyboard: bytes as they are typed, and everything as it was afterwards."""

from __future__ import annotations

import os
import select
import sys
import termios
import threading
import tty
from collections.abc import Callable

from vla_zenoh.errors import NodeError
from vla_zenoh.lab.teleop.keystrokes import BEGIN, END

LOOK_S = 0.2
_DISABLED = b"\x00"


class Terminal:
    """Reads keys in a thread while the block lasts.

    Args:
        read: is given bytes as they come, on that thread.
        gone: called once when there will be no more.

    Raises:
        NodeError: standard input is no terminal.
    """

    def __init__(self, read: Callable[[bytes], None], gone: Callable[[], None]) -> None:
        if not (sys.stdin.isatty() and sys.stdout.isatty()):
            raise NodeError(
                "teleop needs a terminal: its keyboard says what the arm does; start it in one, "
                "without pipes (over ssh: `ssh -t`)"
            )
        self._read, self._gone = read, gone
        self._in, self._out = sys.stdin.fileno(), sys.stdout.fileno()
        self._end = threading.Event()
        self._thread = threading.Thread(target=self._listen, name="keyboard", daemon=True)

    def __enter__(self) -> Terminal:
        self._before = termios.tcgetattr(self._in)
        tty.setcbreak(self._in)  # Ctrl-C stays a signal
        mode = termios.tcgetattr(self._in)
        # Ctrl-Z would leave an arm with a worker that sleeps.
        mode[6][termios.VSUSP] = _DISABLED
        termios.tcsetattr(self._in, termios.TCSADRAIN, mode)
        os.write(self._out, BEGIN)
        self._thread.start()
        return self

    def _listen(self) -> None:
        while not self._end.is_set():
            ready, _, _ = select.select([self._in], [], [], LOOK_S)
            if not ready:
                continue
            try:
                data = os.read(self._in, 1024)
            except OSError:
                data = b""
            if not data:
                self._gone()
                return
            self._read(data)

    def show(self, line: str) -> None:
        """Replace the last line."""
        os.write(self._out, f"\r\x1b[K{line}".encode())

    def say(self, line: str) -> None:
        """A line that stays, above it."""
        os.write(self._out, f"\r\x1b[K{line}\r\n".encode())

    def __exit__(self, *_: object) -> None:
        self._end.set()
        self._thread.join(2 * LOOK_S)
        # A terminal that is gone has nothing to be put back.
        try:
            os.write(self._out, END + b"\r\x1b[K")
            termios.tcsetattr(self._in, termios.TCSAFLUSH, self._before)
        except (OSError, termios.error):
            pass
