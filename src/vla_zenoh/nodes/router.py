"""A Zenoh router in this process: what every client session of the profile connects to."""

from __future__ import annotations

import threading

from vla_zenoh.nodes.node import Node
from vla_zenoh.nodes.session import open_session
from vla_zenoh.profile import Profile

POLL_S = 0.25


def run_router(profile: Profile, stop: threading.Event) -> None:
    """Route until `stop` is set.

    Raises:
        SessionError: the address is taken.
    """
    with open_session(profile.session, mode="router") as session:
        node = Node("router", profile, session)
        detail = {"listen": list(profile.session.listen)}
        while not stop.wait(POLL_S):
            links = len(list(session.info.links()))
            node.report("routing", detail={**detail, "links": links})
        node.close()
