"""R2C's own programs and ours, as processes: its dummy robot, our gateway."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any, Self

VARIABLE = "R2C_PYTHON"
DEVICE = "project-demo/so101"
"""Of its own client_config.yaml."""
_TARGET = re.compile(r"action received\. target_state=.*'shoulder_pan\.pos': ([-+.e0-9]+)")
_FINAL = re.compile(r"final_joint_state=\[([^]]+)\]")


class Process:
    """A program whose output is read as it comes."""

    def __init__(self, log: Path, words: list[str], **environ: str) -> None:
        self.log = log
        with log.open("w") as out:
            self._process = subprocess.Popen(
                words,
                stdin=subprocess.DEVNULL,
                stdout=out,
                stderr=subprocess.STDOUT,
                env={**os.environ, "PYTHONUNBUFFERED": "1", **environ},
            )

    @property
    def text(self) -> str:
        return self.log.read_text(errors="replace")

    def until(self, words: str, patience_s: float = 40.0) -> None:
        """Wait until it says so."""
        end_s = time.monotonic() + patience_s
        while words not in self.text:
            assert self._process.poll() is None, self.text[-2000:]
            assert time.monotonic() < end_s, self.text[-2000:]
            time.sleep(0.05)

    def kill(self) -> None:
        self._process.kill()
        self._process.wait()

    def interrupt(self) -> None:
        """Ctrl-C, and wait."""
        self._process.send_signal(signal.SIGINT)
        self._process.wait(20)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        if self._process.poll() is None:
            self.kill()


def ours(*words: str) -> list[str]:
    return [sys.executable, "-m", "vla_zenoh", *words]


class Router(Process):
    """Our router, eclipse-zenoh 1.10."""

    def __init__(self, log: Path, port: int) -> None:
        endpoint = f"tcp/127.0.0.1:{port}"
        super().__init__(log, ours("node", "router", "-p", "so101_sim", "--listen", endpoint))
        self.until("routing")


class Gateway(Process):
    """`serve r2c` with a model of a file."""

    def __init__(self, log: Path, port: int, model: Path, robot: Path) -> None:
        words = ours("serve", "r2c", "-w", str(model), "-r", str(robot), "-p", "so101_sim")
        super().__init__(log, words, VLA_ZENOH_CONNECT=f"tcp/127.0.0.1:{port}")
        self.until(f"for the R2C robot {DEVICE}")


class Robot(Process):
    """Its client with its dummy robot, with the files that come with it."""

    def __init__(self, log: Path, port: int) -> None:
        words = [os.environ[VARIABLE], "-m", "cloudrobo_r2c.cloudroboclient", "--mode", "client"]
        super().__init__(log, [*words, "--endpoints", f"tcp/127.0.0.1:{port}"])

    @property
    def targets_rad(self) -> list[float]:
        """Where its shoulder was sent."""
        return [float(found) for found in _TARGET.findall(self.text)]

    @property
    def final(self) -> list[float]:
        """Its joints when it ended."""
        return [float(number) for number in _FINAL.findall(self.text)[-1].split(",")]

    def moves_on(self, patience_s: float = 40.0) -> float:
        """Seconds until it executes another action."""
        before, began_s = len(self.targets_rad), time.monotonic()
        while len(self.targets_rad) == before:
            assert time.monotonic() - began_s < patience_s, self.text[-2000:]
            time.sleep(0.02)
        return time.monotonic() - began_s

    def stands_after(self, still_s: float = 1.5) -> float:
        """Seconds until its last action, after which none came for `still_s`."""
        began_s = last_s = time.monotonic()
        count = len(self.targets_rad)
        while time.monotonic() - last_s < still_s:
            time.sleep(0.02)
            now = len(self.targets_rad)
            if now != count:
                count, last_s = now, time.monotonic()
        return last_s - began_s


def write(path: Path, text: str, **values: Any) -> Path:
    path.write_text(text.format(**values) if values else text)
    return path
