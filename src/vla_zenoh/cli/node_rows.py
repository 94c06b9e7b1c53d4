"""State of every node of a robot: live ones, and those that the profile expects."""

from __future__ import annotations

import math
from collections.abc import Mapping
from types import MappingProxyType
from typing import NamedTuple

from vla_zenoh.keys import CRASHED, ENDED, STARTING
from vla_zenoh.sanitize import one_line
from vla_zenoh.types import NodeStatus

Statuses = Mapping[str, tuple[NodeStatus, float, bool]]
"""Node -> (its last status, seconds since it came, alive)."""
UNKNOWN = "unknown"
MODE_WORDS = {
    "sim": ("SIM", "a simulated robot moves", "bold black on cyan"),
    "dry_run": ("DRY RUN", "everything is computed; the robot gets no commands", "black on yellow"),
    "live": ("LIVE", "a real robot moves", "bold white on red"),
    UNKNOWN: ("MODE UNKNOWN", "no command node reports whether a robot moves", "bold"),
}
"""Mode -> (prefix of what moves, sentence, style)."""
MISSING, DEAD, UNREADABLE = "missing", "dead", "unreadable"
STALE_S = 1.5
"""Nodes publish their status twice a second."""
NEVER = None, math.inf, False
REAL_ROBOTS = frozenset({"arm", "ros2"})
"""Nodes in whose place `up --sim` starts the node sim."""


class NodeRow(NamedTuple):
    """A node."""

    name: str  # on the bus
    host: str  # where it runs, or should run
    state: str  # by its status (``ended`` if as it should), or missing, starting, crashed, dead,
    # unreadable
    why: str  # reason of such a state, with what to do; else empty
    status: NodeStatus | None  # the last one
    age_s: float | None  # of the status
    alive: bool  # it has a liveliness token


def node_rows(
    said: Statuses,
    expected: Mapping[str, str],
    alive: frozenset[str] = frozenset(),
    unreadable: Mapping[str, str] = MappingProxyType({}),
) -> list[NodeRow]:
    """Every node that is alive or published a status, and those expected on running hosts, by name.

    `expected` has the host of each node of the profile; `alive` nodes have a liveliness token;
    `unreadable` has why the newest status of a node cannot be read.
    """
    if "sim" in said and mode_of(said) == "sim":
        expected = {name: host for name, host in expected.items() if name not in REAL_ROBOTS}
    down = hosts_down(said, expected, alive)
    names = {
        *said,
        *alive,
        *unreadable,
        *(name for name, host in expected.items() if host not in down),
    }
    rows: list[NodeRow] = []
    for name in sorted(names):
        host = expected.get(name, "")
        if name in unreadable and said.get(name, NEVER)[1] > STALE_S:
            why = one_line(unreadable[name])
            rows.append(NodeRow(name, host, UNREADABLE, why, None, None, name in alive))
            continue
        if name not in said:
            state, why = STARTING, "no status came from it yet; it starts, or is busy"
            if name not in alive:
                see = f"see the output of `vla-zenoh up` on host {host}"
                state, why = MISSING, f"not running; {see}, which should start it"
            rows.append(NodeRow(name, host, state, why, None, None, name in alive))
            continue
        status, age_s, lives = said[name]
        state, why = status.state, ""
        if not lives and state in (CRASHED, STARTING):  # by `up`, in its name
            why = str(status.detail.get("complaint", ""))
        elif not lives and state == ENDED and name in expected:
            state = MISSING
            why = f"it was ended; `vla-zenoh up` on host {host} starts it again"
        elif not lives and state != ENDED:
            state, why = DEAD, "it exited, or lost its connection; see the output of `up` there"
        rows.append(NodeRow(name, status.host, state, why, status, age_s, lives))
    return rows


def hosts_down(
    said: Statuses, expected: Mapping[str, str], alive: frozenset[str] = frozenset()
) -> dict[str, list[str]]:
    """Host without any status of its nodes -> its nodes."""
    hosts: dict[str, list[str]] = {}
    for name, host in expected.items():
        hosts.setdefault(host, []).append(name)
    return {
        host: sorted(names)
        for host, names in hosts.items()
        if not any(name in said or name in alive for name in names)
    }


def mode_of(said: Statuses) -> str:
    """``sim``, ``dry_run`` or ``live`` by the command node; ``unknown`` without one."""
    status, _, lives = said.get("command", (None, 0.0, False))
    mode = status.detail.get("mode") if status is not None and lives else None
    return mode if isinstance(mode, str) and mode in MODE_WORDS else UNKNOWN


def acting_limits(said: Statuses) -> list[str]:
    """Limits that act on the arm now, by the command node."""
    status, _, lives = said.get("command", (None, 0.0, False))
    limits = status.detail.get("limits") if status is not None and lives else None
    return [one_line(limit) for limit in limits] if isinstance(limits, (list, tuple)) else []
