"""Detects hung nodes of a host: they run, but their heartbeat (the status) has stopped.

A hung node does no harm, since the arm brakes without it, but it must be killed before a new one
can start. Workers are exempt: a large model may take long to load or to infer.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

HANG_S = 10.0
"""Nodes publish their status twice a second; a stall of the whole computer is not their fault."""
HEARD_S = 2.0


class LastStatus(NamedTuple):
    """Last status of a node.

    Args:
        pid: of its process.
        age_s: age of the status.
    """

    pid: int
    age_s: float


def hung_nodes(running: Mapping[str, tuple[str, int]], said: Mapping[str, LastStatus]) -> list[str]:
    """Names of the nodes to kill.

    Args:
        running: node -> (kind, pid) of the running nodes that this host started.
        said: node -> its last status, of all hosts.
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
    # No status at all: the fault is the router's, or the network's, which no restart repairs.
    return sorted(name for name, kind in silent.items() if kind == "router")
