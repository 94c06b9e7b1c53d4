"""A text that outlives its node: why it is stopped, or what its gripper holds."""

from __future__ import annotations

import queue
import threading
from contextlib import suppress
from pathlib import Path

from vla_zenoh.runtime.process import realtime_links

FLUSH_S = 0.5


class KeptText:
    """A file, or none, with a thread that writes: a slow disk must not block the command loop.

    Args:
        path: of the file; None: a restarted node knows nothing.
        about: what the text says, for the message that it could not be kept.
    """

    def __init__(self, path: Path | None, about: str = "whether it is stopped") -> None:
        self._path, self._about = path, about
        self._wanted: queue.SimpleQueue[str | threading.Event | None] = queue.SimpleQueue()
        self._failures: queue.SimpleQueue[str] = queue.SimpleQueue()
        with realtime_links():  # it shares the GIL with the command loop
            threading.Thread(target=self._run, name="keeper", daemon=True).start()

    def read(self) -> str | None:
        """The text; None: there is none. Of a file that cannot be read, why not."""
        if self._path is None:
            return None
        try:
            return self._path.read_text("utf-8", errors="replace")
        except FileNotFoundError:
            return None
        except OSError as error:
            return f"{self._path} cannot be read: {error}"

    def set(self, text: str | None) -> None:
        """Keep a text in place of the last one, or none; returns at once."""
        self._wanted.put(text)

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
                    f"will not know {self._about}"
                )
