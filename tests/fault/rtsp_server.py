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
CLOCK_HZ = 90_000
VIDEO = b"\x00\x00\x01\xe0"
"""Begins a picture of the first video."""


class RtspServer:
    """Serves an MPEG transport stream over and over, each picture when it is due.

    Args:
        video: the ``.ts`` file.
        duration_s: how long it plays.
        port: 0 for any.
        credentials: ``user:password`` that a client must give, or nothing.
    """

    def __init__(
        self, video: Path, duration_s: float, port: int = 0, credentials: str = ""
    ) -> None:
        self._pictures, self._duration_s = pictures(video.read_bytes()), duration_s
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
        number, began, at_s = 0, time.monotonic(), 0.0
        while not self._stop.is_set():
            for due_s, data in self._pictures:
                while self.silent.is_set() and not self._stop.is_set():
                    time.sleep(0.02)
                    began += 0.02
                time.sleep(max(0.0, began + at_s + due_s - time.monotonic()))
                stamp = int((at_s + due_s) * CLOCK_HZ) & 0xFFFFFFFF
                for begin in range(0, len(data), step):
                    packet = data[begin : begin + step]
                    packet = (
                        struct.pack(">BBHII", 0x80, MPEG_TS, number & 0xFFFF, stamp, 1) + packet
                    )
                    client.sendall(struct.pack(">BBH", ord("$"), 0, len(packet)) + packet)
                    number += 1
                if self._stop.is_set():
                    return
            at_s += self._duration_s


def pictures(stream: bytes) -> list[tuple[float, bytes]]:
    """(seconds after the first one, bytes) of every picture of an MPEG transport stream."""
    begins = [
        (begin, decoding_time_s(stream[begin : begin + PACKET_SIZE]))
        for begin in range(0, len(stream), PACKET_SIZE)
    ]
    starts = [(begin, due_s) for begin, due_s in begins if due_s is not None]
    ends = [begin for begin, _ in starts[1:]] + [len(stream)]
    first_s = starts[0][1]
    cut = [
        (due_s - first_s, stream[begin:end])
        for (begin, due_s), end in zip(starts, ends, strict=True)
    ]
    return [(0.0, stream[: starts[0][0]] + cut[0][1]), *cut[1:]]


def decoding_time_s(packet: bytes) -> float | None:
    """When a picture that begins in `packet` is to be decoded (ISO/IEC 13818-1, 2.4.3)."""
    begins, adapted = packet[1] & 0x40, packet[3] & 0x20
    pes = packet[4 + (1 + packet[4] if adapted else 0) :]
    if not begins or pes[:4] != VIDEO:
        return None
    stamp = pes[14:19] if pes[7] & 0x40 else pes[9:14]  # of its own, else when it is shown
    high, middle, low = stamp[0] >> 1 & 0b111, stamp[1] << 7 | stamp[2] >> 1, stamp[3:5]
    return (high << 30 | middle << 15 | low[0] << 7 | low[1] >> 1) / CLOCK_HZ
