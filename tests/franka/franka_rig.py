"""A simulated FR3 that speaks the Franka Control Interface, and what its log says."""

from __future__ import annotations

import os
import re
import shlex
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from camera_rig import until

VARIABLE = "FRANKA_SIM"
"""Command that runs Python in the simulator's environment; ``make test-franka`` sets it."""
SERVER, RELAY = (Path(__file__).with_name(name) for name in ("server.py", "relay.py"))
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

    def freeze(self) -> None:
        """Stand still. The group, as uv, which runs it, does not pass such a signal on."""
        os.killpg(self.process.pid, signal.SIGSTOP)

    def go_on(self) -> None:
        """End `freeze`."""
        os.killpg(self.process.pid, signal.SIGCONT)

    def kill(self) -> None:
        """Be gone at once."""
        os.killpg(self.process.pid, signal.SIGKILL)
        self.process.wait()

    def lose_object(self) -> None:
        """Take away what is between the fingers."""
        self.process.send_signal(signal.SIGUSR1)

    def realtime_share(self, since: int = 0) -> float:
        """How much of real time it kept while a client was connected."""
        rates = [
            float(match[1])
            for line in self.lines[since:]
            if (match := re.search(r"State Update Stats - Freq: ([\d.]+)Hz", line))
        ]
        return sum(rates) / len(rates) / HZ if rates else 0.0


class Cable:
    """The way to a simulator, which can be pulled; see ``relay.py``."""

    def __init__(self, process: subprocess.Popen[str]) -> None:
        self._process = process

    def pull(self, duration_s: float) -> None:
        """Lose what is sent within `duration_s`, and return after it."""
        assert self._process.stdin is not None
        self._process.stdin.write(f"{duration_s}\n")
        self._process.stdin.flush()
        time.sleep(duration_s)


@contextmanager
def cable(address: str, port: int) -> Iterator[Cable]:
    """A cable from `address` to the simulator at `port`."""
    process = subprocess.Popen(
        [sys.executable, str(RELAY), address, str(port)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    assert process.stdout is not None
    while "listening" not in (line := process.stdout.readline()):
        assert line, "the relay ended"
    try:
        yield Cable(process)
    finally:
        process.kill()
        process.communicate()


@contextmanager
def simulator(*options: str, port: int = PORT) -> Iterator[Simulator]:
    """franka-sim at 127.0.0.1, with motion limits and communication enforced."""
    with tempfile.TemporaryDirectory() as folder:
        log = Path(folder) / "log"
        command = [*shlex.split(os.environ[VARIABLE]), str(SERVER), folder, *RULES, *options]
        command += ["--port", str(port)]
        with log.open("wb") as out:
            process = subprocess.Popen(
                command, stdout=out, stderr=subprocess.STDOUT, start_new_session=True
            )
        try:
            until("the simulator listens", lambda: _listens(process, log, port), STARTS_S)
            yield Simulator(process, log)
        finally:
            process.terminate()
            try:
                process.wait(ENDS_S)
            except subprocess.TimeoutExpired:
                os.killpg(process.pid, signal.SIGKILL)
                process.wait()


def _listens(process: subprocess.Popen[bytes], log: Path, port: int) -> bool:
    assert process.poll() is None, log.read_text(errors="replace")[-3000:]
    if "ready for new client" not in log.read_text(errors="replace"):
        return False
    with socket.socket() as probe:
        busy = probe.connect_ex(("127.0.0.1", port)) == 0
    time.sleep(0.5)  # the server sees the probe come and go
    return busy
