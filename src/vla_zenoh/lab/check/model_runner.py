"""Where a model runs while it is examined: clock, patience, and the memory of this process."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from concurrent.futures import Future
from pathlib import Path
from queue import SimpleQueue
from typing import Any, Protocol, TypeVar

Result = TypeVar("Result")


class ModelRunner:
    """One thread for the model, as a worker has; a call that does not come back is given up.

    Args:
        patience_s: with one call.
    """

    def __init__(self, patience_s: float) -> None:
        self._patience_s = patience_s
        self._began_s = time.monotonic()
        self._calls: SimpleQueue[tuple[Callable[[], Any], Future[Any]]] = SimpleQueue()
        # A daemon: a model that hangs must not keep the process.
        threading.Thread(target=self._serve, name="model", daemon=True).start()

    def _serve(self) -> None:
        while True:
            what, answer = self._calls.get()
            began_s = time.perf_counter()
            try:
                result = what()
            except BaseException as error:
                answer.set_exception(error)
            else:
                answer.set_result((result, time.perf_counter() - began_s))
            del what, answer

    def call(self, what: Callable[[], Result]) -> tuple[Result, float]:
        """See `vla_zenoh.lab.check.model_runner.Bench`."""
        answer: Future[tuple[Result, float]] = Future()
        self._calls.put((what, answer))
        if not self._wait(answer):
            raise ModelHung(f"nothing came back in {self._patience_s:g} s")
        error = answer.exception()
        if error is not None:
            raise ModelFailed(error) from error
        return answer.result()

    def _wait(self, answer: Future[Any]) -> bool:
        done = threading.Event()
        answer.add_done_callback(lambda _: done.set())
        return done.wait(self._patience_s)

    def memory_kib(self) -> float:
        """Resident memory, as the kernel counts it."""
        for line in Path("/proc/self/status").read_text().splitlines():
            if line.startswith("VmRSS:"):
                return float(line.split()[1])
        return 0.0

    def spent_s(self) -> float:
        """Seconds since this was made."""
        return time.monotonic() - self._began_s


Result = TypeVar("Result")


class ModelFailed(Exception):
    """The model raised."""

    def __init__(self, error: BaseException) -> None:
        super().__init__(f"{type(error).__name__}: {error}")
        self.error = error


class ModelHung(Exception):
    """The model did not come back in time; nothing more can be asked of it."""


class Bench(Protocol):
    """Where the model runs: who has the clock, the patience, and knows the memory."""

    def call(self, what: Callable[[], Result]) -> tuple[Result, float]:
        """What `what` returns, and the seconds it took.

        Raises:
            Failed: it raised.
            Hung: it did not come back.
        """
        ...

    def memory_kib(self) -> float:
        """Resident memory of the process."""
        ...

    def spent_s(self) -> float:
        """Seconds since the examination began."""
        ...
