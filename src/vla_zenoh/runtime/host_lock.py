"""A lock that only one `vla-zenoh up` per host and robot can hold, and which process holds it."""

from __future__ import annotations

import fcntl
import json
import os
import tempfile
import time
from contextlib import suppress
from pathlib import Path

from vla_zenoh.errors import NodeError


class HostLock:
    """Held from `take` until `release`, or the end of the process, however it ends.

    Args:
        name: of the lock file, one for each thing that may run only once.
        what: the same in words, for the error.
    """

    def __init__(self, name: str, what: str) -> None:
        readable = "".join(c if c.isalnum() or c in "-._" else "_" for c in name)
        self.path = _folder() / f"{readable[:200]}.lock"
        self._what = what
        self._file: int | None = None

    def take(self) -> None:
        """Hold the lock.

        Raises:
            NodeError: another process holds it; names it, and since when.
        """
        number = os.open(self.path, os.O_RDWR | os.O_CREAT, 0o600)
        try:
            fcntl.flock(number, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            holder = os.read(number, 4096)
            os.close(number)
            raise NodeError(f"{self._what} is already running{_described(holder)}") from None
        os.ftruncate(number, 0)
        os.write(number, json.dumps({"pid": os.getpid(), "since_s": time.time()}).encode())
        self._file = number

    def release(self) -> None:
        """Release the lock, if it is held."""
        if self._file is not None:
            os.close(self._file)  # the file stays: removing it would let two hold it
            self._file = None


def _described(holder: bytes) -> str:
    with suppress(ValueError, KeyError, TypeError):
        found = json.loads(holder)
        pid, since_s = int(found["pid"]), float(found["since_s"])
        since = time.strftime("%Y-%m-%d %H:%M:%S", time.localtime(since_s))
        return f": pid {pid}, since {since}. End it there with Ctrl-C, or `kill {pid}`"
    return ""


def _folder() -> Path:
    """A folder that only this user can access and that is emptied at boot."""
    run = os.environ.get("XDG_RUNTIME_DIR")
    folder = Path(run or tempfile.gettempdir()) / f"vla-zenoh-{os.getuid()}"
    folder.mkdir(mode=0o700, exist_ok=True)
    if folder.stat().st_uid != os.getuid():
        raise NodeError(f"{folder} belongs to another user; set XDG_RUNTIME_DIR")
    return folder
