"""What processes hold: memory, file handles, threads, shared memory; and whether it grows."""

from __future__ import annotations

import os
import re
import threading
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path
from statistics import median
from typing import NamedTuple

SHARED_MEMORY = Path("/dev/shm")
PERIOD_S = 5.0
WARM_S = 20.0
"""A process that is younger still loads, and fills what it keeps anyway."""
COMPARED_S = 15.0
"""So much of the beginning and of the end of its life is compared."""
GROWTH_MIB, GROWTH_HANDLES, GROWTH_THREADS = 16.0, 6, 20
"""A process may gain so much. Zenoh's pools begin a thread for each that a stuck link holds
up, and end it when it had nothing to do for 10 s: 13 more were the most that was seen."""
ROUTER_MIB = 24.0
"""One that was started anew takes 12 MiB once, when it has heard junk, and 2 for each camera that
dies; the other nodes gained 7.6 at most in an hour."""
FRONT_OF_RAY, RAY_MIB = "in front of its replicas", 64.0
"""A worker that asks replicas of Ray Serve: what Ray keeps of requests goes up and down with them,
see docs/explanation/reliability.md."""
CALM_MIB = 8.0
"""And so much in the calm at the end, in which nothing dies."""
LINKS_SETTLE_S = 20.0
"""After all links broke at once: then the pools hold a thread for each of them until 10 s later."""


class Held(NamedTuple):
    """What one process holds at a moment of its life.

    Args:
        age_s: since it was seen first.
        rss_mib: all its pages.
        pss_mib: those that it shares counted by its share, which grows when others end.
        heap_mib: those that no file is behind: what a leak is told by. Shared memory is not in it,
            whoever maps it.
        handles: open files, sockets and the like, but for those of shared memory.
        threads: all of them.
    """

    age_s: float
    rss_mib: float
    pss_mib: float
    heap_mib: float
    handles: int
    threads: int


class Growth(NamedTuple):
    """What a process had gained by its end, and over how long."""

    node: str
    pid: int
    life_s: float
    first: Held
    last: Held
    calm: bool = False

    @property
    def _most_mib(self) -> float:
        if self.node.endswith(FRONT_OF_RAY):
            return RAY_MIB
        if self.calm:
            return CALM_MIB
        return ROUTER_MIB if self.node.startswith("router") else GROWTH_MIB

    @property
    def leaks(self) -> list[str]:
        """What grew by more than it may, in words."""
        out: list[str] = []
        for name, most in (
            ("heap_mib", self._most_mib),
            ("handles", GROWTH_HANDLES),
            ("threads", GROWTH_THREADS),
        ):
            before, after = getattr(self.first, name), getattr(self.last, name)
            if after - before > most:
                out.append(
                    f"{self.node} (pid {self.pid}): {name} {before:g} -> {after:g} in "
                    f"{self.life_s:.0f} s"
                )
        return out


def look(pid: int, age_s: float) -> Held:
    """What a process holds now.

    Raises:
        OSError: it has ended.
    """
    folder = Path(f"/proc/{pid}")
    found: dict[str, int] = {}
    for line in (folder / "smaps_rollup").read_text().splitlines()[1:]:
        name, _, rest = line.partition(":")
        found[name] = int(rest.split()[0])
    return Held(
        round(age_s, 1),
        round(found["Rss"] / 1024, 1),
        round(found["Pss"] / 1024, 1),
        round(found["Anonymous"] / 1024, 1),
        sum(not _SEGMENT.match(target) for target in _targets(folder / "fd")),
        len(os.listdir(folder / "task")),
    )


def _targets(handles: Path) -> list[str]:
    """What the handles of a process are of."""
    out: list[str] = []
    for name in os.listdir(handles):
        with suppress(OSError):  # closed meanwhile
            out.append(os.readlink(handles / name))
    return out


class Segments(NamedTuple):
    """Zenoh's shared memory on this computer: files, MiB, and files that no process maps."""

    count: int
    size_mib: float
    orphans: int


def segments() -> Segments:
    """Those there are now."""
    sizes: dict[str, int] = {}
    for path in SHARED_MEMORY.glob("*.zenoh"):
        with suppress(OSError):
            sizes[path.name] = path.stat().st_size
    mapped: set[str] = set()
    for maps in Path("/proc").glob("[0-9]*/maps"):
        with suppress(OSError):
            mapped |= {Path(name).name for name in _SEGMENT.findall(maps.read_text())}
    orphans = len(sizes.keys() - mapped)
    return Segments(len(sizes), round(sum(sizes.values()) / 1024**2, 1), orphans)


_SEGMENT = re.compile(rf"{SHARED_MEMORY}/\S+\.zenoh")


class Ledger:
    """Looks at processes every few seconds, in a thread, until `close`.

    Args:
        pids: gives node -> process number of those that run now, and are no longer starting.
    """

    def __init__(self, pids: Callable[[], Mapping[str, int]]) -> None:
        self._pids = pids
        self._seen: dict[tuple[str, int], list[Held]] = {}
        self._born_s: dict[tuple[str, int], float] = {}
        self._settled_s = 0.0
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="ledger", daemon=True)
        self._thread.start()

    def _run(self) -> None:
        while not self._stop.wait(PERIOD_S):
            if time.monotonic() < self._settled_s:
                continue
            for who in dict(self._pids()).items():
                born_s = self._born_s.setdefault(who, time.monotonic())
                with suppress(OSError, KeyError, ValueError):
                    self._seen.setdefault(who, []).append(look(who[1], time.monotonic() - born_s))

    def links_broke(self) -> None:
        """Do not look until the threads that waited for the broken links have ended."""
        self._settled_s = time.monotonic() + LINKS_SETTLE_S

    def newest(self) -> dict[str, Held]:
        """Node -> what its present process holds."""
        out: dict[str, Held] = {}
        for node, pid in self._pids().items():
            with suppress(OSError, KeyError, ValueError):
                out[node] = look(pid, 0.0)
        return out

    def growth(self) -> list[Growth]:
        """Of every process that lived for long enough to tell."""
        out: list[Growth] = []
        for (node, pid), entries in list(self._seen.items()):
            life_s = entries[-1].age_s
            first = [e for e in entries if WARM_S <= e.age_s < WARM_S + COMPARED_S]
            last = [e for e in entries if e.age_s > life_s - COMPARED_S]
            if first and last and life_s > WARM_S + 2 * COMPARED_S:
                out.append(Growth(node, pid, life_s, _middle(first), _middle(last)))
        return out

    def growth_since(self, mono_s: float) -> list[Growth]:
        """Of every process that lived since then and lives still."""
        out: list[Growth] = []
        for (node, pid), entries in list(self._seen.items()):
            since_s = mono_s - self._born_s[node, pid]
            seen = [each for each in entries if each.age_s >= since_s]
            if since_s < 0 or not seen or self._pids().get(node) != pid:
                continue
            life_s = seen[-1].age_s - since_s
            first = [each for each in seen if each.age_s < since_s + COMPARED_S]
            last = [each for each in seen if each.age_s > seen[-1].age_s - COMPARED_S]
            if first and last and life_s > 2 * COMPARED_S:
                out.append(Growth(node, pid, life_s, _middle(first), _middle(last), True))
        return out

    def close(self) -> None:
        """Look no more."""
        self._stop.set()
        self._thread.join(2 * PERIOD_S)


def _middle(entries: list[Held]) -> Held:
    columns = zip(*entries, strict=True)
    age_s, rss, pss, heap, handles, threads = (median(column) for column in columns)
    return Held(age_s, rss, pss, heap, int(handles), int(threads))
