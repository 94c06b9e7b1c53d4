"""Tables of nodes, hosts and events as a page shows them. Pure."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

from vla_zenoh_diagnose.net import pairs_of

from vla_zenoh.cli.node_rows import hosts_down, node_rows
from vla_zenoh.client.client import Client
from vla_zenoh.sanitize import one_line
from vla_zenoh.types import Event, Header

MAX_WHY, MAX_ROWS = 500, 60
REFUSED = "refused."


def node_table(client: Client) -> dict[str, Any]:
    """Nodes with rates, latencies and rejections; pairs of hosts with their clocks."""
    said = client.snapshot()
    rows = node_rows(said, client.expected, client.alive, client.unreadable)[:MAX_ROWS]
    statuses = {name: found for name, (found, _, alive) in said.items() if alive}
    return {
        "nodes": [
            {
                "name": one_line(row.name),
                "host": one_line(row.host),
                "state": one_line(row.state),
                "why": one_line(row.why or _complaint(row.status), MAX_WHY),
                "alive": row.alive,
                "age_s": None if row.age_s is None else round(row.age_s, 1),
                "rates_hz": _rounded(row.status.rates_hz if row.status and row.alive else {}),
                "latency_ms": _rounded(row.status.latency_ms if row.status and row.alive else {}),
                "refused": {
                    name.removeprefix(REFUSED): count
                    for name, count in (row.status.counters if row.status else {}).items()
                    if name.startswith(REFUSED) and count
                },
            }
            for row in rows
        ],
        "hosts_down": hosts_down(said, client.expected, client.alive),
        "clocks": [asdict(pair) for pair in pairs_of(statuses, [])[:MAX_ROWS]],
    }


def _complaint(status: Any) -> str:
    detail = status.detail if status is not None else {}
    return str(detail.get("complaint") or detail.get("fault") or "")


def _rounded(values: Any) -> dict[str, Any]:
    return {
        one_line(name): [round(v, 1) for v in value]
        if isinstance(value, (tuple, list))
        else round(value, 1)
        for name, value in list(values.items())[:MAX_ROWS]
    }


def noted_event(node: str, header: Header, event: Event) -> dict[str, Any]:
    """An event for the log of a page."""
    return {
        "is": "event",
        "at_ms": header.stamp_wall_ns // 1_000_000,
        "node": one_line(node),
        "level": event.level,
        "kind": event.kind,
        "what": one_line(event.what),
        "why": one_line(event.why, MAX_WHY),
        "count": event.count,
    }
