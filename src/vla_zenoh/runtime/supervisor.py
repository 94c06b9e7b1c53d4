"""Starts the nodes of a host, restarts those that crash, and stops them all in a safe order."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from vla_zenoh.keys import NODE_KINDS, ROLLING
from vla_zenoh.runtime.process import DETAIL, FATAL, PARENT_VARIABLE

HANG_S = 10.0
"""Nodes publish their status twice a second; a stall of the whole computer is not their fault."""
START_S = 30.0
"""A node that starts may be idle for this long, or compute for it, before its silence counts."""
PROGRESS_S = 0.02
"""Processor time by which a node that starts shows that it does not hang."""
HEARD_S = 2.0
BACKOFF_S = (0.2, 0.5, 1.0, 2.0, 5.0)
STABLE_S = 60.0
"""After this time a node's backoff starts again at the shortest. It is longer than a node on a busy
machine needs to find that it cannot run."""
GIVE_UP_AFTER = 6
"""Crashes in a row, each before `STABLE_S`."""
_STOPS_S = {**{kind: traits.stop_s for kind, traits in NODE_KINDS.items()}, ROLLING: 0.2}
STOP_ORDER = tuple(
    (tuple(kind for kind, other_s in _STOPS_S.items() if other_s == stop_s), stop_s)
    for stop_s in sorted(set(_STOPS_S.values()), reverse=True)
)
"""Kinds in stop order, and how long before the deadline the next ones follow."""
POLL_S = 0.05
LAST_LINES_S = 0.5
"""A process that ended may have started another one, which keeps its output open."""
SIGNAL_NAMES = {each.value: each.name for each in signal.Signals}
RUST_SOURCE = re.compile(r" at /\S+\.rs:\d+(?=\.?$)")
"""Source location in a line of Zenoh's log: a path of the computer it was built on."""


class NodeCommand(NamedTuple):
    """Command that starts a node; its `arguments` follow ``vla-zenoh``."""

    name: str
    kind: str  # one of NODE_KINDS, or ROLLING
    arguments: tuple[str, ...]


def repeated(option: str, values: Iterable[str] | None) -> tuple[str, ...]:
    """Words of a command line for an option that may be given several times."""
    return tuple(word for value in values or () for word in (option, value))


@dataclass(slots=True)
class Child:
    """A node of this host, and its process or, while it has none, the last one."""

    command: NodeCommand
    process: subprocess.Popen[str] | None = None
    pid: int = 0
    reader: threading.Thread | None = None  # of its output
    started_s: float = 0.0
    start_again_s: float = 0.0  # 0: never
    deaths_in_a_row: int = 0
    was_alive: bool = False  # others saw this process of it alive
    left_alone: bool = False  # it is not restarted any more
    why: str = ""  # it exited, in its own words
    end: str = ""  # of the process before: why, or how


def is_hearing(heard: Mapping[str, tuple[object, float, bool]]) -> bool:
    """Whether a status of a live node came lately: `up` itself publishes that of one that is down,
    and hears it without any router.

    Args:
        heard: node -> (status, its age in s, whether the node is alive).
    """
    return any(alive and age_s < HEARD_S for _, age_s, alive in heard.values())


class ThreadTime(NamedTuple):
    """What the main thread of a process has done since it began."""

    ran_s: float
    waited_s: float  # for a processor, ready to run


def thread_time(pid: int) -> ThreadTime | None:
    """Of the main thread of a process; None where the system has no such figures."""
    try:
        ran_ns, waited_ns, _ = Path(f"/proc/{pid}/schedstat").read_text().split()
    except (OSError, ValueError):
        return None
    return ThreadTime(int(ran_ns) / 1e9, int(waited_ns) / 1e9)


@dataclass(slots=True)
class _Silent:
    pid: int
    age_s: float
    began: ThreadTime
    ran_s: float  # at its last progress
    progress_s: float  # when that was


