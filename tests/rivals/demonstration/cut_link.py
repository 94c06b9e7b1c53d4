"""A TCP link that can be cut: what is sent then is lost, and nobody is told."""

from __future__ import annotations

import socket
import threading
from contextlib import suppress
from typing import Self

PIECE = 65536


class CutLink:
    """Forwards what comes at `endpoint` of this computer to another port of it.

    Args:
        to: the other port.
    """

    def __init__(self, to: int) -> None:
        self._to, self._cut = to, threading.Event()
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.endpoint = f"tcp/127.0.0.1:{self._listener.getsockname()[1]}"
        self._pairs: list[tuple[socket.socket, socket.socket]] = []
        threading.Thread(target=self._accept, daemon=True).start()

    def cut(self) -> None:
        """Lose everything from now on, in both directions."""
        self._cut.set()

    def mend(self) -> None:
        """Carry new connections; those that lost something end."""
        pairs, self._pairs = self._pairs, []
        for each in pairs:
            _end(*each)
        self._cut.clear()

    def _accept(self) -> None:
        while True:
            try:
                near, _ = self._listener.accept()
                far = socket.create_connection(("127.0.0.1", self._to))
            except OSError:
                return
            self._pairs.append((near, far))
            for one, other in ((near, far), (far, near)):
                threading.Thread(target=self._forward, args=(one, other), daemon=True).start()

    def _forward(self, one: socket.socket, other: socket.socket) -> None:
        try:
            while piece := one.recv(PIECE):
                if not self._cut.is_set():
                    other.sendall(piece)
        except OSError:
            pass
        _end(one, other)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._listener.close()
        self.mend()


def _end(*sockets: socket.socket) -> None:
    for each in sockets:
        with suppress(OSError):
            each.shutdown(socket.SHUT_RDWR)  # wakes whoever reads from it
        each.close()
