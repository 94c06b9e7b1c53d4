"""Recording from the page: one at a time, with the verdict and note of a person at its end."""

from __future__ import annotations

import threading
import time
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import zenoh

from vla_zenoh.errors import NodeError, RecordingError
from vla_zenoh.lab.cli.output_path import RUNS, output_file
from vla_zenoh.lab.recording.recorder import Recorder
from vla_zenoh.lab.recording.verdict import FACT
from vla_zenoh.profile import Profile


class Recordings:
    """The recording that runs, if one does. Its methods may be called from several threads."""

    def __init__(self, profile: Profile, session: zenoh.Session, folder: Path = RUNS) -> None:
        self._profile, self._session, self._folder = profile, session, folder
        self._lock = threading.Lock()
        self._running: tuple[Recorder, ExitStack, Path, float] | None = None

    def described(self) -> dict[str, Any]:
        """Whether one runs, and a sentence about it."""
        running = self._running
        if running is None:
            return {"on": False, "text": "not recording"}
        recorder, _, path, began_s = running
        if recorder.recorded.failure:
            return {"on": True, "text": f"FAILED: {recorder.recorded.failure}"}
        return {"on": True, "text": f"{path}, {time.monotonic() - began_s:.0f} s"}

    def begin(self, path: Path | None = None) -> str:
        """Start one, into a new file of `RUNS` unless `path` says where.

        Raises:
            RecordingError: one runs already.
            OutputError: its file cannot be written.
            NodeError: another recorder runs.
        """
        with self._lock, ExitStack() as stack:
            if self._running is not None:
                raise RecordingError("a recording runs already")
            path = path or self._folder / time.strftime("web-%Y%m%d-%H%M%S.mcap")
            part = stack.enter_context(output_file(path))
            recorder = Recorder(self._profile, self._session, part).start()
            self._running = recorder, stack.pop_all(), path, time.monotonic()
            return f"recording into {path}"

    def end(self, worker: str, verdict: str, note: str) -> str:
        """Finish it.

        Args:
            verdict: ``success``, ``failure``, ``void``, or empty.

        Raises:
            NodeError: none runs.
            RecordingError: it had failed; says why.
        """
        with self._lock:
            if self._running is None:
                raise NodeError("nothing is being recorded")
            recorder, stack, path, _ = self._running
            self._running = None
            fact = {"worker": worker, "verdict": verdict, "note": note}
            with stack:
                found = recorder.close({FACT: fact} if verdict or note else None)
                if found.failure:
                    raise RecordingError(found.failure)
            return f"{path}: {found.samples.total()} samples in {found.seconds:.0f} s"

    def close(self) -> None:
        if self._running is not None:
            self.end("", "", "")
