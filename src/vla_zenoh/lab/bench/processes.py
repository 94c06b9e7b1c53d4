"""Runs the jobs of a benchmark in processes."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from typing import Any, TypeVar

from vla_zenoh.errors import NodeError
from vla_zenoh.runtime.process import die_with_parent

Result = TypeVar("Result")
POLL_S = 0.2
"""How often the parent checks for Ctrl-C."""


def in_processes(
    work: Callable[..., Result],
    jobs: Iterable[tuple[Any, ...]],
    stop: threading.Event,
    *,
    processes: int | None = None,
    prepare: Callable[..., None] | None = None,
    prepared: tuple[Any, ...] = (),
) -> Iterator[Result]:
    """``work(*job)`` for every job, in the order of the jobs.

    Args:
        work: a function of a module.
        jobs: its arguments.
        stop: set by Ctrl-C; jobs that have not ended are dropped.
        processes: at once; None: one per core.
        prepare: called first in every process, a function of a module.
        prepared: its arguments.

    Raises:
        NodeError: a process was killed.
    """
    with ProcessPoolExecutor(
        processes or os.cpu_count() or 1,
        mp_context=multiprocessing.get_context("spawn"),
        initializer=_begin,
        initargs=(prepare, prepared),
    ) as pool:
        futures = [pool.submit(work, *job) for job in jobs]
        try:
            for future in futures:
                while not wait([future], POLL_S, FIRST_COMPLETED).done:
                    if stop.is_set():
                        return
                yield future.result()
        except BrokenProcessPool as error:
            raise NodeError(
                "a process of the bench was killed; is there enough memory for so many at once?"
            ) from error
        finally:
            if not all(future.done() for future in futures):  # in the middle of a job
                for process in multiprocessing.active_children():
                    process.terminate()
            pool.shutdown(wait=True, cancel_futures=True)


def _begin(prepare: Callable[..., None] | None, prepared: tuple[Any, ...]) -> None:
    die_with_parent()
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent handles Ctrl-C
    if prepare is not None:
        prepare(*prepared)
