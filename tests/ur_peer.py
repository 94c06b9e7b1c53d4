"""A UR controller's network interfaces, as far as the library ur_rtde uses them: a peer of our own.

Written from the published guides of RTDE and dashboard server. The control script that the library
uploads is not interpreted: its handshake by registers is played (ready 1, done 2 in
``output_int_register_0``), and `servoj` is a first-order lag. It judges nothing about a real robot.
"""

from __future__ import annotations

import contextlib
import itertools
import os
import selectors
import socket
import struct
import threading
import time
from dataclasses import dataclass, field
from multiprocessing.managers import BaseManager
from typing import Any

DASHBOARD, SCRIPTS, RTDE = 29999, (30001, 30002, 30003), 30004
STEP_S = 0.004
READY, DONE = 1, 2
SERVOJ, SET_PAYLOAD, SET_TCP, SET_WATCHDOG, STOP_SCRIPT = 11, 17, 29, 35, 255
NORMAL, REDUCED, PROTECTIVE_STOP, ROBOT_EMERGENCY_STOP = 1, 2, 3, 7
RUNNING, IDLE = 7, 5
POWERED, PROGRAM_RUNS = 1, 2
PLAYING, STOPPED = 2, 1
TYPES = {
    "timestamp": "DOUBLE",
    "robot_mode": "INT32",
    "safety_mode": "INT32",
    "robot_status_bits": "UINT32",
    "safety_status_bits": "UINT32",
    "runtime_state": "UINT32",
    "speed_scaling": "DOUBLE",
    "target_speed_fraction": "DOUBLE",
    "joint_temperatures": "VECTOR6D",
}
PACKED = {"DOUBLE": "d", "INT32": "i", "UINT32": "I", "VECTOR6D": "6d", "VECTOR3D": "3d"}
_numbers = itertools.count(1)


def type_of(name: str) -> str:
    """RTDE's type of a variable."""
    if "int_register" in name:
        return "INT32"
    if "double_register" in name:
        return "DOUBLE"
    return TYPES.get(name, "VECTOR6D")


@dataclass
class Controller:
    """State of the pretended robot."""

    q: list[float] = field(default_factory=lambda: [0.0, -1.5708, 1.5708, -1.5708, -1.5708, 0.0])
    qd: list[float] = field(default_factory=lambda: [0.0] * 6)
    wrench: list[float] = field(default_factory=lambda: [0.0] * 6)
    tcp_pose: list[float] = field(default_factory=lambda: [0.0] * 6)
    robot_mode: int = RUNNING
    safety_mode: int = NORMAL
    slider: float = 1.0
    remote: bool = True
    program: bool = False
    uploads: int = 0
    target: list[float] | None = None
    servos: list[tuple[float, ...]] = field(default_factory=list)
    """(time, lookahead, gain) of every servoj."""
    done: list[tuple[int, tuple[float, ...]]] = field(default_factory=list)
    """Other commands, with their numbers, in order."""
    dashboard: list[str] = field(default_factory=list)
    watchdog_hz: float = 0.0
    unlockable: bool = True


