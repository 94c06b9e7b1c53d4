"""Runs the server of the page on a thread of its own."""

from __future__ import annotations

import asyncio
import logging
import socket
import threading
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import uvicorn
import zenoh

from vla_zenoh.profile import Profile
from vla_zenoh_web.access import People
from vla_zenoh_web.requests import MAX_BYTES
from vla_zenoh_web.robot_link import RobotLink
from vla_zenoh_web.server import PageServer

CLOSE_S = 1.0
PING_S = 5.0
MAX_CONNECTIONS = 128


class TlsFiles(NamedTuple):
    """Certificate and private key of the server, PEM."""

    certificate: Path
    key: Path


def serve_page(
    profile: Profile,
    session: zenoh.Session,
    people: People,
    listening: socket.socket,
    names: Sequence[str],
    tls: TlsFiles | None,
    stop: threading.Event,
) -> None:
    """Serve the page of a robot until `stop` is set; then a hold ends and the arm brakes.

    Args:
        listening: bound socket.
        names: of this server, for the header ``Host``.
        tls: None: plain HTTP.
    """
    logging.basicConfig(level=logging.WARNING, format="%(message)s")
    link = RobotLink(profile, session)
    try:
        settings = uvicorn.Config(
            PageServer(link, people, names, secure=tls is not None),
            ws="websockets-sansio",
            ws_max_size=MAX_BYTES,
            ws_per_message_deflate=False,
            ws_ping_interval=PING_S,
            ws_ping_timeout=PING_S,
            limit_concurrency=MAX_CONNECTIONS,
            timeout_graceful_shutdown=int(CLOSE_S),
            log_config=None,
            access_log=False,
            server_header=False,
            proxy_headers=False,
            ssl_certfile=None if tls is None else str(tls.certificate),
            ssl_keyfile=None if tls is None else str(tls.key),
        )
        server = uvicorn.Server(settings)
        thread = threading.Thread(
            target=lambda: asyncio.run(server.serve(sockets=[listening])), name="page"
        )
        thread.start()
        while thread.is_alive() and not stop.wait(0.2):
            pass
        server.should_exit = True
        thread.join()
    finally:
        link.close()
