"""Sets TCP_USER_TIMEOUT on this process's connections, so that the kernel closes dead ones."""

from __future__ import annotations

import os
import socket
import sys
from contextlib import suppress

OPEN_FILES = "/proc/self/fd"
_FAMILIES = (socket.AF_INET, socket.AF_INET6)


class TcpUserTimeout:
    """Closes TCP connections whose data is not acknowledged in time; Linux only.

    Zenoh closes a link that fell silent. But if the kernel still holds data for it, the end of a
    TLS session waits until that is sent, i.e. as long as the network is down. A client that
    reconnects before then is taken for a second link of the old session, and is lost with it
    (eclipse-zenoh/zenoh#2806). So the kernel has to drop such data.

    The sockets belong to Zenoh; they are found among the open files of the process.

    Args:
        timeout_s: see `socket.TCP_USER_TIMEOUT`.
    """

    def __init__(self, timeout_s: float) -> None:
        self._timeout_ms = round(timeout_s * 1e3)
        self._known: set[str] = set()

    def apply(self) -> int:
        """Set the timeout on every new connection; returns the number of all connections."""
        if sys.platform != "linux":
            return 0
        found: set[str] = set()
        for name in os.listdir(OPEN_FILES):
            with suppress(OSError):  # closed in the meantime
                target = os.readlink(f"{OPEN_FILES}/{name}")
                if not target.startswith("socket:"):
                    continue
                if target in self._known or self._set_timeout(int(name)):
                    found.add(target)
        self._known = found
        return len(found)

    def _set_timeout(self, descriptor: int) -> bool:
        with socket.socket(fileno=os.dup(descriptor)) as known:
            tcp = known.family in _FAMILIES and known.type == socket.SOCK_STREAM
            if tcp:
                known.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, self._timeout_ms)
            return tcp
