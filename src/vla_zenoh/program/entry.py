"""Entry of ``vla-zenoh``: the priority of a stop, its output, and errors as one line."""

from __future__ import annotations

import errno
import io
import os
import sys
from contextlib import suppress
from typing import Any

from vla_zenoh.cli.silence import silence

EXTRA_OF = {
    **dict.fromkeys(("pinocchio", "ruckig", "daqp"), "control"),
    **dict.fromkeys(("mujoco", "av"), "sim"),
    **dict.fromkeys(("mcap", "plotly", "jinja2", "rosbags"), "record"),
}
"""Module -> extra that brings it, for the error of a missing import."""
HASTE = -20
"""Niceness of a stop."""
NO_HOME = "Could not determine home directory"
"""What pathlib says, as in a container with a user that it does not know."""
QUIET_OPTIONS = {"--help", "--wait-key"}
UNHINDERED = ("stop", "up")
"""Commands that an output which cannot be written must not end: a full disk, a reader that left."""


class _Lossy:
    """An output that loses what cannot be written."""

    def __init__(self, stream: Any) -> None:
        self._stream = stream

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)

    def write(self, text: str) -> int:
        with suppress(OSError):
            self._stream.write(text)
        return len(text)

    def flush(self) -> None:
        with suppress(OSError):
            self._stream.flush()


def main() -> None:
    """Run the command line. Errors of this package become one line and exit code 1.

    Under a supervisor every error becomes one line for it, and the traceback lines for its log.
    """
    _open_outputs()
    if sys.argv[1:2] == ["stop"]:  # runs before other programs, where permitted
        with suppress(OSError):
            os.setpriority(os.PRIO_PROCESS, 0, HASTE)
        if QUIET_OPTIONS.isdisjoint(sys.argv):
            silence.start()
    try:
        from vla_zenoh.program.main import app

        try:
            app()
        finally:
            silence.cancel()
            sys.stdout.flush()
    except KeyboardInterrupt:
        sys.exit(130)
    except BrokenPipeError:  # whatever reads the output has ended, as `head` does
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(1)
    except Exception as error:
        from vla_zenoh.runtime.process import PARENT_VARIABLE

        sentence = _sentence(error)
        if isinstance(error, OSError) and error.errno == errno.ENOSPC and not error.filename:
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
            sentence = f"the output cannot be written: {error.strerror}"
        if PARENT_VARIABLE in os.environ:
            _tell_supervisor(error, sentence)
            sys.exit(1)
        if sentence is None:
            raise
        from vla_zenoh.cli.plain import fail

        fail(sentence)


def _open_outputs() -> None:
    """Outputs in place of closed ones, whose numbers the next file or socket would get."""
    while (number := os.open(os.devnull, os.O_RDWR)) < 3:
        pass
    os.close(number)
    for number, name in ((1, "stdout"), (2, "stderr")):
        if getattr(sys, name) is None:
            setattr(sys, name, io.TextIOWrapper(io.FileIO(number, "w", closefd=False)))
        if sys.argv[1:2] and sys.argv[1] in UNHINDERED:
            setattr(sys, name, _Lossy(getattr(sys, name)))


def _sentence(error: Exception) -> str | None:
    """Message of an expected error; None: it is a mistake in a program."""
    from vla_zenoh.errors import VlaZenohError, how_to_install

    if isinstance(error, VlaZenohError):
        return str(error)
    if isinstance(error, RuntimeError) and str(error).startswith(NO_HOME):
        return "this user has no home folder: set HOME"
    if isinstance(error, OSError) and error.filename is not None:  # permissions, disk, names
        return f"{error.filename}: {error.strerror}"
    if not isinstance(error, ImportError):
        return None
    extra = EXTRA_OF.get((error.name or "").partition(".")[0])
    if extra:
        return f"{error}; install it with: {how_to_install(extra)}"
    return f"{error}; `vla-zenoh doctor` names the system package" if ".so" in str(error) else None


def _tell_supervisor(error: Exception, sentence: str | None) -> None:
    import traceback

    from vla_zenoh.cli.plain import say
    from vla_zenoh.runtime.process import DETAIL, FATAL

    for line in "".join(traceback.format_exception(error)).splitlines():
        say(f"{DETAIL}{line}")
    what = sentence or f"{type(error).__name__}: {error}"
    say(f"{FATAL}{'; '.join(what.splitlines())}")
