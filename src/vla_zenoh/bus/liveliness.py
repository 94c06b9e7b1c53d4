"""Who is alive, by answers that came in time."""

from __future__ import annotations

import time

import zenoh

from vla_zenoh.errors import NodeError
from vla_zenoh.keys import Keys

PATIENCE_S, ATTEMPTS = 1.0, 5
ANSWERS = 2
"""One alone may come in time and lack who is alive: a robot that lived was once not found so."""


def alive_nodes(session: zenoh.Session, keys: Keys, name: str | None = None) -> set[str]:
    """Names of the nodes of a robot that are alive now.

    Args:
        session: an open session.
        keys: of the robot.
        name: only this one; None: all.

    Raises:
        NodeError: the router does not answer in time: who is not named may live all the same.
    """
    asked = keys.all_alive if name is None else keys.alive(name)
    found: set[str] = set()
    answers = 0
    for _ in range(ATTEMPTS):
        began_s = time.monotonic()
        replies = list(session.liveliness().get(asked, timeout=PATIENCE_S))
        found |= {str(r.ok.key_expr).rsplit("/", 1)[-1] for r in replies if r.ok is not None}
        # A query that ran out of time ends like one that has been answered in full.
        answers += time.monotonic() - began_s < PATIENCE_S and all(r.ok for r in replies)
        if answers == ANSWERS:
            return found
    raise NodeError(
        f"the router does not say within {PATIENCE_S:g} s which nodes of {keys.robot!r} are alive; "
        "look whether it is too busy, or its access control does not know us, and try again"
    )


def alive_robots(session: zenoh.Session, keys: Keys) -> list[str]:
    """Robots below this root whose command node is alive, of those that one may know of.

    Args:
        session: an open session.
        keys: of any robot there.

    Returns:
        Their names in order; fewer than there are where the router does not answer in time.
    """
    found: set[str] = set()
    for _ in range(ANSWERS):
        replies = session.liveliness().get(keys.all_robots, timeout=PATIENCE_S)
        named = [Keys.of(str(r.ok.key_expr), keys.root) for r in replies if r.ok is not None]
        found |= {one.robot for one in named if one is not None}
    return sorted(found)
