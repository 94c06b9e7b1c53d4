"""Serves one of our models to clients of openpi over WebSocket, without Zenoh.

It serves one client at a time, as a model may keep state; a second client is rejected.
"""

from __future__ import annotations

import hmac
import json
import threading
from http import HTTPStatus

from websockets.exceptions import ConnectionClosed
from websockets.http11 import Request, Response
from websockets.sync.server import Server, ServerConnection, serve

from vla_zenoh_serve.openpi_server import (
    HEALTH_PATH,
    MAX_BYTES,
    STATUS_PATH,
    OpenPiConversation,
    Tally,
)
from vla_zenoh_serve.served_policy import ServedPolicy

INTERNAL_ERROR, TRY_AGAIN_LATER = 1011, 1013


class PolicyServer:
    """WebSocket server of one model.

    Args:
        port: to listen on; 0: any.
        api_key: required of clients; empty: none.
    """

    def __init__(self, policy: ServedPolicy, host: str, port: int, api_key: str = "") -> None:
        self._policy, self._key = policy, api_key
        self.tally = Tally()
        self._busy = threading.Lock()
        self._server: Server = serve(
            self._handle,
            host,
            port,
            compression=None,
            max_size=MAX_BYTES,
            process_request=self._admit,
        )
        self.port: int = self._server.socket.getsockname()[1]

    def serve_forever(self) -> None:
        """Serve until `stop`."""
        self._server.serve_forever()

    def stop(self) -> None:
        """Stop accepting clients."""
        self._server.shutdown()

    # -- connections --------------------------------------------------------------------------
    def _admit(self, connection: ServerConnection, request: Request) -> Response | None:
        if request.path == HEALTH_PATH:
            return connection.respond(HTTPStatus.OK, "OK\n")
        given = request.headers.get("Authorization", "").encode()
        if self._key and not hmac.compare_digest(given, f"Api-Key {self._key}".encode()):
            return connection.respond(HTTPStatus.UNAUTHORIZED, "wrong or no API key\n")
        if request.path == STATUS_PATH:
            return connection.respond(HTTPStatus.OK, json.dumps(self.tally.summary()) + "\n")
        if self._busy.locked():
            return connection.respond(
                HTTPStatus.SERVICE_UNAVAILABLE, "another client is connected\n"
            )
        return None

    def _handle(self, connection: ServerConnection) -> None:
        if not self._busy.acquire(blocking=False):
            connection.close(TRY_AGAIN_LATER, "another client is connected")
            return
        try:
            self._serve(connection)
        except ConnectionClosed:
            pass
        finally:
            self._busy.release()

    def _serve(self, connection: ServerConnection) -> None:
        conversation = OpenPiConversation(self._policy, self.tally)
        connection.send(conversation.greeting())
        while True:
            reply = conversation.reply(connection.recv())
            connection.send(reply)
            if isinstance(reply, str):
                connection.close(INTERNAL_ERROR, "the reason is in the frame before")
                return