class SilenceMeter:
    """How long nodes have been silent although they could have spoken.

    A node is slow, and does not hang, while its main thread waits for a processor: that time does
    not count. Neither does the start of a node, while it makes progress.

    Args:
        time_of: processor times of a process, by its id.
    """

    def __init__(self, time_of: Callable[[int], ThreadTime | None] = thread_time) -> None:
        self._time_of = time_of
        self._nodes: dict[str, _Silent] = {}

    def silent_s(self, name: str, pid: int, age_s: float, now_s: float, *, starting: bool) -> float:
        """Silence of a node that counts.

        Args:
            name: of the node.
            pid: of its process.
            age_s: of its last status.
            now_s: monotonic clock.
            starting: it has published none itself yet.
        """
        time_now = self._time_of(pid)
        if time_now is None:
            return max(age_s - START_S, 0.0) if starting else age_s
        node = self._nodes.get(name)
        if node is None or node.pid != pid or age_s < node.age_s:
            node = self._nodes[name] = _Silent(pid, age_s, time_now, time_now.ran_s, now_s)
        node.age_s = age_s
        if not starting:
            return age_s - (time_now.waited_s - node.began.waited_s)
        if time_now.ran_s - node.began.ran_s > START_S:
            return age_s
        if time_now.ran_s - node.ran_s > PROGRESS_S:
            node.ran_s, node.progress_s = time_now.ran_s, now_s
        return max(now_s - node.progress_s - START_S, 0.0)


def hung_nodes(
    running: Mapping[str, tuple[str, int]],
    said: Mapping[str, tuple[int, float]],
    hearing_s: float,
) -> list[str]:
    """Nodes to kill: they run, but their heartbeat (the status) has stopped.

    A hung node does no harm, since the arm brakes without it, but a new one cannot start beside it.
    Workers are exempt: a large model may take long to load or to infer. `running` nodes of this
    host have kind and pid; `said` has their pid by status and silence (s, see `SilenceMeter`);
    `hearing_s` is how long any of them has been heard: when the router comes back, the first status
    makes no other node a silent one.
    """
    silent = [
        name
        for name, (kind, pid) in running.items()
        if kind != "worker" and name in said and said[name][0] == pid and said[name][1] > HANG_S
    ]
    if hearing_s > 0.0:
        return sorted(silent) if hearing_s > HANG_S else []
    # No status at all: the fault is the router's, or the network's, which no restart repairs.
    return sorted(name for name in silent if running[name][0] == "router")


