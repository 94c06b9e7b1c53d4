"""WebSocket of an adapter: one binary frame a request, one frame an answer, in turn."""

from __future__ import annotations

import socket
import struct
from collections.abc import Mapping
from contextlib import ExitStack, suppress

from websockets.exceptions import WebSocketException
from websockets.protocol import State
from websockets.sync.client import ClientConnection, connect

CLOSE_S = 0.1


class WebSocketClient:
    """Connection to one server, made when it is needed.

    Args:
        url: of the server, as ws://HOST:PORT or wss://HOST:PORT.
        timeout_s: for connecting, for sending, and for each answer.
        max_bytes: of an answer.
        headers: of the request that opens the connection.

    Raises:
        OSError, WebSocketException: of every method but `close`: no connection, or it was lost.
        TimeoutError: of every method but `close`: nothing in time.
    """

    lost = (OSError, WebSocketException)
    """For `Adapter.lost`."""

    def __init__(
        self, url: str, timeout_s: float, max_bytes: int, headers: Mapping[str, str] | None = None
    ) -> None:
        self._url, self._timeout_s, self._max_bytes = url, timeout_s, max_bytes
        self._headers = headers
        self._connection: ClientConnection | None = None
        self._until_closed = ExitStack()

    @property
    def is_open(self) -> bool:
        """Whether there is a connection that the server has not closed."""
        return self._connection is not None and self._connection.state is State.OPEN

    def open(self) -> None:
        """Connect."""
        connection = self._connection = self._until_closed.enter_context(
            connect(
                self._url,
                compression=None,
                max_size=self._max_bytes,
                additional_headers=self._headers,
                proxy=None,
                open_timeout=self._timeout_s,
                close_timeout=CLOSE_S,
                ping_interval=None,  # a server that infers does not answer pings
            )
        )
        # A stopped server reads nothing, and sending would block forever.
        seconds = struct.pack("ll", int(self._timeout_s), int(self._timeout_s % 1 * 1e6))
        connection.socket.setsockopt(socket.SOL_SOCKET, socket.SO_SNDTIMEO, seconds)

    def receive(self) -> bytes | str:
        """The next frame."""
        assert self._connection is not None
        return self._connection.recv(self._timeout_s)

    def call(self, request: bytes) -> bytes | str:
        """Send a frame; the next one of the server."""
        assert self._connection is not None
        self._connection.send(request)
        return self.receive()

    def close(self) -> None:
        """Close the connection, if there is one."""
        connection, self._connection = self._connection, None
        if connection is not None:
            # Not the closing handshake, which waits for a server that may be stopped.
            with suppress(OSError):
                connection.socket.shutdown(socket.SHUT_RDWR)
            with suppress(*self.lost):
                self._until_closed.close()
