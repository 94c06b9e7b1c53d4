"""A policy server as openpi and vllm-omni serve, written after their published servers.

With openpi-client installed it is encoded and decoded by openpi's own code; otherwise as its form
is published. Variants: ``vllm`` (bare arrays, resets, errors as maps, needs a session).
"""

from __future__ import annotations

import asyncio
import http
import time
import traceback
from typing import Any

import numpy as np
import policy
import websockets.asyncio.server as server
from websockets.exceptions import ConnectionClosed

try:
    from openpi_client import msgpack_numpy

    packb, unpackb = msgpack_numpy.packb, msgpack_numpy.unpackb
except ImportError:
    import msgpack

    def _out(value: Any) -> Any:
        if not isinstance(value, np.ndarray):
            return value
        parts = {"__ndarray__": True, "data": value.tobytes(), "dtype": value.dtype.str}
        return {key.encode(): part for key, part in {**parts, "shape": value.shape}.items()}

    def _in(value: dict[Any, Any]) -> Any:
        if b"__ndarray__" not in value:
            return value
        return np.ndarray(value[b"shape"], value[b"dtype"], value[b"data"])

    def packb(value: Any) -> Any:
        return msgpack.packb(value, default=_out)

    def unpackb(data: Any) -> Any:
        return msgpack.unpackb(data, object_hook=_in)


def check(asked: dict[str, Any]) -> None:
    """As strict as a policy's own transforms."""
    image, state = asked["observation/image"], asked["observation/state"]
    assert (image.dtype, image.ndim, image.shape[-1]) == (np.uint8, 3, 3), image.shape
    assert (state.dtype, state.shape) == (np.float32, (8,)), state.shape


async def openpi(connection: server.ServerConnection) -> None:
    await connection.send(packb({"reset_pose": [0.0] * 7}))
    before_s: float | None = None
    while True:
        try:
            began_s = time.monotonic()
            asked = unpackb(await connection.recv())
            check(asked)
            # As published: the policy blocks every other client, and the pings.
            found = {
                "actions": policy.actions(asked["prompt"]),
                "state": asked["observation/state"],
            }
            timing = {"infer_ms": 1e3 * (time.monotonic() - began_s)}
            if before_s is not None:
                timing["prev_total_ms"] = 1e3 * before_s
            await connection.send(packb({**found, "server_timing": timing}))
            before_s = time.monotonic() - began_s
        except ConnectionClosed:
            return
        except Exception:  # any fault of a request is its answer
            await connection.send(traceback.format_exc())
            await connection.close(1011, "Internal server error.")
            return


async def vllm(connection: server.ServerConnection) -> None:
    await connection.send(
        packb({"action_dim": 7, "action_horizon": policy.HORIZON, "needs_session_id": True})
    )
    reset = False
    async for frame in connection:
        asked = unpackb(frame)
        if asked.pop("endpoint", "infer") == "reset":
            reset = True
            await connection.send(packb({"status": "reset successful"}))
            continue
        try:
            check(asked)
            assert reset
            assert asked["session_id"]
            await connection.send(packb(policy.actions(asked["prompt"])))
        except Exception:  # any fault of a request is its answer
            await connection.send(packb({"type": "error", "message": "Internal inference error"}))


def health(connection: server.ServerConnection, request: Any) -> Any:
    if request.path == "/healthz":
        return connection.respond(http.HTTPStatus.OK, "OK\n")
    return None


async def main(port: int, variant: str) -> None:
    answer = vllm if variant == "vllm" else openpi
    async with server.serve(
        answer, "127.0.0.1", port, compression=None, max_size=None, process_request=health
    ) as running:
        await running.serve_forever()


if __name__ == "__main__":
    told = policy.arguments()
    asyncio.run(main(told.port, told.variant))