class UrPeer:
    """Runs the interfaces on an address of its own, until `close`."""

    def __init__(self, address: str = "") -> None:
        here = os.getpid()
        self.address = address or f"127.{1 + here % 250}.{here // 250 % 250}.{next(_numbers)}"
        self.robot = Controller()
        self._state, self._command, self._doubles = READY, 0, [0.0] * 24
        self._kicked_s = self._time_s = time.monotonic()
        self._clients: dict[socket.socket, _Client] = {}
        self._selector = selectors.DefaultSelector()
        self._listeners: list[socket.socket] = []
        self._end, self._lock = threading.Event(), threading.RLock()
        self.silent = False
        self.listen()
        self._thread = threading.Thread(target=self._run, name="UR peer", daemon=True)
        self._thread.start()

    # -- what tests do ------------------------------------------------------------------------
    def where(self) -> str:
        """Address."""
        return self.address

    def look(self, name: str) -> Any:
        """A field of the robot's state."""
        with self._lock:
            return getattr(self.robot, name)

    def put(self, **fields: Any) -> None:
        """Set fields of the robot's state."""
        with self._lock:
            for name, value in fields.items():
                setattr(self.robot, name, value)

    def hush(self, silent: bool) -> None:
        """Send no states, or send them again."""
        self.silent = silent

    def listen(self) -> None:
        """Take connections."""
        with self._lock:
            for port in (DASHBOARD, *SCRIPTS, RTDE):
                listener = socket.create_server((self.address, port), reuse_port=False)
                listener.setblocking(False)
                self._listeners.append(listener)
                self._selector.register(listener, selectors.EVENT_READ, port)

    def cut(self) -> None:
        """Drop every connection, and take no new ones."""
        with self._lock:
            for each in [*self._listeners, *self._clients]:
                self._selector.unregister(each)
                each.close()
            self._listeners.clear()
            self._clients.clear()

    def protective_stop(self) -> None:
        """Stop as after a collision."""
        self.stop(PROTECTIVE_STOP)

    def stop(self, safety_mode: int) -> None:
        """Stop the arm and its program."""
        with self._lock:
            self.robot.safety_mode = safety_mode
            self._stop_program()

    def close(self) -> None:
        """End."""
        self._end.set()
        self._thread.join()
        self.cut()
        self._selector.close()

    # -- the robot ----------------------------------------------------------------------------
    def _stop_program(self) -> None:
        robot = self.robot
        robot.program, robot.target, robot.watchdog_hz = False, None, 0.0
        robot.qd = [0.0] * 6
        self._state = READY

    def _tick(self) -> None:
        robot, now_s = self.robot, time.monotonic()
        dt_s, self._time_s = now_s - self._time_s, now_s
        if robot.watchdog_hz and now_s - self._kicked_s > 1 / robot.watchdog_hz:
            self._stop_program()
        if robot.target is not None and robot.program:
            share = min(1.0, robot.slider * dt_s / 0.02)
            was = robot.q
            robot.q = [q + share * (to - q) for q, to in zip(was, robot.target, strict=True)]
            robot.qd = [(q - old) / max(dt_s, 1e-3) for q, old in zip(robot.q, was, strict=True)]

    def _on_command(self, numbers: dict[str, Any]) -> None:
        robot, command = self.robot, numbers.get("input_int_register_0")
        self._kicked_s = time.monotonic()
        if command is None or not robot.program:
            return
        values = tuple(v for name, v in numbers.items() if "double" in name)
        if command == SERVOJ:
            robot.target = list(values[:6])
            robot.servos.append(values[8:11])
        elif command == STOP_SCRIPT:
            self._stop_program()
        elif command == 0:
            self._state = READY
        elif self._state == READY:
            robot.done.append((command, values))
            if command == SET_WATCHDOG:
                robot.watchdog_hz = values[0]
            self._state = DONE

    def _value(self, name: str) -> Any:
        robot = self.robot
        runs = robot.program
        stopped = robot.safety_mode not in (NORMAL, REDUCED)
        known: dict[str, Any] = {
            "timestamp": time.monotonic(),
            "robot_mode": robot.robot_mode,
            "safety_mode": robot.safety_mode,
            "robot_status_bits": POWERED | (PROGRAM_RUNS if runs else 0),
            "safety_status_bits": (0 if stopped else 1)
            | (4 if robot.safety_mode == PROTECTIVE_STOP else 0)
            | (1 << 7 if robot.safety_mode == ROBOT_EMERGENCY_STOP else 0),
            "runtime_state": PLAYING if runs else STOPPED,
            "speed_scaling": robot.slider if runs else 0.0,
            "target_speed_fraction": robot.slider,
            "actual_q": robot.q,
            "actual_qd": robot.qd,
            "actual_TCP_force": robot.wrench,
            "actual_TCP_pose": robot.tcp_pose,
            "output_int_register_0": self._state,
        }
        return known.get(name, [0.0] * 6 if type_of(name) == "VECTOR6D" else 0)

    # -- the wires ----------------------------------------------------------------------------
    def _run(self) -> None:
        next_s = time.monotonic()
        while not self._end.is_set():
            for key, _ in self._selector.select(max(0.0, next_s - time.monotonic())):
                with self._lock, contextlib.suppress(OSError, KeyError):
                    self._on_ready(key)
            if time.monotonic() >= next_s:
                next_s = max(next_s + STEP_S, time.monotonic())
                with self._lock:
                    self._tick()
                    for client in () if self.silent else list(self._clients.values()):
                        client.publish(self._value)

    def _on_ready(self, key: selectors.SelectorKey) -> None:
        if not isinstance(key.data, int):
            data = key.fileobj.recv(65536) if isinstance(key.fileobj, socket.socket) else b""
            if data:
                key.data.take(data)
            else:
                self._selector.unregister(key.fileobj)
                self._clients.pop(key.fileobj).close()  # type: ignore[arg-type]
            return
        listener: Any = key.fileobj
        link, _ = listener.accept()
        link.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        kind = {DASHBOARD: _Dashboard, RTDE: _Rtde}.get(key.data, _Script)
        self._clients[link] = kind(link, self)
        self._selector.register(link, selectors.EVENT_READ, self._clients[link])


