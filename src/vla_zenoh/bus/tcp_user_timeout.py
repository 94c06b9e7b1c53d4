"""Lets the kernel end connections of this process whose other side has gone without a word."""

from __future__ import annotations

import os
import socket
import sys
from contextlib import suppress

OPEN_FILES = "/proc/self/fd"
_FAMILIES = (socket.AF_INET, socket.AF_INET6)


class TcpUserTimeout:
    """Ends TCP connections whose data nobody acknowledges for a while.

    Zenoh closes a link that fell silent, but where the kernel still holds data for it, the end of a
    TLS session waits until that is sent: as long as the network is down. Whoever comes back before
    is taken for a second link of the one that is about to end, and is lost with it
    (eclipse-zenoh/zenoh#2806). So the kernel is told to give such data up.

    Sockets belong to Zenoh; they are found among the open files of the process. Does nothing but on
    Linux.

    Args:
        timeout_s: see `socket.TCP_USER_TIMEOUT`.
    """

    def __init__(self, timeout_s: float) -> None:
        self._timeout_ms = round(timeout_s * 1e3)
        self._known: set[str] = set()

    def apply(self) -> int:
        """Tell the kernel so of every connection that is new; how many there are in all."""
        if sys.platform != "linux":
            return 0
        found: set[str] = set()
        for name in os.listdir(OPEN_FILES):
            with suppress(OSError):  # closed meanwhile
                target = os.readlink(f"{OPEN_FILES}/{name}")
                if not target.startswith("socket:"):
                    continue
                if target in self._known or self._tell(int(name)):
                    found.add(target)
        self._known = found
        return len(found)

    def _tell(self, descriptor: int) -> bool:
        with socket.socket(fileno=os.dup(descriptor)) as known:
            tcp = known.family in _FAMILIES and known.type == socket.SOCK_STREAM
            if tcp:
                known.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, self._timeout_ms)
            return tcp
