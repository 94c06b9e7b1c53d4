"""Robots that ask another server for chunks, and that server, on one computer.

``python -m benchmarks.load.asking PEER SETUP`` prints a line of JSON when measuring begins (the
process numbers) and one when it has ended (of each robot, when an image was taken and its chunk
came, on one clock). It needs numpy and the libraries of PEER: LeRobot's are in an environment of
their own.
"""

from __future__ import annotations

import ctypes
import json
import multiprocessing
import os
import signal
import socket
import sys
import threading
import time
from dataclasses import asdict, dataclass
from typing import Any, TextIO

import numpy as np

from benchmarks import peers
from benchmarks.picture import noisy_picture

CAMERA_HZ = 30.0
START_PATIENCE_S, POLL_S = 60.0, 0.05
PARENT_DEATH_SIGNAL = 1  # PR_SET_PDEATHSIG


@dataclass(frozen=True, slots=True)
class Asked:
    """What the robots ask.

    Args:
        robots: their number.
        servers: their number: 1, or one for each robot.
        cost_ms: of an inference.
        rate_hz: of inferences that each robot asks for.
        side: width and height of an image.
        cameras: images of an inference.
        settle_s: before it is measured.
        seconds: how long it is measured.
    """

    robots: int
    servers: int
    cost_ms: float
    rate_hz: float
    side: int
    cameras: int
    settle_s: float
    seconds: float

    def text(self) -> str:
        """As JSON."""
        return json.dumps(asdict(self))


def frame_time(now_s: float, robot: int, robots: int) -> float:
    """When a robot's cameras took their newest images; the robots take turns."""
    shift_s = robot / robots / CAMERA_HZ
    return shift_s + np.floor((now_s - shift_s) * CAMERA_HZ) / CAMERA_HZ


class AskingRobot:
    """A robot that asks with its newest images, when the last chunk has come and it is due."""

    def __init__(self, peer: str, asked: Asked, index: int, port: int) -> None:
        self._client = peers.load(peer).Client(port)
        self._asked, self._index = asked, index
        self._pictures = [noisy_picture(asked.side, asked.side)] * asked.cameras
        self.came: list[tuple[float, float]] = []
        self.lost = 0
        self._client.request(self._pictures)

    def run(self, measured_s: float, ended: threading.Event) -> None:
        """Ask until `ended`; what comes from `measured_s` on is kept."""
        due_s = time.monotonic()
        while not ended.wait(max(due_s - time.monotonic(), 0.0)):
            began_s = time.monotonic()
            taken_s = frame_time(began_s, self._index, self._asked.robots)
            answer = self._client.request(self._pictures)
            now_s = time.monotonic()
            if now_s >= measured_s and not ended.is_set():
                if answer is None:
                    self.lost += 1
                else:
                    self.came.append((taken_s, now_s))
            due_s = max(due_s + 1 / self._asked.rate_hz, began_s)
        self._client.close()


def await_port(port: int) -> None:
    """Wait until somebody listens there; raises TimeoutError."""
    give_up_s = time.monotonic() + START_PATIENCE_S
    while time.monotonic() < give_up_s:
        with socket.socket() as probe:
            if probe.connect_ex((peers.ADDRESS, port)) == 0:
                return
        time.sleep(POLL_S)
    raise TimeoutError(f"nobody listens on port {port}")


def _free_ports(count: int) -> list[int]:
    probes = [socket.socket() for _ in range(count)]
    for probe in probes:
        probe.bind((peers.ADDRESS, 0))
    ports = [int(probe.getsockname()[1]) for probe in probes]
    for probe in probes:
        probe.close()
    return ports


def _die_with_parent() -> None:
    ctypes.CDLL(None).prctl(PARENT_DEATH_SIGNAL, signal.SIGKILL)


def _serve(peer: str, port: int, takes_s: float) -> None:
    _die_with_parent()
    peers.load(peer).serve(port, takes_s)


def ask(peer: str, asked: Asked, out: TextIO) -> None:
    """Start the servers, ask them, and print the two lines."""
    peers.load(peer)  # once for all: servers are forked from this process
    fork = multiprocessing.get_context("fork")
    ports = _free_ports(asked.servers)
    servers = [
        fork.Process(target=_serve, args=(peer, port, asked.cost_ms / 1e3), daemon=True)
        for port in ports
    ]
    for server in servers:
        server.start()
    for port in ports:
        await_port(port)
    robots = [
        AskingRobot(peer, asked, index, ports[index % asked.servers])
        for index in range(asked.robots)
    ]
    ended, measured_s = threading.Event(), time.monotonic() + asked.settle_s
    threads = [
        threading.Thread(target=robot.run, args=(measured_s, ended), daemon=True)
        for robot in robots
    ]
    for thread in threads:
        thread.start()
    time.sleep(asked.settle_s)
    _print(out, {"servers": [server.pid for server in servers], "robots": os.getpid()})
    time.sleep(asked.seconds)
    ended.set()
    came = [robot.came for robot in robots]
    _print(out, {"came": came, "lost": sum(robot.lost for robot in robots)})


def _print(out: TextIO, value: Any) -> None:
    out.write(json.dumps(value) + "\n")
    out.flush()


if __name__ == "__main__":
    _die_with_parent()
    mine = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)  # what libraries print is not for who reads the lines
    ask(sys.argv[1], Asked(**json.loads(sys.argv[2])), mine)
    os._exit(0)  # a robot may still wait for its last chunk
