"""A loop that only sleeps, at the priority of a control loop: what this computer itself misses.

    python -m vla_zenoh_benchmarks.bare_loop HZ

prints a line when it begins; when its standard input ends, how many ticks it had and missed.
"""

from __future__ import annotations

import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

from vla_zenoh.bus.clock import FixedRate
from vla_zenoh.runtime.process import realtime_thread

ENDS_S = 10.0


@dataclass
class BareTicks:
    """Ticks of a bare loop, and how many of them it missed."""

    ticks: int = 0
    missed: int = 0


@contextmanager
def bare_loop(rate_hz: float) -> Iterator[BareTicks]:
    """Run a bare loop in a process of its own; its ticks are known when the context ends."""
    command = [sys.executable, "-m", "vla_zenoh_benchmarks.bare_loop", f"{rate_hz:g}"]
    pipe, found = subprocess.PIPE, BareTicks()
    with subprocess.Popen(command, stdin=pipe, stdout=pipe, text=True) as process:
        try:
            assert process.stdout is not None
            process.stdout.readline()
            yield found
            said, _ = process.communicate("", timeout=ENDS_S)
            found.ticks, found.missed = map(int, said.split())
        finally:
            process.kill()


def main(rate_hz: float) -> None:
    """Tick until the standard input ends."""
    ended = threading.Event()

    def wait_for_end() -> None:
        sys.stdin.read()
        ended.set()

    threading.Thread(target=wait_for_end, daemon=True).start()
    ticks = missed = 0
    with realtime_thread():
        loop = FixedRate(rate_hz)
        sys.stdout.write("begins\n")
        sys.stdout.flush()
        while not ended.is_set():
            periods = loop.wait().periods
            ticks += periods
            missed += periods - 1
    sys.stdout.write(f"{ticks} {missed}\n")


if __name__ == "__main__":
    main(float(sys.argv[1]))
