"""An agent drives the simulated arm by the Model Context Protocol."""

from __future__ import annotations

import base64
import json
import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import cv2
import numpy as np
import pytest
from camera_rig import until
from chain import LONG_PATIENCE_S, Chain, running_chain

from vla_zenoh.keys import PRIMITIVES, worker_node

pytestmark = pytest.mark.long

HOSTS = "hosts: {here: {nodes: [router, sim, camera, command, worker, primitives]}}\n"
NEAR_M = 1e-3
FAR_M = [0.55, 0.2, 0.35]
END_S = 20.0


@pytest.fixture(scope="module")
def chain(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Chain]:
    folder = tmp_path_factory.mktemp("mcp")
    with running_chain(folder, more=HOSTS, patience_s=LONG_PATIENCE_S) as found:
        found.until("the node answers", lambda: worker_node(PRIMITIVES) in found.client.alive, 40)
        yield found


class Agent:
    """A client of the server, by JSON-RPC alone."""

    def __init__(self, process: subprocess.Popen[str]) -> None:
        self.process, self._last = process, 0

    def send(self, method: str, params: Any = None, *, answered: bool = True) -> int:
        self._last += answered
        message = {"jsonrpc": "2.0", "method": method, "params": params or {}}
        self.write(json.dumps({**message, "id": self._last} if answered else message))
        return self._last

    def write(self, line: str) -> None:
        assert self.process.stdin is not None
        self.process.stdin.write(line + "\n")
        self.process.stdin.flush()

    def read(self) -> dict[str, Any]:
        assert self.process.stdout is not None
        return json.loads(self.process.stdout.readline())

    def ask(self, method: str, params: Any = None) -> dict[str, Any]:
        number = self.send(method, params)
        found = self.read()
        assert found["id"] == number
        return found["result"]

    def call(self, name: str, **arguments: Any) -> dict[str, Any]:
        return self.ask("tools/call", {"name": name, "arguments": arguments})


def command(chain: Chain) -> list[str]:
    return [
        *(sys.executable, "-m", "vla_zenoh", "serve", "mcp"),
        *("--profile", str(chain.profile_file)),
    ]


@contextmanager
def agent(chain: Chain) -> Iterator[Agent]:
    pipe = subprocess.PIPE
    with subprocess.Popen(command(chain), stdin=pipe, stdout=pipe, text=True) as process:
        try:
            found = Agent(process)
            found.ask("initialize", {"protocolVersion": "2025-06-18"})
            found.send("notifications/initialized", answered=False)
            yield found
        finally:
            process.kill()


def test_an_agent_sees_moves_grips_and_looks(chain: Chain) -> None:
    chain.settle()
    with agent(chain) as found:
        names = [tool["name"] for tool in found.ask("tools/list")["tools"]]
        assert names == ["move_to", "home", "grip", "run", "stop", "state", "picture"]
        state = found.call("state")["structuredContent"]
        assert state["cameras"] == ["front"]
        assert not state["active"]
        moved = found.call("move_to", position_m=[0.5, 0.1, 0.3])
        assert moved["structuredContent"]["reason"] == "reached"
        assert not moved["isError"]
        state = found.call("state")["structuredContent"]
        assert state["position_m"] == pytest.approx([0.5, 0.1, 0.3], abs=NEAR_M)
        assert found.call("grip", width_m="open")["structuredContent"]["ok"]
        (image,) = found.call("picture", camera="front")["content"]
        assert image["mimeType"] == "image/jpeg"
        pixels = np.frombuffer(base64.b64decode(image["data"]), np.uint8)
        picture = cv2.imdecode(pixels, cv2.IMREAD_COLOR)
        assert picture is not None
        assert picture.shape == (120, 160, 3)


def test_what_cannot_be_done_is_an_error_with_its_reason(chain: Chain) -> None:
    chain.settle()
    with agent(chain) as found:
        for name, arguments, words in (
            ("move_to", {"position_m": [0.5, 0.0, -0.2]}, "workspace"),
            ("move_to", {"position_m": "there"}, "position_m"),
            ("grip", {"width": 3}, "width_m: is missing"),
            ("picture", {"camera": "no"}, "none of front"),
            ("run", {"worker": "nobody"}, "not alive"),
            ("state", {"surplus": 1}, "surplus"),
        ):
            result = found.call(name, **arguments)
            assert result["isError"]
            assert words in result["content"][0]["text"]
        found.write("garbage")
        assert found.read()["error"]["code"] == -32700
        assert found.ask("ping") == {}


def test_a_stop_is_obeyed_while_a_motion_runs(chain: Chain) -> None:
    chain.settle()
    with agent(chain) as found:
        found.call("home")
        moving = found.send("tools/call", {"name": "move_to", "arguments": {"position_m": FAR_M}})
        chain.until("it moves", chain.moves)
        stop = found.send("tools/call", {"name": "stop", "arguments": {}})
        answers = {reply["id"]: reply["result"] for reply in (found.read(), found.read())}
        stopped = answers[stop]["structuredContent"]
        assert stopped["outcome"] == "confirmed"
        assert stopped["message"].startswith(f"CONFIRMED: robot {chain.profile.robot.name} is")
        assert answers[moving]["structuredContent"]["reason"] == "stopped"
        assert found.call("home")["structuredContent"]["reason"] == "rejected"
    assert chain.state() == "stopped"


@pytest.mark.parametrize("how", ["cancelled", "closed", "killed"])
def test_an_agent_that_is_gone_brakes_the_arm(chain: Chain, how: str) -> None:
    chain.settle()
    with agent(chain) as found:
        found.call("home")
        moving = found.send("tools/call", {"name": "move_to", "arguments": {"position_m": FAR_M}})
        chain.until("it moves", chain.moves)
        if how == "cancelled":
            found.send("notifications/cancelled", {"requestId": moving}, answered=False)
        elif how == "closed":
            assert found.process.stdin is not None
            found.process.stdin.close()
            assert found.process.wait(END_S) == 0
        else:
            found.process.kill()
        until("it is inactive", lambda: chain.state() == "inactive")
        chain.wait_still()
        assert float(np.linalg.norm(chain.measured().position_m - FAR_M)) > 0.05


def test_the_official_client_drives_the_arm(chain: Chain) -> None:
    mcp = pytest.importorskip("mcp", reason="the mcp package is not installed")
    chain.settle()
    import asyncio

    async def drive() -> tuple[list[str], Any, Any]:
        first, *rest = command(chain)
        server = mcp.StdioServerParameters(command=first, args=rest, env=dict(os.environ))
        async with mcp.Client(mcp.stdio_client(server)) as client:
            names = [tool.name for tool in (await client.list_tools()).tools]
            moved = await client.call_tool("move_to", {"position_m": [0.45, -0.1, 0.25]})
            seen = await client.call_tool("picture", {"camera": "front"})
            return names, moved, seen

    names, moved, seen = asyncio.run(drive())
    assert "move_to" in names
    assert moved.structured_content["reason"] == "reached"
    assert seen.content[0].type == "image"
