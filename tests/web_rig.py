"""``vla-zenoh web`` as a process, and browsers without a screen: what they send and get."""

from __future__ import annotations

import http.client
import json
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any

from camera_rig import PATIENCE_S, until
from websockets.exceptions import ConnectionClosed
from websockets.sync import client
from websockets.sync.client import ClientConnection

START_S, END_S = 30.0, 10.0
BEAT_S = 0.1
NO_SHARED_MEMORY = "no shared memory: programs of this host hold "
ENDS = ("done", "failed", "hold_ended")
"""Answers to a press."""
OPERATOR, VIEWER, METRICS = "an operator's token", "a viewer's own token", "prometheus's token"
PEOPLE = {
    "anna": {"role": "operator", "token": OPERATOR},
    "wall": {"role": "viewer", "token": VIEWER},
    "prometheus": {"role": "viewer", "token": METRICS},
}


def write_people(folder: Path, people: Mapping[str, Any] = PEOPLE) -> Path:
    path = folder / "people.yaml"
    path.write_text(json.dumps(people))
    path.chmod(0o600)
    return path


class Site:
    """A running server.

    Args:
        process: it.
        port: of it.
    """

    def __init__(self, process: subprocess.Popen[str], port: int) -> None:
        self.process, self.port = process, port
        self.host = f"127.0.0.1:{port}"

    def ask(
        self, method: str, path: str, headers: Mapping[str, str] | None = None
    ) -> tuple[int, dict[str, str], bytes]:
        """Status, headers and body of a request, whose ``Host`` may be another."""
        connection = http.client.HTTPConnection("127.0.0.1", self.port, timeout=END_S)
        try:
            connection.putrequest(method, path, skip_host=True)
            for name, value in {"Host": self.host, **(headers or {})}.items():
                connection.putheader(name, value)
            connection.endheaders()
            response = connection.getresponse()
            return response.status, dict(response.getheaders()), response.read()
        finally:
            connection.close()

    def connect(
        self, path: str = "/control", *, origin: str | None = None, host: str | None = None
    ) -> ClientConnection:
        """A WebSocket as a browser opens it."""
        return client.connect(
            f"ws://{host or self.host}{path}",
            origin=origin or f"http://{self.host}",  # pyright: ignore[reportArgumentType]
            compression=None,
            proxy=None,
            sock=socket.create_connection(("127.0.0.1", self.port), END_S),
            max_size=None,
        )


