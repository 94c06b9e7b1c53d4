"""Whether a Zenoh router answers where the profile says, or something else sits on its port."""

from __future__ import annotations

import re
import socket
from collections.abc import Callable

from vla_zenoh.lab.doctor.finding import HostFinding

CONNECT_LIMIT_S = 1.0

_TCP = re.compile(r"(?:tcp|tls)/(?P<host>\[[^\]]+\]|[^:/?#]+):(?P<port>\d+)")


def router(endpoint: str, *, is_router: bool, try_zenoh: Callable[[str], str]) -> HostFinding:
    """A router answers at `endpoint`, or could be started there.

    Args:
        endpoint: as Zenoh writes it, ``tcp/127.0.0.1:7447``.
        is_router: the router is to run on this host.
        try_zenoh: opens a session there and closes it; returns the reason when it cannot.
    """
    name = f"router {endpoint}"
    match = _TCP.match(endpoint)
    if match is None:
        error = try_zenoh(endpoint)
        return _silent(name, error, is_router) if error else HostFinding(name, "ok", "answers")
    host, port = match["host"].strip("[]"), int(match["port"])
    try:
        socket.create_connection((host, port), timeout=CONNECT_LIMIT_S).close()
    except socket.gaierror:
        return HostFinding(
            name, "fail", f"no host is called {host!r}", "correct session.connect in the profile"
        )
    except OSError as error:
        return _silent(name, error.strerror or "no answer", is_router)
    if endpoint.startswith("tls/"):
        return HostFinding(
            name, "ok", "something listens; its certificate is looked at by the nodes"
        )
    error = try_zenoh(endpoint)
    if not error:
        return HostFinding(name, "ok", "answers")
    return HostFinding(
        name,
        "fail",
        f"the port is taken by something that does not speak Zenoh ({error})",
        f"see what it is: sudo ss -ltnp 'sport = :{port}'; stop it, or take another port in "
        "session.listen and session.connect of the profile",
    )


def _silent(name: str, reason: str, is_router: bool) -> HostFinding:
    if is_router:
        return HostFinding(name, "ok", f"none yet ({reason}); vla-zenoh up starts it")
    return HostFinding(
        name,
        "warn",
        f"no answer ({reason})",
        "start vla-zenoh up on the router's host, and open the port in its firewall",
    )
