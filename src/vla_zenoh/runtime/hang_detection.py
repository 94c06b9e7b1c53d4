"""Which nodes of a host hang: they run, and have said nothing for long.

A node that hangs does no harm, since the arm brakes without it, but nothing goes on either, and at
night nobody is there to end it. Workers are left alone: a large model may load or think long.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

HANG_S = 10.0
"""Nodes speak twice a second; what holds all of a computer up for so long is not their fault."""
HEARD_S = 2.0


class LastStatus(NamedTuple):
    """The newest status of a node.

    Args:
        pid: of the process that said it.
        age_s: since then.
    """

    pid: int
    age_s: float


def hung_nodes(running: Mapping[str, tuple[str, int]], said: Mapping[str, LastStatus]) -> list[str]:
    """Names of the nodes to end.

    Args:
        running: node -> (kind, pid) of those that this host has started and that run.
        said: node -> its newest status, of all hosts.
    """
    silent = {
        name: kind
        for name, (kind, pid) in running.items()
        if kind != "worker"
        and (status := said.get(name)) is not None
        and status.pid == pid
        and status.age_s > HANG_S
    }
    if any(status.age_s < HEARD_S for status in said.values()):
        return sorted(silent)
    # Nobody is heard: the fault is the router's, or the network's, which no restart helps.
    return sorted(name for name, kind in silent.items() if kind == "router")
