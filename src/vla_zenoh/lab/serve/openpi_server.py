"""Serves one of our models to openpi clients over WebSocket, without Zenoh.

It serves one client at a time, as a model may keep state; a second client is rejected. A new
connection, a new prompt or a reset starts an episode.
"""

from __future__ import annotations

import hmac
import logging
import threading
import time
from http import HTTPStatus
from typing import Any

from vla_zenoh.errors import MissingExtraError, PeerError, SpecError, in_words
from vla_zenoh.lab.serve import openpi_frames
from vla_zenoh.lab.serve.served_policy import ServedPolicy
from vla_zenoh.policy import ActionSteps, Policy, check_steps, reset_of

try:
    from websockets.datastructures import Headers
    from websockets.exceptions import ConnectionClosed
    from websockets.http11 import Request, Response
    from websockets.sync.server import Server, ServerConnection, serve
except ImportError as error:
    raise MissingExtraError(error.name or "websockets", "serve") from error

INTERNAL_ERROR, TRY_AGAIN_LATER = 1011, 1013
MAX_ERROR = 1000


class OpenPiServer:
    """WebSocket server with openpi's protocol.

    Args:
        policy: a loaded model.
        offer: names of its observations.
        host: address to listen on.
        port: to listen on; 0: any.
        api_key: required of clients; empty: none.
    """

    def __init__(
        self, policy: Policy, offer: ServedPolicy, host: str, port: int, *, api_key: str = ""
    ) -> None:
        self._policy, self._offer, self._key = policy, offer, api_key
        self._busy = threading.Lock()
        self._seq = 0
        self._log = logging.getLogger("vla_zenoh.openpi")
        self._server: Server = serve(
            self._handle,
            host,
            port,
            compression=None,
            max_size=openpi_frames.MAX_BYTES,
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
        if request.path == openpi_frames.HEALTH_PATH:
            return connection.respond(HTTPStatus.OK, "OK\n")
        if self._key and not _has_key(request.headers, self._key):
            return connection.respond(HTTPStatus.UNAUTHORIZED, "wrong or no API key\n")
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
        takes = bool(getattr(self._policy, "takes_committed", False))
        action, names = self._policy.spec.action, self._offer.described()
        connection.send(openpi_frames.metadata(action, names, takes_committed=takes))
        prompt: str | None = None
        previous_ms: float | None = None
        while True:
            frame = connection.recv()
            began_s = time.monotonic()
            try:
                self._seq += 1
                given = openpi_frames.read_observation(frame)
                if given == openpi_frames.RESET:
                    prompt = None
                    connection.send(openpi_frames.reset_done())
                    continue
                observation = self._offer.observe(given, time.time_ns(), self._seq)
                if observation.prompt != prompt:
                    prompt = observation.prompt
                    (reset_of(self._policy) or (lambda: None))()
                committed = openpi_frames.read_committed(given, action)
                extra: dict[str, Any] = {"committed": committed} if takes else {}
                result: Any = self._policy.infer(observation, **extra)
                steps = result.steps if isinstance(result, ActionSteps) else result
                actions = check_steps(action, steps)
            except Exception as error:  # sent to the client as openpi does; it may reconnect
                why = error if isinstance(error, (PeerError, SpecError)) else repr(error)
                self._log.warning("request rejected: %s", why)
                connection.send(in_words(error)[:MAX_ERROR])
                connection.close(INTERNAL_ERROR, "the reason is in the frame before")
                return
            infer_ms = (time.monotonic() - began_s) * 1e3
            connection.send(openpi_frames.answer(actions, infer_ms, previous_ms))
            previous_ms = (time.monotonic() - began_s) * 1e3


def _has_key(headers: Headers, key: str) -> bool:
    given = headers.get("Authorization", "")
    return hmac.compare_digest(given.encode(), f"Api-Key {key}".encode())