class Browser:
    """A page that is open: reads all the time, as a browser does, and beats while it holds."""

    def __init__(self, site: Site, token: str = OPERATOR) -> None:
        self._stack = ExitStack()
        self.connection = self._stack.enter_context(site.connect())
        self.state: dict[str, Any] = {}
        self.heard: list[dict[str, Any]] = []
        self.closed = threading.Event()
        self.echoes = True
        """Whether the newest tick goes back; else the one that was newest then."""
        self.watches = True
        """Whether somebody looks at the page while a trial runs."""
        self._press, self._tick = 0, 0
        self._holding = threading.Event()
        self.twist, self.opening = [0.0] * 6, 0.0
        self.send(do="enter", token=token)
        self._threads = [
            threading.Thread(target=self._read, daemon=True),
            threading.Thread(target=self._beat, daemon=True),
        ]
        for thread in self._threads:
            thread.start()

    def send(self, **message: Any) -> None:
        self.connection.send(json.dumps(message))

    def _read(self) -> None:
        try:
            for text in self.connection:
                message = json.loads(text)
                if message["is"] == "state":
                    self.state = message
                    if self.echoes:
                        self._tick = message["tick"]
                else:
                    self.heard.append(message)
        except ConnectionClosed:
            pass
        self.closed.set()

    def _beat(self) -> None:
        while not self.closed.wait(BEAT_S):
            if self.watches and self.state.get("trial", {}).get("phase") == "run":
                with suppress(ConnectionClosed):
                    self.send(do="watched", tick=self._tick)
            if self._holding.is_set():
                try:
                    self.send(
                        do="beat",
                        press=self._press,
                        tick=self._tick,
                        twist=self.twist,
                        opening=self.opening,
                    )
                except ConnectionClosed:
                    return

    def hold(self) -> None:
        until("a tick", lambda: self._tick)
        self._press += 1
        hand = any(self.twist) or bool(self.opening)
        self.send(do="hold", press=self._press, tick=self._tick, hand=hand)
        self._holding.set()

    def hold_until_active(self, patience_s: float) -> None:
        """Press, as a person does who tries again while something is not ready yet."""
        give_up_s = time.monotonic() + patience_s
        while True:
            self.heard.clear()
            self.hold()
            # A busy computer that keeps an echo back ends the hold, and with it the activation.
            ended = until("an answer", lambda: [m for one in ENDS for m in self.answers(one)])
            if ended[0]["is"] == "done":
                return
            assert time.monotonic() < give_up_s, ended
            self.let_go()

    def hold_until(self, what: str, moved: Callable[[], Any], patience_s: float) -> None:
        """Hold until the arm has moved; press again where a busy computer ends the hold."""
        self.hold_until_active(patience_s)

        def held_and_moved() -> Any:
            if self.answers("hold_ended"):
                self.let_go()
                self.hold_until_active(patience_s)
            return moved()

        until(what, held_and_moved, patience_s)

    def let_go(self) -> None:
        self._holding.clear()
        self.send(do="release")

    def freeze(self) -> None:
        """As a tablet that sleeps: it sends nothing more, and its connection stays open."""
        self._holding.clear()

    def answers(self, what: str) -> list[dict[str, Any]]:
        return [message for message in list(self.heard) if message["is"] == what]

    def wait(
        self,
        what: str,
        fits: Callable[[dict[str, Any]], bool] = lambda _: True,
        timeout_s: float = PATIENCE_S,
    ) -> Any:
        """The first message of this kind that fits."""
        return until(
            f"a message {what}, of {[m for m in self.heard if m['is'] not in ('nodes', 'event')]}",
            lambda: next((message for message in self.answers(what) if fits(message)), None),
            timeout_s,
        )

    def ask(self, **message: Any) -> dict[str, Any]:
        """Send a request, and wait for its end: ``done`` or ``failed``."""
        what = message["do"]
        before = len(self.heard)
        self.send(**message)

        def ended() -> dict[str, Any] | None:
            found = self.heard[before:]
            return next(
                (m for m in found if m["is"] in ("done", "failed") and m["what"] == what), None
            )

        return until(f"the end of {what}", ended, PATIENCE_S)

    def vanish(self) -> None:
        """As a tab that is killed: no word of farewell."""
        self.connection.socket.shutdown(socket.SHUT_RDWR)

    def close(self) -> None:
        self._holding.clear()
        self._stack.close()


def first_line(process: subprocess.Popen[str]) -> str:
    """What a command says first. That what others hold of shared memory leaves it none is theirs:
    other tests run beside this one."""
    assert process.stderr is not None
    line = process.stderr.readline()
    return process.stderr.readline() if line.startswith(NO_SHARED_MEMORY) else line


@contextmanager
def serving(profile: Path, people: Path | None, *more: str) -> Iterator[Site]:
    """The command, until the block ends."""
    words = [sys.executable, "-m", "vla_zenoh", "web", "--profile", str(profile), "--port", "0"]
    words += ["--people", str(people)] if people else []
    environment = {**os.environ, "NO_COLOR": "1"}
    with subprocess.Popen(
        [*words, *more], stderr=subprocess.PIPE, text=True, env=environment, cwd=profile.parent
    ) as process:
        try:
            assert process.stderr is not None
            line = first_line(process)
            if "page of robot" not in line:
                process.kill()  # what else it says has no end while it runs
                raise AssertionError(line + process.stderr.read())
            port = int(line.rpartition(":")[2].partition("/")[0])
            until("it listens", lambda: _listens(process, port), START_S)
            yield Site(process, port)
            if process.poll() == -signal.SIGKILL:  # the test did that
                return
            assert process.poll() is None, process.stderr.read()
            process.send_signal(signal.SIGINT)
            assert process.wait(END_S) == 0, process.stderr.read()
        finally:
            if process.poll() is None:
                process.kill()


def _listens(process: subprocess.Popen[str], port: int) -> bool:
    try:
        return Site(process, port).ask("GET", "/")[0] == 200
    except OSError:
        time.sleep(0.05)
        return False


@contextmanager
def browsing(site: Site, token: str = OPERATOR) -> Iterator[Browser]:
    """An open page that has been let in."""
    browser = Browser(site, token)
    try:
        browser.wait("welcome")
        until("a state", lambda: browser.state)
        yield browser
    finally:
        browser.close()
