"""Starts the nodes of a host, restarts those that crash, and stops them all in a safe order."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from vla_zenoh.keys import NODE_KINDS, ROLLING
from vla_zenoh.runtime.process import DETAIL, FATAL, PARENT_VARIABLE, RUN_FOLDER_VARIABLE

HANG_S = 10.0
"""Nodes publish their status twice a second; a stall of the whole computer is not their fault."""
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
RUST_SOURCE = re.compile(r" at /\S+\.rs:\d+(?=\.?$)")
"""Source location in a line of Zenoh's log: a path of the computer it was built on."""


class NodeCommand(NamedTuple):
    """Command that starts a node.

    Args:
        name: as in logs and status.
        kind: one of `NODE_KINDS`, or `ROLLING`.
        arguments: of the command line, after ``vla-zenoh``.
    """

    name: str
    kind: str
    arguments: tuple[str, ...]


@dataclass(slots=True)
class Child:
    """A node of this host; `why` it exited, if it said so, what was `told` of that, and how.

    `was_alive`: others saw this process of it alive.
    """

    command: NodeCommand
    process: subprocess.Popen[str] | None = None
    started_s: float = 0.0
    deaths_in_a_row: int = 0
    left_alone: bool = False
    start_again_s: float = 0.0
    reader: threading.Thread | None = None
    pid: int = 0
    was_alive: bool = False
    why: str = ""
    told: str = ""
    end: str = ""


class DownNode(NamedTuple):
    """A node that crashed, or was just started.

    Args:
        name: of the node.
        pid: of its last process.
        crashes: in a row.
        why: reason of the crash; empty if it did not crash.
        left_alone: it is not restarted.
    """

    name: str
    pid: int
    crashes: int
    why: str
    left_alone: bool


def hung_nodes(
    running: Mapping[str, tuple[str, int]], said: Mapping[str, tuple[int, float]]
) -> list[str]:
    """Nodes to kill: they run, but their heartbeat (the status) has stopped.

    A hung node does no harm, since the arm brakes without it, but a new one cannot start beside it.
    Workers are exempt: a large model may take long to load or to infer.

    Args:
        running: node -> kind and pid of the running nodes that this host started.
        said: node -> pid and age (s) of its last status, of all hosts.
    """
    silent = [
        name
        for name, (kind, pid) in running.items()
        if kind != "worker" and name in said and said[name][0] == pid and said[name][1] > HANG_S
    ]
    if any(age_s < HEARD_S for _, age_s in said.values()):
        return sorted(silent)
    # No status at all: the fault is the router's, or the network's, which no restart repairs.
    return sorted(name for name in silent if running[name][0] == "router")


