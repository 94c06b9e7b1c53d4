"""Teleoperation: a `WorkerNode` whose policy is the operator at this terminal."""

from __future__ import annotations

import os
import select
import sys
import termios
import threading
import time
import tty
from collections import deque
from collections.abc import Callable

import zenoh

from vla_zenoh.client.client import Client, StopOutcome
from vla_zenoh.errors import NodeError, PeerError
from vla_zenoh.keys import CRASHED, STARTING
from vla_zenoh.nodes.worker.node import WorkerNode
from vla_zenoh.policy import Frame
from vla_zenoh.profile import Profile
from vla_zenoh.sanitize import one_line
from vla_zenoh_teleop.keyboard import (
    ACTIVATE,
    BEGIN,
    END,
    LEGEND,
    PARTS_LEGEND,
    QUIT,
    STOP,
    TAKE_OVER,
    Keyboard,
    KeystrokeParser,
)
from vla_zenoh_teleop.leader import LeaderArm, LeaderPolicy
from vla_zenoh_teleop.policy import OperatorInput, TeleopPolicy, combined
from vla_zenoh_teleop.sticks import Gamepad, SpaceMouse

SHOW_PERIOD_S = 0.2
DEVICE_S = 0.02
NOT_CONFIRMED_S, FOLLOW_S = 1.0, 10.0
"""Without an answer that is said so long after a stop, which is followed for so long."""
NO_COMMAND_NODE = "no command node"
UNKNOWN = "state unknown"
"""Before the first task, and after the link of the operator was lost."""
LINK_LOST = (
    "the link to the router is lost: nobody heard that. Use the emergency stop of the arm itself"
)


class Teleop:
    """The teleoperation worker with its keyboard and status line.

    Args:
        operator: session with the rights of an operator; None: keys for settings do nothing.
        level: initial speed, from 0.
        leader: arm whose joints are followed, in place of keys and device that move; for a robot of
            one arm.

    Raises:
        NodeError: no terminal, or a worker of this name is alive.
    """

    def __init__(
        self,
        profile: Profile,
        session: zenoh.Session,
        operator: zenoh.Session | None,
        name: str = "teleop",
        *,
        device: Gamepad | SpaceMouse | None = None,
        frame: Frame = "base",
        level: int = 2,
        leader: LeaderArm | None = None,
    ) -> None:
        self._parser, self._keyboard = KeystrokeParser(), Keyboard(level)
        self._lock = threading.Lock()
        self._stop = threading.Event()
        self._device, self._name = device, name
        self._stick, self._stick_lost = OperatorInput(), ""
        self._terminal = Terminal(self._read, self._terminal_gone)
        self.policy: TeleopPolicy | LeaderPolicy
        if leader is not None:
            self.policy = LeaderPolicy(profile, name, leader.path, time.monotonic)
        else:
            self.policy = TeleopPolicy(
                profile, name, self._input, lambda: self._keyboard.level, frame=frame
            )
        self.worker = WorkerNode(profile, session, self.policy, name)
        self._client = Client(profile, operator).subscribe() if operator is not None else None
        self._other_worker = profile.task.worker
        parts = PARTS_LEGEND.format(", ".join(profile.parts)) if profile.parts else ""
        self._legend = f"{LEGEND}\n{parts}"
        self._lines: deque[str] = deque(maxlen=16)
        self._stop_told: StopOutcome | None = None
        self._stopped_s: float | None = None

    def run(self, stop: threading.Event) -> None:
        """Until `stop`, Ctrl-C, q, or the end of the terminal."""
        self._stop = stop
        with self._terminal as terminal:
            for line in self._legend.splitlines():
                terminal.print(line)
            threads = [threading.Thread(target=self._show_status, args=(terminal,), name="screen")]
            if self._device is not None:
                reads = (self._device,)
                threads.append(threading.Thread(target=self._read_device, args=reads))
            for thread in threads:
                thread.start()
            try:
                self.worker.run(stop)
            finally:
                stop.set()
                for thread in threads:
                    thread.join()

    # -- in -----------------------------------------------------------------------------------
    def _read(self, data: bytes) -> None:
        with self._lock:
            strokes = self._parser.read(data)
            commands = [self._keyboard.update(stroke, time.monotonic()) for stroke in strokes]
        for command in commands:
            if command is not None:
                self._execute(command)

    def _terminal_gone(self) -> None:
        with self._lock:
            self._keyboard.release_all()
        self._stop.set()

    def _input(self) -> OperatorInput:
        with self._lock:
            typed = self._keyboard.read(time.monotonic())
            stick, lost = self._stick, self._stick_lost
        if lost:
            raise PeerError("device_lost", lost)
        return combined(typed, stick)

    def _read_device(self, device: Gamepad | SpaceMouse) -> None:
        """Read it more often than chunks are asked for: a short press counts."""
        while not self._stop.wait(DEVICE_S):
            before = self._stick.takeovers
            try:
                found = device.read()
            except PeerError as error:
                with self._lock:
                    self._stick, self._stick_lost = OperatorInput(), str(error)
                return
            with self._lock:
                self._stick = found
            if found.takeovers != before:
                self._execute(TAKE_OVER)

    def _execute(self, command: str) -> None:
        client = self._client
        task = client.task if client is not None else None
        if command == QUIT:
            self._stop.set()
        elif client is None:
            self._lines.append("this key needs the certificate of an operator on this computer")
        elif command == STOP:
            client.stop()
            self._stop_told, self._stopped_s = None, time.monotonic()
            if not client.session.info.routers_zid():
                self._lines.append(LINK_LOST)
        elif command == ACTIVATE and not client.session.info.routers_zid():
            self._lines.append(LINK_LOST)
        elif command == ACTIVATE:
            # Of an arm that may be active the key is the brake.
            activates = task is not None and not task.active
            client.publish(client.keys.active, "true" if activates else "false")
            if task is None:
                self._lines.append(
                    f"{UNKNOWN}: Enter deactivates. Press it again to activate once it is known"
                )
        elif command == TAKE_OVER:
            self._note_who_leads(client)
            current = task.worker if task is not None else ""
            client.publish(
                client.keys.worker, self._other_worker if current == self._name else self._name
            )

    def _note_who_leads(self, client: Client) -> None:
        """To give the arm back to, also where it was taken by ``vla-zenoh use``."""
        task = client.task
        if task is not None and task.worker != self._name:
            self._other_worker = task.worker

    # -- out ----------------------------------------------------------------------------------
    def _show_status(self, terminal: Terminal) -> None:
        while not self._stop.wait(SHOW_PERIOD_S):
            if self._client is not None:
                self._note_who_leads(self._client)
                self._follow_stop(self._client)
            for node, _, event in self._client.pop_events() if self._client else ():
                if event.level != "info" or event.kind == "transition":
                    self._lines.append(f"{node}: {event.what} {event.why}".rstrip())
            while self._lines:
                terminal.print(one_line(self._lines.popleft()))
            terminal.show(self._status_line())

    def _follow_stop(self, client: Client) -> None:
        """Say each outcome of the last stop once, until the arm stands."""
        if self._stopped_s is None:
            return
        found, took_s = client.stop_progress(), time.monotonic() - self._stopped_s
        waits = found.outcome is StopOutcome.NOT_CONFIRMED and took_s < NOT_CONFIRMED_S
        if not waits and found.outcome is not self._stop_told:
            self._stop_told = found.outcome
            self._lines.append(found.sentence(f"robot {client.keys.robot}"))
        if found.outcome is StopOutcome.CONFIRMED or took_s > FOLLOW_S:
            self._stopped_s = None

    def _status_line(self) -> str:
        task = self._client.task if self._client else None
        status = self._client.status("command") if self._client else None
        state = status.state if status else NO_COMMAND_NODE
        if task is None and state not in (CRASHED, STARTING, NO_COMMAND_NODE):
            state = UNKNOWN
        whose = "?" if task is None else "you" if task.worker == self._name else task.worker
        return one_line(f"{state}, follows {whose} | {self.policy.describe()}")[:118]


