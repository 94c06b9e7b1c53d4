"""An agent: a client of the MCP server ``vla-zenoh serve mcp``, by JSON-RPC alone."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any, Self


class Agent:
    """Calls tools; each answer is what an agent's program would read.

    Args:
        profile: of the robot.
    """

    def __init__(self, profile: Path) -> None:
        words = [sys.executable, "-m", "vla_zenoh", "serve", "mcp", "--profile", str(profile)]
        pipe = subprocess.PIPE
        self._process = subprocess.Popen(words, stdin=pipe, stdout=pipe, text=True)
        self._number = 0
        self._ask("initialize", {"protocolVersion": "2025-06-18"})

    def call(self, name: str, **arguments: Any) -> dict[str, Any]:
        """The structured answer of a tool."""
        answer = self._ask("tools/call", {"name": name, "arguments": arguments})
        return answer["structuredContent"]

    def _ask(self, method: str, params: Any) -> dict[str, Any]:
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._number += 1
        asked = {"jsonrpc": "2.0", "id": self._number, "method": method, "params": params}
        self._process.stdin.write(json.dumps(asked) + "\n")
        self._process.stdin.flush()
        return json.loads(self._process.stdout.readline())["result"]

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._process.kill()
        self._process.communicate()
