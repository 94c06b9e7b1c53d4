"""A simulated FR3 that speaks the Franka Control Interface, and what its log says."""

from __future__ import annotations

import os
import re
import shlex
import socket
import subprocess
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from camera_rig import until

VARIABLE = "FRANKA_SIM"
"""Command that runs Python in the simulator's environment; ``make test-franka`` sets it."""
SERVER = Path(__file__).with_name("server.py")
STARTS_S, ENDS_S = 60.0, 15.0
HZ = 1000.0
PORT = 1337
RULES = ("--enforce-comm-constraints", "--enforce-motion-limits")


class Simulator:
    """A running franka-sim that ends motions as the robot does."""

    def __init__(self, process: subprocess.Popen[bytes], log: Path) -> None:
        self.process, self._log = process, log

    @property
    def lines(self) -> list[str]:
        return self._log.read_text(errors="replace").splitlines()

    def aborts(self, since: int = 0) -> list[str]:
        """What ended motions, from line `since` on."""
        return [line for line in self.lines[since:] if "aborting the motion" in line]

    def realtime_share(self, since: int = 0) -> float:
        """How much of real time it kept while a client was connected."""
        rates = [
            float(match[1])
            for line in self.lines[since:]
            if (match := re.search(r"State Update Stats - Freq: ([\d.]+)Hz", line))
        ]
        return sum(rates) / len(rates) / HZ if rates else 0.0


@contextmanager
def simulator(*options: str) -> Iterator[Simulator]:
    """franka-sim at 127.0.0.1, with motion limits and communication enforced."""
    with tempfile.TemporaryDirectory() as folder:
        log = Path(folder) / "log"
        command = [*shlex.split(os.environ[VARIABLE]), str(SERVER), folder, *RULES, *options]
        with log.open("wb") as out:
            process = subprocess.Popen(
                command, stdout=out, stderr=subprocess.STDOUT, start_new_session=True
            )
        try:
            until("the simulator listens", lambda: _listens(process, log), STARTS_S)
            yield Simulator(process, log)
        finally:
            process.terminate()
            try:
                process.wait(ENDS_S)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()


def _listens(process: subprocess.Popen[bytes], log: Path) -> bool:
    assert process.poll() is None, log.read_text(errors="replace")[-3000:]
    if "ready for new client" not in log.read_text(errors="replace"):
        return False
    with socket.socket() as probe:
        busy = probe.connect_ex(("127.0.0.1", PORT)) == 0
    time.sleep(0.5)  # the server sees the probe come and go
    return busy
