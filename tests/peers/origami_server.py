"""A policy as origami-zenoh-v1 is published: a Zenoh client with three queryables.

``--port`` is that of the router. It speaks of 65 joints; those of the right arm are a Panda's, and
the prompt moves its second joint. Variants: ``other`` (answers with another request's number).
"""

from __future__ import annotations

import threading
from typing import Any

import msgpack
import numpy as np
import policy
import zenoh

PROTOCOL = "origami-zenoh-v1"
ARM = slice(29, 36)
DIM = 65
SESSION = "vla-zenoh"
NAMES = [f"joint_{index}" for index in range(DIM)]
SHAPES = {
    **dict.fromkeys(
        [
            f"observation/image/{c}"
            for c in ("head_left", "head_right", "wrist_left", "wrist_right")
        ],
        (224, 224, 3),
    ),
    "observation/image/tactile_deform": (480, 1200, 3),
    "observation/state": (65,),
    "observation/state/joint_torque": (65,),
    "observation/tactile": (60,),
}
UP_RAD = np.array([0.0, -0.03, 0.0, 0.0, 0.0, 0.0, 0.0])
"""A step of the second joint backwards lifts the hand by about 12 mm."""


def out(value: Any) -> Any:
    parts = {"__ndarray__": True, "data": value.tobytes(), "dtype": value.dtype.str}
    return {key.encode(): part for key, part in {**parts, "shape": value.shape}.items()}


def back(value: dict[Any, Any]) -> Any:
    if b"__ndarray__" not in value:
        return value
    return np.frombuffer(value[b"data"], value[b"dtype"]).reshape(value[b"shape"])


def infer(observation: dict[str, Any]) -> np.ndarray[Any, Any]:
    assert set(observation) == {*SHAPES, "prompt"}, sorted(observation)
    for name, shape in SHAPES.items():
        assert observation[name].shape == shape, (name, observation[name].shape)
        wanted = np.uint8 if "image" in name else np.float32
        assert observation[name].dtype == wanted, (name, observation[name].dtype)
    moves = policy.actions(observation["prompt"])
    steps = np.cumsum(moves[:, 2:3] / policy.STEP_M, axis=0) * UP_RAD
    rows = np.tile(observation["observation/state"], (policy.HORIZON, 1)).astype(np.float32)
    rows[:, ARM] += steps.astype(np.float32)
    rows[:, ARM] += moves[:, :1]  # NaN, when it is asked for
    return rows[:, :30] if moves.shape[1] < 7 else rows


def process(operation: str, asked: dict[str, Any]) -> dict[str, Any]:
    envelope = {name: asked.get(name) for name in ("request_id", "session_id")}
    answer: dict[str, Any] = {"protocol_version": PROTOCOL, "operation": operation, **envelope}
    assert asked["protocol_version"] == PROTOCOL
    assert asked["operation"] == operation
    if asked["session_id"] != SESSION:
        error = {"code": "INVALID_REQUEST", "message": "session", "retryable": False}
        return {**answer, "error": error}
    if operation == "metadata":
        said = {"action_type": "absolute_joint_position", "action_units": "radians"}
        shape = {"action_dim": DIM, "action_horizon": policy.HORIZON, "joint_names": NAMES}
        return {**answer, "metadata": {"protocol_version": "origami-v1", **said, **shape}}
    if operation == "reset":
        return {**answer, "ok": True}
    try:
        return {
            **answer,
            "actions": infer(asked["observation"]),
            "server_timing": {"infer_ms": 1.0},
        }
    except Exception as failed:  # any fault of a request is its answer
        error = {"code": "INFERENCE_FAILED", "message": repr(failed), "retryable": False}
        return {**answer, "error": error}


def main(port: int, variant: str) -> None:
    config = zenoh.Config()
    config.insert_json5("mode", '"client"')
    config.insert_json5("connect/endpoints", f'["tcp/127.0.0.1:{port}"]')
    config.insert_json5("scouting/multicast/enabled", "false")
    config.insert_json5("transport/shared_memory/enabled", "false")

    def handle(query: zenoh.Query) -> None:
        with query:
            operation = str(query.key_expr).rsplit("/", 1)[-1]
            assert query.payload is not None
            asked = msgpack.unpackb(query.payload.to_bytes(), object_hook=back)
            answer = process(operation, asked)
            if variant == "other":
                answer["request_id"] = "another"
            packed = msgpack.packb(answer, default=out)
            assert packed is not None
            query.reply(query.key_expr, packed, encoding=zenoh.Encoding("application/msgpack"))

    with zenoh.open(config) as session:
        for operation in ("metadata", "reset", "infer"):
            session.declare_queryable(f"{PROTOCOL}/{operation}", handle, complete=True)
        threading.Event().wait()


if __name__ == "__main__":
    told = policy.arguments()
    main(told.port, told.variant)
