"""A policy server as GR00T serves, written after its published server.

Variants: ``n1.5`` and ``n1.6`` (shape of questions and answers), ``pickle`` (answers as the first
servers did, in pickles).
"""

from __future__ import annotations

import io
import json
import pickle
from typing import Any

import msgpack
import numpy as np
import policy
import zmq

NAMES = ("x", "y", "z", "roll", "pitch", "yaw", "gripper")
PROMPT = "annotation.human.action.task_description"
TOKEN = "open sesame"


def encode(value: Any, old: bool) -> Any:
    if isinstance(value, np.ndarray):
        out = io.BytesIO()
        np.save(out, value, allow_pickle=False)
        return {"__ndarray_class__": True, "as_npy": out.getvalue()}
    assert isinstance(value, Modality)
    described = json.dumps(value.fields) if old else value.fields
    return {"__ModalityConfig_class__": True, "as_json": described}


def decode(value: dict[Any, Any]) -> Any:
    if "__ndarray_class__" in value:
        return np.load(io.BytesIO(value["as_npy"]), allow_pickle=False)
    return value


class Modality:
    def __init__(self, keys: list[str], times: int = 1) -> None:
        self.fields = {"delta_indices": list(range(times)), "modality_keys": keys}


def modalities(old: bool) -> dict[str, Modality]:
    def named(kind: str, keys: tuple[str, ...]) -> list[str]:
        return [f"{kind}.{key}" if old else key for key in keys]

    return {
        "video": Modality(named("video", ("image",))),
        "state": Modality(named("state", NAMES)),
        "action": Modality(named("action", NAMES), policy.HORIZON),
        "language": Modality([PROMPT]),
    }


def answer_n15(data: dict[str, Any]) -> Any:
    image, grip = data["video.image"], data["state.gripper"]
    assert (image.dtype, image.ndim) == (np.uint8, 4), image.shape
    assert (grip.dtype, grip.shape) == (np.float32, (1, 2)), grip.shape
    rows = policy.actions(data[PROMPT][0])
    return {f"action.{name}": rows[:, index : index + 1] for index, name in zip_rows(rows)}


def answer_n16(observation: dict[str, Any], options: Any) -> Any:
    image, grip = observation["video"]["image"], observation["state"]["gripper"]
    assert options is None
    assert (image.dtype, image.ndim) == (np.uint8, 5), image.shape
    assert (grip.dtype, grip.shape) == (np.float32, (1, 1, 2)), grip.shape
    rows = policy.actions(observation["language"][PROMPT][0][0])[None]
    return [{name: rows[:, :, index : index + 1] for index, name in zip_rows(rows)}, {}]


def zip_rows(rows: np.ndarray[Any, Any]) -> list[tuple[int, str]]:
    return [(index, NAMES[index]) for index in range(rows.shape[-1])]


def handle(request: dict[str, Any], variant: str) -> Any:
    old = variant == "n1.5"
    if request.get("api_token") not in (None, TOKEN):
        return {"error": "Unauthorized: Invalid API token"}
    endpoint = request.get("endpoint", "get_action")
    if endpoint == "ping":
        return {"status": "ok", "message": "Server is running"}
    if endpoint == "get_modality_config":
        return modalities(old)
    if endpoint == "reset" and not old:
        return {"options": request["data"]["options"]}
    if endpoint != "get_action":
        raise ValueError(f"Unknown endpoint: {endpoint}")
    return answer_n15(request["data"]) if old else answer_n16(**request["data"])


def main(port: int, variant: str) -> None:
    socket = zmq.Context().socket(zmq.REP)
    socket.bind(f"tcp://127.0.0.1:{port}")
    while True:
        try:
            request = msgpack.unpackb(socket.recv(), object_hook=decode)
            answer = handle(request, variant)
            if variant == "pickle":
                socket.send(pickle.dumps({"action.x": np.zeros(4)}))
                continue
            packed = msgpack.packb(answer, default=lambda value: encode(value, variant == "n1.5"))
            assert packed is not None
            socket.send(packed)
        except Exception as error:  # any fault of a request is its answer
            failed = msgpack.packb({"error": str(error)})
            assert failed is not None
            socket.send(failed)


if __name__ == "__main__":
    told = policy.arguments()
    main(told.port, told.variant or "n1.6")
