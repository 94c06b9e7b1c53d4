"""vla-zenoh status: state, rates, counters and events of all nodes.

Shows what nodes publish in their `NodeStatus`, never a stream: a value to be shown belongs in the
``detail`` of a node's status. The table is in ``status_table.py``: JSON needs no Rich.
"""

from __future__ import annotations

import dataclasses
import json
import sys
from typing import TYPE_CHECKING, Annotated

import typer

from vla_zenoh.cli.node_rows import acting_limits, hosts_down, mode_of, node_rows
from vla_zenoh.cli.options import JsonOption, options
from vla_zenoh.cli.plain import fail
from vla_zenoh.cli.target import RobotTarget

if TYPE_CHECKING:
    from vla_zenoh.client.client import Client

LISTEN_S = 1.2
"""A node publishes its status twice a second."""


@options
def status(
    target: RobotTarget,
    as_json: JsonOption = False,
    once: Annotated[bool, typer.Option("--once", help="Print the table once and exit.")] = False,
) -> None:
    """Show every node: state, age, rates, latencies, rejected messages, and events as they come.

    The table counts rejected messages only; --json has every counter.
    """
    with target.client() as client:
        if not (as_json or once) and sys.stdout.isatty():
            from vla_zenoh.cli.status_table import show_live

            show_live(client)
            return
        client.wait_for(lambda: _all_known(client), LISTEN_S)
        if as_json:
            print(json.dumps(_mapping(client), indent=2))
        else:
            from vla_zenoh.cli.status_table import show_once

            show_once(client)
        if not client.snapshot():
            fail(target.no_node(client, "status"))


def _all_known(robot: Client) -> bool:
    """Whether every node that is there, or should be, has published its status."""
    nodes = robot.alive | robot.expected.keys()
    return bool(robot.alive) and nodes <= robot.snapshot().keys() | robot.unreadable.keys()


def _mapping(robot: Client) -> dict[str, object]:
    said = robot.snapshot()
    rows = node_rows(said, robot.expected, robot.alive, robot.unreadable)
    return {
        "robot": robot.keys.robot,
        "mode": mode_of(said),
        "limits": acting_limits(said),
        "hosts_down": hosts_down(said, robot.expected, robot.alive),
        "nodes": {
            row.name: {
                **({} if row.status is None else dataclasses.asdict(row.status)),
                "node": row.name,
                "host": row.host,
                "state": row.state,
                "why": row.why,
                "age_s": None if row.age_s is None else round(row.age_s, 3),
                "alive": row.alive,
            }
            for row in rows
        },
    }
