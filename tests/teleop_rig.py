"""``vla-zenoh teleop`` in a terminal of its own, with somebody at the keys."""

from __future__ import annotations

import os
import pty
import select
import subprocess
import sys
import termios
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from camera_rig import PATIENCE_S, until
from chain import READY_PATIENCE_S, Chain

REPEAT_S = 0.03
"""A keyboard repeats this often."""
IN_A_TERMINAL = """\
import fcntl, runpy, sys, termios
fcntl.ioctl(0, termios.TIOCSCTTY, 0)
sys.argv[0] = "vla-zenoh"
runpy.run_module("vla_zenoh", run_name="__main__")
"""


class Screen:
    """A terminal with ``vla-zenoh teleop`` in it."""

    def __init__(self, profile: Path, *options: str) -> None:
        self.shown = b""
        self._master, self._slave = pty.openpty()
        self.before = termios.tcgetattr(self._slave)
        words = [sys.executable, "-c", IN_A_TERMINAL, "teleop", *options]
        self.process = subprocess.Popen(
            [*words, "--profile", str(profile)],
            stdin=self._slave,
            stdout=self._slave,
            stderr=self._slave,
            start_new_session=True,
        )
        self._end = threading.Event()
        self._thread = threading.Thread(target=self._watch)
        self._thread.start()

    def _watch(self) -> None:
        while not self._end.is_set():
            if select.select([self._master], [], [], 0.05)[0]:
                self.shown += os.read(self._master, 4096)

    def type(self, keys: bytes) -> None:
        os.write(self._master, keys)

    def hold(self, key: bytes, until_true: Callable[[], bool]) -> None:
        """As a keyboard does that repeats."""
        give_up_s = time.monotonic() + PATIENCE_S
        while not until_true():
            assert time.monotonic() < give_up_s, self.shown.decode()
            self.type(key)
            time.sleep(REPEAT_S)

    def settings(self) -> list:
        return termios.tcgetattr(self._slave)

    def close(self) -> None:
        if self.process.poll() is None:
            self.process.kill()
        self.process.wait()
        self._end.set()
        self._thread.join()
        os.close(self._master)
        os.close(self._slave)


@contextmanager
def teleop(chain: Chain, *options: str, profile: Path | None = None) -> Iterator[Screen]:
    """Somebody at the keys, who sees the robot's state.

    Args:
        chain: the robot.
        options: of the command.
        profile: of the computer that has the terminal; None: the robot's own.
    """
    screen = Screen(profile or chain.profile_file, *options)
    try:
        until(
            "teleop is there",
            lambda: "worker-teleop" in chain.client.alive or screen.process.poll() is not None,
            READY_PATIENCE_S,
        )
        assert screen.process.poll() is None, screen.shown.decode()
        until("it shows the state", lambda: b"follows" in screen.shown, READY_PATIENCE_S)
        yield screen
    finally:
        screen.close()