class Supervisor:
    """Starts, restarts and stops the nodes of a host.

    Call `start` and `stop` from one thread that lives as long as the nodes.

    Args:
        commands: in the order to start them.
        log: called with (node name, line) for every line a node writes; lines that begin with
            `DETAIL` or `FATAL` belong in a log file only, `tell` gets the summary.
        tell: called with (node name, sentence) for what the supervisor does.
        folder: where nodes may keep what they need after a restart.
        variables: environment of the nodes, added to ours.
    """

    def __init__(
        self,
        commands: Sequence[NodeCommand],
        *,
        log: Callable[[str, str], None],
        tell: Callable[[str, str], None],
        folder: Path | None = None,
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
        if folder is not None:
            self._environment[RUN_FOLDER_VARIABLE] = str(folder)
        self.children = [Child(command) for command in commands]
        self._log, self._tell = log, tell
        self.given_up: Child | None = None

    def start(self, kind: str = "") -> None:
        """Start the nodes that do not run yet, of one kind or all."""
        for child in self.children:
            if child.process is None and kind in ("", child.command.kind):
                self._spawn(child)

    def poll(self, spare: Sequence[str] = ()) -> bool:
        """Restart nodes that crashed.

        Args:
            spare: kinds of nodes that the others do not need: one that keeps crashing is not
                restarted, as long as others run.

        Returns:
            False if a node that the others need keeps crashing.
        """
        now = time.monotonic()
        for child in self.children:
            if child.process is not None and child.process.poll() is not None:
                self._mourn(child, child.process.returncode, now)
            elif child.process is None and child.start_again_s and now >= child.start_again_s:
                self._spawn(child)
            if child.deaths_in_a_row < GIVE_UP_AFTER or child.left_alone:
                continue
            said = f"crashed {GIVE_UP_AFTER} times in a row"
            why = f": {child.told}" if child.told else ""
            child.left_alone = child.command.kind in spare
            if not child.left_alone or all(each.left_alone for each in self.children):
                self.given_up = child
                self._tell(child.command.name, f"{said}; giving up{why}")
                return False
            child.start_again_s = 0.0
            self._tell(
                child.command.name,
                f"{said}; not restarting it. The other nodes keep running{why}",
            )
        return True

    def stop(self, deadline_s: float) -> None:
        """Stop all nodes by `deadline_s`: commanding ones first, the router last.

        Args:
            deadline_s: monotonic clock; nodes that still run then are killed.
        """
        for kinds, left_s in STOP_ORDER:
            processes = [
                child.process
                for child in self.children
                if child.process is not None and child.command.kind in kinds
            ]
            for process in processes:
                if process.poll() is None:
                    _signal_group(process, signal.SIGTERM)
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
                _signal_group(child.process, signal.SIGKILL)
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

    def owns(self, name: str, pid: int) -> bool:
        """Whether a pid of this computer is this node, started here, and still runs.

        The environment of a model (uv) may be a process between us and the node.
        """
        ours = self.pids().get(name)
        try:
            return ours is not None and os.getpgid(pid) == ours
        except (ProcessLookupError, OverflowError):
            return False

    def down(self, alive: Collection[str]) -> list[DownNode]:
        """Nodes that do not run, or run and have not been in `alive` yet.

        One that was alive and runs is not down: it hangs, and its last status has to grow old.
        """
        for child in self.children:
            child.was_alive |= child.process is not None and child.command.name in alive
        return [
            DownNode(
                child.command.name,
                child.pid,
                child.deaths_in_a_row,
                child.told or child.end,
                child.left_alone or child is self.given_up,
            )
            for child in self.children
            if child.pid and child.command.name not in alive
            if child.process is None or not child.was_alive
        ]

    def terminate(self, name: str, why: str) -> None:
        """Kill a node at once; `poll` restarts it."""
        for child in self.children:
            if child.command.name == name and child.process is not None:
                self._tell(name, why)
                _signal_group(child.process, signal.SIGKILL)

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
        child.started_s, child.start_again_s = time.monotonic(), 0.0
        child.pid, child.why, child.was_alive = child.process.pid, "", False
        reader = threading.Thread(target=self._forward, args=(child, child.process), daemon=True)
        reader.start()
        child.reader = reader
        started = f"started (pid {child.process.pid})"
        if child.told:  # again, after a reported exit
            self._log(child.command.name, f"{DETAIL}{started}")
        else:
            self._tell(child.command.name, started)

    def _forward(self, child: Child, process: subprocess.Popen[str]) -> None:
        assert process.stdout is not None
        with process.stdout as lines:
            for line in lines:
                text = RUST_SOURCE.sub("", line.rstrip("\n"))
                if text.startswith(FATAL):
                    child.why = text.removeprefix(FATAL)
                self._log(child.command.name, text)

    def _mourn(self, child: Child, code: int, now: float) -> None:
        stable = now - child.started_s > STABLE_S
        child.deaths_in_a_row = 1 if stable else child.deaths_in_a_row + 1
        wait_s = BACKOFF_S[min(child.deaths_in_a_row, len(BACKOFF_S)) - 1]
        if child.process is not None:
            _signal_group(child.process, signal.SIGKILL)
        child.process, child.start_again_s = None, now + wait_s
        if child.reader is not None:
            child.reader.join(LAST_LINES_S)
        how = f"killed by {_signal_name(-code)}" if code < 0 else f"exited with code {code}"
        sentence = how
        if child.deaths_in_a_row < GIVE_UP_AFTER:
            sentence += f"; starting again in {wait_s:g} s"
        if child.why:
            sentence += f": {child.why}"
        if child.why and child.why == child.told:  # said already
            self._log(child.command.name, f"{DETAIL}{sentence}")
        else:
            self._tell(child.command.name, sentence)
        child.told, child.end = child.why, how


def _signal_group(process: subprocess.Popen[str], number: signal.Signals) -> None:
    """Signal the process and all that it started, such as the process that made its environment.

    The group has the number of the process (`start_new_session`).
    """
    with suppress(ProcessLookupError):
        os.killpg(process.pid, number)


def _signal_name(number: int) -> str:
    try:
        return signal.Signals(number).name
    except ValueError:  # a real-time signal has no name
        return f"signal {number}"
