"""physicalai's own processes, run by the Python that has it: physicalai_peer_process.py."""

from __future__ import annotations

import json
import os
import subprocess
from pathlib import Path
from typing import Any, Self

VARIABLE = "PHYSICALAI_PYTHON"
SCRIPT = Path(__file__).with_name("physicalai_peer_process.py")


class Process:
    """What plays a role of others, by a script in their environment."""

    def __init__(self, *given: str, python: str = "", script: Path = SCRIPT) -> None:
        self._process = subprocess.Popen(
            [python or os.environ[VARIABLE], str(script), *given],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._in, self._out = self._process.stdin, self._process.stdout

    def line(self) -> str:
        """Its next line."""
        line = self._out.readline()
        assert line, "it ended"
        return line.strip()

    def ask(self, **question: Any) -> dict[str, Any]:
        """The answer to a line."""
        self._in.write(json.dumps(question) + "\n")
        self._in.flush()
        return json.loads(self.line())

    @property
    def pid(self) -> int:
        return self._process.pid

    def kill(self) -> None:
        self._process.kill()
        self._process.wait()
        self._in.close()
        self._out.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._in.close()  # ends it
        self._process.wait(20)
        self._out.close()


class Owner(Process):
    """physicalai's owner of an arm that is at once where it is sent."""

    def __init__(self, name: str, arm: str = "Arm") -> None:
        super().__init__("owner", name, arm)
        while self.line() != "READY":
            pass


class Client(Process):
    """physicalai's client of a robot; call `attached` first, once."""

    def __init__(self, name: str) -> None:
        super().__init__("client", name)

    def attached(self) -> list[str]:
        """The names of the joints, once it is attached."""
        return json.loads(self.line())["joint_names"]
