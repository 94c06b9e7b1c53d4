"""Nodes and robots that are alive, by their liveliness tokens."""

from __future__ import annotations

import time

import zenoh

from vla_zenoh.errors import NodeError
from vla_zenoh.keys import Keys, last_chunk

PATIENCE_S, ATTEMPTS = 1.0, 5
ANSWERS = 2
"""A single answer in time may lack a node that is alive; this has been observed."""


def alive_nodes(session: zenoh.Session, keys: Keys, name: str | None = None) -> set[str]:
    """Names of a robot's nodes that are alive.

    Args:
        session: an open session.
        keys: of the robot.
        name: look for this node only.

    Raises:
        NodeError: the router does not answer in time, so more nodes may be alive.
    """
    expression = keys.all_alive if name is None else keys.alive(name)
    found: set[str] = set()
    answers = 0
    for _ in range(ATTEMPTS):
        began_s = time.monotonic()
        replies = list(session.liveliness().get(expression, timeout=PATIENCE_S))
        found |= {last_chunk(str(r.ok.key_expr)) for r in replies if r.ok is not None}
        # A query that timed out ends like one that was answered completely.
        answers += time.monotonic() - began_s < PATIENCE_S and all(r.ok for r in replies)
        if answers == ANSWERS:
            return found
    raise NodeError(
        f"the router does not report within {PATIENCE_S:g} s which nodes of {keys.robot!r} are "
        "alive; it may be overloaded, or its access control may not know us. Try again"
    )


def alive_robots(session: zenoh.Session, keys: Keys) -> list[str]:
    """Robots below this root whose command node is alive and visible to us, in order.

    Args:
        session: an open session.
        keys: of any robot there.

    Returns:
        Names; incomplete if the router does not answer in time.
    """
    found: set[str] = set()
    for _ in range(ANSWERS):
        replies = session.liveliness().get(keys.all_robots, timeout=PATIENCE_S)
        named = [Keys.of(str(r.ok.key_expr), keys.root) for r in replies if r.ok is not None]
        found |= {one.robot for one in named if one is not None}
    return sorted(found)
