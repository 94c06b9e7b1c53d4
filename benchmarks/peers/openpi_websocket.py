"""openpi's way: an asyncio WebSocket server and a synchronous client, arrays in msgpack."""

from __future__ import annotations

import asyncio
import time
from contextlib import ExitStack
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray
from websockets.asyncio.server import ServerConnection
from websockets.asyncio.server import serve as listen
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect

from benchmarks.peers import ACTION, ADDRESS, PROMPT, Pictures, arrays


async def _answer(connection: ServerConnection, takes_s: float) -> None:
    await connection.send(arrays.pack({}))  # the server's description of itself comes first
    actions = np.array([ACTION], np.float32)
    try:
        while True:
            asked = arrays.unpack(await connection.recv())  # pyright: ignore[reportArgumentType]
            assert all(asked[name].ndim == 3 for name in asked if name.startswith("observation/"))
            time.sleep(takes_s)  # as there: inference holds up every client
            await connection.send(arrays.pack({"actions": actions, "server_timing": {}}))
    except ConnectionClosed:
        return


async def _serve(port: int, takes_s: float) -> None:
    answer = partial(_answer, takes_s=takes_s)
    async with listen(answer, ADDRESS, port, compression=None, max_size=None) as server:
        await server.serve_forever()


def serve(port: int, takes_s: float) -> None:
    """Answer until the process ends."""
    asyncio.run(_serve(port, takes_s))


class Client:
    """Client side."""

    def __init__(self, port: int) -> None:
        self._up = ExitStack()
        url = f"ws://{ADDRESS}:{port}"
        self._socket = self._up.enter_context(
            connect(url, compression=None, max_size=None, proxy=None)
        )
        self._socket.recv()

    def request(self, pictures: Pictures) -> NDArray[Any]:
        """Send images; returns seven floats."""
        images = {f"observation/image_{number}": rgb for number, rgb in enumerate(pictures)}
        self._socket.send(arrays.pack({**images, "prompt": PROMPT}))
        answer = arrays.unpack(self._socket.recv())  # pyright: ignore[reportArgumentType]
        return answer["actions"][0]

    def close(self) -> None:
        """Say goodbye."""
        self._up.close()
