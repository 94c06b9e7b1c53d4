"""A small RTSP server: one video over one TCP connection at a time, and ways to fail."""

from __future__ import annotations

import base64
import contextlib
import socket
import struct
import threading
import time
from pathlib import Path
from types import TracebackType

PACKET_SIZE = 188  # of an MPEG transport stream
PACKETS_AT_ONCE = 7
MPEG_TS = 33  # RTP's payload type
RTP_CLOCK_HZ = 90_000


class RtspServer:
    """Serves an MPEG transport stream over and over.

    Args:
        video: the ``.ts`` file.
        duration_s: how long it plays.
        port: 0 for any.
        credentials: ``user:password`` that a client must give, or nothing.
    """

    def __init__(
        self, video: Path, duration_s: float, port: int = 0, credentials: str = ""
    ) -> None:
        self._data, self._duration_s = video.read_bytes(), duration_s
        self._credentials = base64.b64encode(credentials.encode()).decode()
        self._listener = socket.create_server(("127.0.0.1", port))
        self.port = self._listener.getsockname()[1]
        self.silent = threading.Event()
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._accept, daemon=True)

    def __enter__(self) -> RtspServer:
        self._thread.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._stop.set()
        self._listener.close()
        self._thread.join(5.0)

    def _accept(self) -> None:
        self._listener.settimeout(0.1)
        clients: list[threading.Thread] = []
        while not self._stop.is_set():
            try:
                client, _ = self._listener.accept()
            except TimeoutError:
                continue
            except OSError:
                break
            thread = threading.Thread(target=self._serve, args=(client,), daemon=True)
            thread.start()
            clients.append(thread)
        for thread in clients:
            thread.join(5.0)

    def _serve(self, client: socket.socket) -> None:
        with client, contextlib.suppress(OSError):
            client.settimeout(0.2)
            received = b""
            while not self._stop.is_set():
                try:
                    received += client.recv(4096)
                except TimeoutError:
                    continue
                while b"\r\n\r\n" in received:
                    request, _, received = received.partition(b"\r\n\r\n")
                    if self._answer(client, request.decode()):
                        self._play(client)
                        return

    def _answer(self, client: socket.socket, request: str) -> bool:
        """Reply; True when it is time to play."""
        method, url, *_ = request.split()
        lines = dict(line.split(": ", 1) for line in request.split("\r\n")[1:])
        status, fields, body = "200 OK", [f"CSeq: {lines['CSeq']}"], ""
        if self._credentials and lines.get("Authorization") != f"Basic {self._credentials}":
            status = "401 Unauthorized"
            fields.append('WWW-Authenticate: Basic realm="camera"')
        elif method == "OPTIONS":
            fields.append("Public: OPTIONS, DESCRIBE, SETUP, PLAY, TEARDOWN")
        elif method == "DESCRIBE":
            body = (
                "v=0\r\no=- 1 1 IN IP4 127.0.0.1\r\ns=test\r\nt=0 0\r\n"
                f"m=video 0 RTP/AVP {MPEG_TS}\r\na=control:track0\r\n"
            )
            fields += ["Content-Type: application/sdp", f"Content-Base: {url}/"]
            fields.append(f"Content-Length: {len(body)}")
        elif method == "SETUP":
            fields += ["Transport: RTP/AVP/TCP;unicast;interleaved=0-1", "Session: 1"]
        elif method == "PLAY":
            fields.append("Session: 1")
        client.sendall("\r\n".join([f"RTSP/1.0 {status}", *fields, "", body]).encode())
        return method == "PLAY" and status == "200 OK"

    def _play(self, client: socket.socket) -> None:
        step = PACKET_SIZE * PACKETS_AT_ONCE
        packets = [self._data[i : i + step] for i in range(0, len(self._data), step)]
        pause_s = self._duration_s / len(packets)
        number, began = 0, time.monotonic()
        while not self._stop.is_set():
            if self.silent.is_set():
                time.sleep(0.02)
                began += 0.02
                continue
            stamp = int(number * pause_s * RTP_CLOCK_HZ) & 0xFFFFFFFF
            packet = (
                struct.pack(">BBHII", 0x80, MPEG_TS, number & 0xFFFF, stamp, 1)
                + packets[number % len(packets)]
            )
            client.sendall(struct.pack(">BBH", ord("$"), 0, len(packet)) + packet)
            number += 1
            time.sleep(max(0.0, began + number * pause_s - time.monotonic()))
