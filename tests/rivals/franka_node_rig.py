"""franka-node's client, and a node around its loop, as processes: franka_node_process.py."""

from __future__ import annotations

import json
import os
import select
import subprocess
from pathlib import Path
from typing import Any, Self

from physicalai_rig import Process

VARIABLE = "FRANKA_NODE_PYTHON"
"""Environment variable with the Python that has franka-node-client and franka-rs."""
NODE = "FRANKA_NODE"
"""Environment variable with franka-node itself, where it is installed: else our stand-in runs."""
CONFIG = """
name = "node1"

[zenoh]
mode = "client"
connect = ["{endpoint}"]

[[arm]]
name = "fr3"
host = "127.0.0.1"
realtime = "ignore"
{more}
"""
SCRIPT = Path(__file__).with_name("franka_node_process.py")


def python() -> str:
    """The Python that has them."""
    return os.environ[VARIABLE]


class FrankaProcess(Process):
    """One role of franka_node_process.py, once it is ready."""

    def __init__(self, *given: str) -> None:
        super().__init__(*given, python=python(), script=SCRIPT)
        while self.line() != "READY":
            pass


class Client(FrankaProcess):
    """Their client of an arm; `ask` it for verbs."""

    def __init__(self, endpoint: str, arm: str) -> None:
        super().__init__("client", endpoint, arm)

    def send(self, **question: Any) -> None:
        self._in.write(json.dumps(question) + "\n")
        self._in.flush()

    def answered(self) -> bool:
        """There is an answer to read."""
        return bool(select.select([self._out], [], [], 0)[0])

    def answer(self) -> dict[str, Any]:
        return json.loads(self.line())


class FrankaNode:
    """franka-node itself, which dials `endpoint`; `more` is TOML of its arm."""

    def __init__(self, endpoint: str, folder: Path, more: str = "") -> None:
        config = folder / "franka-node.toml"
        config.write_text(CONFIG.format(endpoint=endpoint, more=more))
        environ = {**os.environ, "RUST_LOG": "debug,zenoh=warn"}
        with (folder / "franka-node.log").open("wb") as log:
            self._process = subprocess.Popen(
                [os.environ[NODE], str(config)], stdout=log, stderr=log, env=environ
            )

    @property
    def pid(self) -> int:
        return self._process.pid

    def kill(self) -> None:
        self._process.kill()
        self._process.wait()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.kill()


def node(endpoint: str, folder: Path) -> FrankaNode | FrankaProcess:
    """franka-node, or our stand-in for it."""
    if NODE in os.environ:
        return FrankaNode(endpoint, folder)
    return FrankaProcess("node", endpoint)