POLL_S = 0.2
_DISABLED = b"\x00"


class Terminal:
    """The terminal in raw mode: reads bytes on a thread inside the block, and restores it after.

    Args:
        read: called with bytes, on that thread.
        gone: called once when the terminal is gone.

    Raises:
        NodeError: standard input is no terminal.
    """

    def __init__(self, read: Callable[[bytes], None], gone: Callable[[], None]) -> None:
        if not (sys.stdin.isatty() and sys.stdout.isatty()):
            raise NodeError(
                "teleop needs a terminal for its keyboard; start it in one, without pipes "
                "(over ssh: `ssh -t`)"
            )
        self._read, self._gone = read, gone
        self._in, self._out = sys.stdin.fileno(), sys.stdout.fileno()
        self._end = threading.Event()
        self._thread = threading.Thread(target=self._read_keys, name="keyboard", daemon=True)

    def __enter__(self) -> Terminal:
        self._before = termios.tcgetattr(self._in)
        tty.setcbreak(self._in)  # Ctrl-C stays a signal
        mode = termios.tcgetattr(self._in)
        # Ctrl-Z would suspend the worker of an active arm.
        mode[6][termios.VSUSP] = _DISABLED
        termios.tcsetattr(self._in, termios.TCSADRAIN, mode)
        os.write(self._out, BEGIN)
        self._thread.start()
        return self

    def _read_keys(self) -> None:
        while not self._end.is_set():
            ready, _, _ = select.select([self._in], [], [], POLL_S)
            if not ready:
                continue
            try:
                data = os.read(self._in, 1024)
            except OSError:
                data = b""
            if not data:
                self._gone()
                return
            self._read(data)

    def show(self, line: str) -> None:
        os.write(self._out, f"\r\x1b[K{line}".encode())

    def print(self, line: str) -> None:
        os.write(self._out, f"\r\x1b[K{line}\r\n".encode())

    def __exit__(self, *_: object) -> None:
        self._end.set()
        self._thread.join(2 * POLL_S)
        # The terminal may be gone.
        try:
            os.write(self._out, END + b"\r\x1b[K")
            termios.tcsetattr(self._in, termios.TCSAFLUSH, self._before)
        except (OSError, termios.error):
            pass