class Supervisor:
    """Starts the nodes of a host in the order of `commands`, restarts and stops them.

    Call `start` and `stop` from one thread that lives as long as the nodes.

    Args:
        log: called with (node name, line) for every line a node writes; lines that begin with
            `DETAIL` or `FATAL` belong in a log file only, `tell` gets the summary.
        tell: called with (node name, sentence) for what the supervisor does.
        variables: environment of the nodes, added to ours.
    """

    def __init__(
        self,
        commands: Sequence[NodeCommand],
        *,
        log: Callable[[str, str], None],
        tell: Callable[[str, str], None],
        variables: Mapping[str, str] | None = None,
    ) -> None:
        self._environment = {
            **os.environ,
            **(variables or {}),
            PARENT_VARIABLE: str(os.getpid()),
            "PYTHONUNBUFFERED": "1",
            # Zenoh colours its log even when it writes to our pipe: then it is not recognised.
            "NO_COLOR": "1",
        }
        self.children = [Child(command) for command in commands]
        self._log, self._tell = log, tell
        self.given_up: Child | None = None

    def start(self, kind: str = "") -> None:
        """Start the nodes that do not run yet, of one kind or all."""
        for child in self.children:
            if child.process is None and kind in ("", child.command.kind):
                self._spawn(child)

    def poll(self, spare: Sequence[str] = ()) -> bool:
        """Restart nodes that crashed; False if one that the others need keeps crashing.

        One of a kind to `spare` is then left alone, as long as others run.
        """
        now = time.monotonic()
        for child in self.children:
            if child.process is not None and child.process.poll() is not None:
                self._mourn(child, child.process, now)
            elif child.process is None and child.start_again_s and now >= child.start_again_s:
                self._spawn(child)
            if child.deaths_in_a_row < GIVE_UP_AFTER or child.left_alone:
                continue
            child.left_alone, child.start_again_s = True, 0.0
            then = "not restarting it. The other nodes keep running"
            if child.command.kind not in spare or all(each.left_alone for each in self.children):
                self.given_up, then = child, "giving up"
            why = f": {child.why}" if child.why else ""
            self._tell(child.command.name, f"crashed {GIVE_UP_AFTER} times in a row; {then}{why}")
        return self.given_up is None

    def stop(self, deadline_s: float) -> None:
        """Stop all nodes: commanding ones first, the router last.

        Those that still run at `deadline_s`, monotonic clock, are killed.
        """
        for kinds, left_s in STOP_ORDER:
            processes = [
                child.process
                for child in self.children
                if child.process is not None and child.command.kind in kinds
            ]
            for process in processes:
                if process.poll() is None:
                    signal_group(process.pid, signal.SIGTERM)
            while any(process.poll() is None for process in processes):
                if time.monotonic() >= deadline_s - left_s:
                    break
                time.sleep(POLL_S)
        self.kill()
        for child in self.children:
            if child.reader is not None:
                child.reader.join(0.2)

    def kill(self) -> None:
        """Kill every node that still runs, at once."""
        for child in self.children:
            if child.process is not None:
                signal_group(child.process.pid, signal.SIGKILL)
                child.process.wait()

    def running(self) -> dict[str, tuple[str, int]]:
        """Node name -> (kind, pid) of running nodes."""
        return {
            child.command.name: (child.command.kind, child.process.pid)
            for child in self.children
            if child.process is not None and child.process.poll() is None
        }

    def pids(self) -> dict[str, int]:
        """Node name -> pid of running nodes."""
        return {name: pid for name, (_, pid) in self.running().items()}

    def down(self, alive: Collection[str]) -> list[Child]:
        """Nodes that do not run, or run and have not been in `alive` yet.

        One that was alive and runs is not down: it hangs, and its last status has to grow old.
        """
        for child in self.children:
            child.was_alive |= child.process is not None and child.command.name in alive
        return [
            child
            for child in self.children
            if child.pid and child.command.name not in alive
            if child.process is None or not child.was_alive
        ]

    def _spawn(self, child: Child) -> None:
        child.process = subprocess.Popen(
            [sys.executable, "-m", "vla_zenoh", *child.command.arguments],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            errors="replace",
            env=self._environment,
            # Ctrl-C in the terminal must reach the supervisor alone: it brakes the arm first.
            start_new_session=True,
        )
        again = child.why != ""  # after a reported exit
        child.why, child.was_alive = "", False
        child.pid, child.started_s, child.start_again_s = child.process.pid, time.monotonic(), 0.0
        child.reader = threading.Thread(
            target=self._forward, args=(child, child.process), daemon=True
        )
        child.reader.start()
        self._report(child, f"started (pid {child.pid})", detail=again)

    def _forward(self, child: Child, process: subprocess.Popen[str]) -> None:
        assert process.stdout is not None
        with process.stdout as lines:
            for line in lines:
                text = RUST_SOURCE.sub("", line.rstrip("\n"))
                if text.startswith(FATAL):
                    child.why = text.removeprefix(FATAL)
                self._log(child.command.name, text)

    def _mourn(self, child: Child, process: subprocess.Popen[str], now: float) -> None:
        stable = now - child.started_s > STABLE_S
        deaths = 1 if stable else child.deaths_in_a_row + 1
        wait_s = BACKOFF_S[min(deaths, len(BACKOFF_S)) - 1]
        signal_group(process.pid, signal.SIGKILL)  # what it started
        child.process, child.start_again_s = None, now + wait_s
        if child.reader is not None:
            child.reader.join(LAST_LINES_S)
        code = process.returncode
        killer = SIGNAL_NAMES.get(-code, f"signal {-code}")  # a real-time signal has no name
        how = f"killed by {killer}" if code < 0 else f"exited with code {code}"
        sentence = how
        if deaths < GIVE_UP_AFTER:
            sentence += f"; starting again in {wait_s:g} s"
        if child.why:
            sentence += f": {child.why}"
        self._report(child, sentence, detail=child.why != "" and child.why == child.end)
        child.end = child.why or how
        child.deaths_in_a_row = deaths  # last: `down` is read meanwhile

    def _report(self, child: Child, sentence: str, *, detail: bool) -> None:
        if detail:
            self._log(child.command.name, f"{DETAIL}{sentence}")
        else:
            self._tell(child.command.name, sentence)


def signal_group(pid: int, number: signal.Signals) -> None:
    """Signal a node and all that it started, as its environment: its group has its number."""
    with suppress(ProcessLookupError):
        os.killpg(pid, number)
