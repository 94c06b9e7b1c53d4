"""Runs the calls of a model on a thread of its own, with a time limit."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from concurrent.futures import Future, wait
from pathlib import Path
from queue import SimpleQueue
from typing import Any, TypeVar

from vla_zenoh.errors import in_words

Result = TypeVar("Result")


class ModelFailed(Exception):
    """The model raised."""

    def __init__(self, error: BaseException) -> None:
        super().__init__(in_words(error))
        self.error = error


class ModelHung(Exception):
    """A call of the model did not return in time; no further call is possible."""


class ModelRunner:
    """Runs a model on one thread, as a worker does, and measures time and memory."""

    def __init__(self, patience_s: float) -> None:
        self._patience_s = patience_s
        self._began_s = time.monotonic()
        self._calls: SimpleQueue[tuple[Callable[[], Any], Future[Any]]] = SimpleQueue()
        # A daemon: a model that hangs must not keep the process alive.
        threading.Thread(target=self._serve, name="model", daemon=True).start()

    def _serve(self) -> None:
        while True:
            function, answer = self._calls.get()
            began_s = time.perf_counter()
            try:
                result = function()
            except BaseException as error:
                answer.set_exception(error)
            else:
                answer.set_result((result, time.perf_counter() - began_s))
            del function, answer

    def call(self, function: Callable[[], Result]) -> tuple[Result, float]:
        """Result of `function`, and the seconds it took.

        Raises:
            ModelFailed: it raised.
            ModelHung: it did not return in time.
        """
        answer: Future[tuple[Result, float]] = Future()
        self._calls.put((function, answer))
        if not wait([answer], self._patience_s).done:
            raise ModelHung(f"no answer within {self._patience_s:g} s")
        error = answer.exception()
        if error is not None:
            raise ModelFailed(error) from error
        return answer.result()

    def memory_kib(self) -> float:
        for line in Path("/proc/self/status").read_text().splitlines():
            if line.startswith("VmRSS:"):
                return float(line.split()[1])
        return 0.0

    def spent_s(self) -> float:
        return time.monotonic() - self._began_s
