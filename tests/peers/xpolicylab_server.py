"""A policy server as XPolicyLab's, written after its ``client_server/ws`` of July 2026.

With msgpack-numpy installed, which XPolicyLab's own server uses, arrays are its; otherwise as that
package writes them. Variants: ``other`` (answers with another request's number).
"""

from __future__ import annotations

import asyncio
from contextlib import suppress
from typing import Any

import msgpack
import numpy as np
import policy
import websockets.asyncio.server as server
from websockets.exceptions import ConnectionClosed

try:
    from msgpack_numpy import decode, encode
except ImportError:

    def encode(value: Any) -> Any:
        if not isinstance(value, np.ndarray):
            raise TypeError(type(value))
        parts = {"nd": True, "type": value.dtype.str, "kind": b"", "shape": value.shape}
        return {
            **{key.encode(): part for key, part in parts.items()},
            b"data": value.tobytes(),
        }

    def decode(value: dict[Any, Any]) -> Any:
        if b"nd" not in value:
            return value
        return np.ndarray(value[b"shape"], value[b"type"], value[b"data"])


ENVELOPE = {
    **dict.fromkeys(("message_type", "message_id", "evaluation_id", "sent_at"), str),
    **{"step": int, "payload": dict},
}
ALLOWED = {*ENVELOPE, "action_case_id", "trial_id", "repeat_index"}
UP_RAD = np.array([0.0, -0.03, 0.0, 0.0, 0.0, 0.0, 0.0])
"""A step of the second joint backwards lifts a Panda's hand by about 12 mm."""


class Model:
    """One arm, by its joints: the prompt moves the second one."""

    def __init__(self) -> None:
        self.trial: str | None = None

    def infer(self, observation: dict[str, Any]) -> list[dict[str, Any]]:
        assert observation["data_format_version"] == "v1.0"
        picture = observation["vision"]["cam_head"]["color"]
        assert (picture.dtype, picture.shape[-1]) == (np.uint8, 3), picture.shape
        state = observation["state"]
        assert state["arm_joint_state"].shape == (7,), state["arm_joint_state"]
        assert state["ee_joint_state"].shape == (1,), state["ee_joint_state"]
        moves = policy.actions(observation["instruction"])
        turns = np.cumsum(moves[:, 2:3] / policy.STEP_M, axis=0) * UP_RAD + moves[:, :1]
        steps = [
            {"arm_joint_state": (state["arm_joint_state"] + turn).astype(np.float32)}
            for turn in turns
        ]
        if moves.shape[1] == 7:
            for step, gripper in zip(steps, moves[:, 6], strict=True):
                step["ee_joint_state"] = np.array([gripper], np.float32)
        return steps


def answer(frame: dict[str, Any], model: Model) -> tuple[str, dict[str, Any]]:
    """Type and payload."""
    kind, payload = frame["message_type"], frame["payload"]
    if kind == "hello":
        return "hello_ack", {"ok": True, "server": "demo_policy_server"}
    if kind == "prepare_case":
        return "prepare_case_ack", {"ok": True, "result": payload["action_case_id"]}
    if kind == "reset":
        assert model.trial is None, "the last trial has not ended"
        model.trial = frame["trial_id"]
        return "reset_result", {"ok": True}
    if kind == "trial_end":
        assert model.trial == payload["trial_id"]
        model.trial = None
        return "trial_end_ack", {"ok": True}
    if kind == "infer":
        assert frame["trial_id"] == model.trial
        try:
            return "infer_result", {
                "actions": model.infer(payload["observation"]),
                "latency_ms": 1.0,
            }
        except Exception as failed:  # any fault of a request is its answer
            return "error", {"code": "infer_failed", "message": repr(failed), "details": {}}
    return "error", {"code": "unknown_message_type", "message": kind, "details": {}}


async def serve(connection: server.ServerConnection, variant: str) -> None:
    model = Model()
    async for raw in connection:
        frame = msgpack.unpackb(raw, raw=False, object_hook=decode)
        assert set(frame) <= ALLOWED, sorted(frame)
        assert all(isinstance(frame[name], kind) for name, kind in ENVELOPE.items()), frame
        # As published: another thread, so that pings are answered meanwhile.
        kind, payload = await asyncio.to_thread(answer, frame, model)
        said = {**frame, "message_type": kind, "payload": payload}
        if variant == "other" and kind == "infer_result":
            said["message_id"] = "another"
        await connection.send(msgpack.packb(said, default=encode, use_bin_type=True))


async def main(port: int, variant: str) -> None:
    async def until_gone(connection: server.ServerConnection) -> None:
        with suppress(ConnectionClosed):
            await serve(connection, variant)

    async with server.serve(until_gone, "127.0.0.1", port, max_size=None) as running:
        await running.serve_forever()


if __name__ == "__main__":
    told = policy.arguments()
    asyncio.run(main(told.port, told.variant))