class _Client:
    """One connection."""

    def __init__(self, link: socket.socket, peer: UrPeer) -> None:
        self.link, self.peer, self.buffer = link, peer, b""

    def take(self, data: bytes) -> None:
        """What was received."""

    def publish(self, value: Any) -> None:
        """Send what is due."""

    def close(self) -> None:
        """End."""
        self.link.close()


class _Script(_Client):
    """Takes a program, and starts it when it is complete."""

    def take(self, data: bytes) -> None:
        self.buffer += data
        robot = self.peer.robot
        if b"def rtde_control():" not in self.buffer or not self.buffer.rstrip().endswith(b"end"):
            return
        self.buffer = b""
        if robot.safety_mode in (NORMAL, REDUCED) and robot.robot_mode == RUNNING:
            self.peer._state = READY
            robot.program, robot.uploads = True, robot.uploads + 1


class _Dashboard(_Client):
    def __init__(self, link: socket.socket, peer: UrPeer) -> None:
        super().__init__(link, peer)
        link.sendall(b"Connected: Universal Robots Dashboard Server\n")

    def take(self, data: bytes) -> None:
        self.buffer += data
        while b"\n" in self.buffer:
            line, self.buffer = self.buffer.split(b"\n", 1)
            said = line.decode().strip()
            self.peer.robot.dashboard.append(said)
            self.link.sendall(self._answer(said.lower()).encode() + b"\n")

    def _answer(self, said: str) -> str:
        robot = self.peer.robot
        if said == "polyscopeversion":
            return "URSoftware 5.14.0.1031109 (Oct 10 2022)"
        if said == "get serial number":
            return "20195500001"
        if said == "get robot model":
            return "UR5"
        if said == "is in remote control":
            return str(robot.remote).lower()
        if said == "stop":
            self.peer._stop_program()
            return "Stopped"
        if said == "unlock protective stop":
            if not robot.unlockable:
                return "Cannot unlock protective stop until 5s after occurrence"
            robot.safety_mode = NORMAL
            return "Protective stop releasing"
        if said == "close safety popup":
            return "closing safety popup"
        return f'could not understand: "{said}"'


class _Rtde(_Client):
    def __init__(self, link: socket.socket, peer: UrPeer) -> None:
        super().__init__(link, peer)
        self.outputs: list[str] = []
        self.inputs: list[list[str]] = []
        self.started, self.period_s, self.next_s = False, STEP_S, 0.0

    def publish(self, value: Any) -> None:
        now_s = time.monotonic()
        if not self.started or now_s < self.next_s:
            return
        self.next_s = now_s + 0.9 * self.period_s
        payload = b"\x01"
        for name in self.outputs:
            given = value(name)
            payload += struct.pack(
                f">{PACKED[type_of(name)]}", *(given if isinstance(given, list) else [given])
            )
        with contextlib.suppress(OSError):
            self._send(b"U", payload)

    def take(self, data: bytes) -> None:
        self.buffer += data
        while len(self.buffer) >= 3:
            size = struct.unpack(">H", self.buffer[:2])[0]
            if len(self.buffer) < size:
                return
            kind, body = self.buffer[2:3], self.buffer[3:size]
            self.buffer = self.buffer[size:]
            self._on_package(kind, body)

    def _on_package(self, kind: bytes, body: bytes) -> None:
        if kind == b"V":
            self._send(kind, b"\x01")
        elif kind == b"v":
            self._send(kind, struct.pack(">4I", 5, 14, 0, 1031109))
        elif kind == b"O":
            self.period_s = 1 / struct.unpack(">d", body[:8])[0]
            self.outputs = body[8:].decode().strip(",").split(",")
            self._send(kind, b"\x01" + ",".join(map(type_of, self.outputs)).encode())
        elif kind == b"I":
            self.inputs.append(body.decode().strip(",").split(","))
            types = ",".join(map(type_of, self.inputs[-1]))
            self._send(kind, bytes([len(self.inputs)]) + types.encode())
        elif kind in b"SP":
            self.started = kind == b"S"
            self._send(kind, b"\x01")
        elif kind == b"U":
            names = self.inputs[body[0] - 1]
            packed = ">" + "".join(PACKED[type_of(name)] for name in names)
            self.peer._on_command(dict(zip(names, struct.unpack(packed, body[1:]), strict=True)))

    def _send(self, kind: bytes, body: bytes) -> None:
        self.link.sendall(struct.pack(">H", len(body) + 3) + kind + body)


class PeerProcess(BaseManager):
    """A process for peers: the library keeps the interpreter while it connects."""


PeerProcess.register("UrPeer", UrPeer)
