"""File that exists while an emergency stop or a fault is latched."""

from __future__ import annotations

import queue
import threading
from contextlib import suppress
from pathlib import Path

FLUSH_S = 0.5


class EstopLatch:
    """Latch file with a thread that writes: a full or slow disk must not block the command loop.

    Args:
        path: of the file; None: a restarted node is not latched.
    """

    def __init__(self, path: Path | None) -> None:
        self._path = path
        self._wanted: queue.SimpleQueue[str | threading.Event | None] = queue.SimpleQueue()
        self._failures: queue.SimpleQueue[str] = queue.SimpleQueue()
        threading.Thread(target=self._run, name="latch", daemon=True).start()

    def read(self) -> str | None:
        """Why it is latched; None if it is not. A file that cannot be read counts as latched."""
        if self._path is None:
            return None
        try:
            return self._path.read_text("utf-8", errors="replace")
        except FileNotFoundError:
            return None
        except OSError as error:
            return f"{self._path} cannot be read: {error}"

    def set(self, why: str | None) -> None:
        """Latch for a reason, or clear the latch (None); returns at once."""
        self._wanted.put(why)

    def failure(self) -> str | None:
        """What went wrong since the last call, one at a time."""
        with suppress(queue.Empty):
            return self._failures.get_nowait()
        return None

    def close(self) -> None:
        """Wait a short time for pending writes, then end the thread."""
        done = threading.Event()
        self._wanted.put(done)
        done.wait(FLUSH_S)

    def _run(self) -> None:
        while True:
            wanted = self._wanted.get()
            if isinstance(wanted, threading.Event):
                wanted.set()
                return
            if self._path is None:
                continue
            try:
                if wanted is None:
                    self._path.unlink(missing_ok=True)
                    continue
                # The folder may have been removed in the days since it was made.
                self._path.parent.mkdir(parents=True, exist_ok=True)
                self._path.write_text(wanted, "utf-8", errors="replace")
            except OSError as error:
                done = "removed" if wanted is None else "written"
                self._failures.put(
                    f"{self._path} cannot be {done} ({error}): a restarted node "
                    "will not know whether it is stopped"
                )
