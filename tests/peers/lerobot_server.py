"""A policy server as lerobot's, written after its ``async_inference/policy_server.py`` of 0.6.1.

It reads and writes with Python's own pickle. lerobot and torch are not here: classes with their
names stand in for them, and a tensor is written as torch writes one. The real server is asked by
tests/models/lerobot_server. Variants: ``pickle`` (answers with a pickle that runs code), ``other``
(with the numbers of another observation), ``slow`` (loads for some seconds).
"""

from __future__ import annotations

import io
import os
import pickle
import struct
import sys
import threading
import time
import types
from collections import OrderedDict
from concurrent import futures
from dataclasses import dataclass, field
from queue import Empty, Queue
from typing import Any

import grpc
import numpy as np
import policy

HELPERS = "lerobot.async_inference.helpers"
WAIT_S, LOAD_S = 2.0, 2.5


# -- stand-ins, named as those of lerobot and torch -----------------------------------------------
@dataclass
class TimedObservation:
    timestamp: float
    timestep: int
    observation: dict[str, Any]
    must_go: bool = False


@dataclass
class TimedAction:
    timestamp: float
    timestep: int
    action: Any


@dataclass
class RemotePolicyConfig:
    policy_type: str
    pretrained_name_or_path: str
    lerobot_features: dict[str, Any]
    actions_per_chunk: int
    device: str = "cpu"
    rename_map: dict[str, str] = field(default_factory=dict)


class FloatStorage:
    pass


def _load_from_bytes(data: bytes) -> Any:
    raise AssertionError("only its name is written")


def _rebuild_tensor_v2(*arguments: Any) -> Any:
    raise AssertionError("only its name is written")


def stand_in() -> None:
    """Let pickle find them under their names."""
    for name, parts in {
        HELPERS: (TimedObservation, TimedAction, RemotePolicyConfig),
        "torch": (FloatStorage,),
        "torch._utils": (_rebuild_tensor_v2,),
        "torch.storage": (_load_from_bytes,),
    }.items():
        for depth in range(1, name.count(".") + 2):
            outer = ".".join(name.split(".")[:depth])
            sys.modules.setdefault(outer, types.ModuleType(outer))
        for part in parts:
            part.__module__ = name
            setattr(sys.modules[name], part.__name__, part)


class Storage:
    """As torch pickles one: a file of the old form, in bytes."""

    def __init__(self, numbers: np.ndarray[Any, Any]) -> None:
        self.numbers = np.ascontiguousarray(numbers, "<f4").ravel()

    def __reduce__(self) -> Any:
        out, key = io.BytesIO(), str(id(self))
        info = {"protocol_version": 1001, "little_endian": True, "type_sizes": {"int": 4}}
        for head in (0x1950A86A20F9469CFC6C, 1001, info):
            pickle.dump(head, out, 2)

        class Pickler(pickle.Pickler):
            def persistent_id(self, found: Any) -> Any:
                if not isinstance(found, Storage):
                    return None
                return "storage", FloatStorage, key, "cpu", len(found.numbers), None

        Pickler(out, 2).dump(self)
        pickle.dump([key], out, 2)
        out.write(struct.pack("<q", len(self.numbers)) + self.numbers.tobytes())
        return _load_from_bytes, (out.getvalue(),)


class Tensor:
    """A row of a chunk: its storage is that of the whole."""

    def __init__(self, chunk: np.ndarray[Any, Any], row: int) -> None:
        self.chunk, self.row = chunk, row

    def __reduce__(self) -> Any:
        width = self.chunk.shape[1]
        parts = (Storage(self.chunk), self.row * width, (width,), (1,), False, OrderedDict())
        return _rebuild_tensor_v2, parts


class Bad:
    def __reduce__(self) -> Any:
        return os.system, ("echo the pickle has run",)


# -- the server -----------------------------------------------------------------------------------
def read_fields(data: bytes) -> dict[int, Any]:
    """Numbers and bytes of a protobuf message."""

    def varint(at: int) -> tuple[int, int]:
        value = shift = 0
        while True:
            byte, at = data[at], at + 1
            value |= (byte & 0x7F) << shift
            shift += 7
            if byte < 0x80:
                return value, at

    out: dict[int, Any] = {}
    at = 0
    while at < len(data):
        tag, at = varint(at)
        value, at = varint(at)
        if tag & 7 == 2:
            value, at = data[at : at + value], at + value
        out[tag >> 3] = value
    return out


class Server:
    def __init__(self, variant: str) -> None:
        self.variant = variant
        self.queue: Queue[TimedObservation] = Queue(1)
        self.config: RemotePolicyConfig | None = None

    def ready(self, request: bytes, context: Any) -> bytes:
        self.queue = Queue(1)
        return b""

    def instructions(self, request: bytes, context: Any) -> bytes:
        config = pickle.loads(read_fields(request)[1])
        assert isinstance(config, RemotePolicyConfig), config
        if config.pretrained_name_or_path == "nowhere":
            raise FileNotFoundError("no such policy: nowhere")
        if self.variant == "slow":
            time.sleep(LOAD_S)
        self.config = config
        return b""

    def observations(self, parts: Any, context: Any) -> bytes:
        data = b""
        for part in parts:
            found = read_fields(part)
            assert len(found[2]) <= 2 * 1024 * 1024
            data += found[2]
            if found[1] == 3:
                break
        seen = pickle.loads(data)
        assert isinstance(seen, TimedObservation)
        assert seen.must_go
        if self.queue.full():
            self.queue.get_nowait()
        self.queue.put(seen)
        return b""

    def actions(self, request: bytes, context: Any) -> bytes:
        try:
            data = pickle.dumps(self.infer(self.queue.get(timeout=WAIT_S)))
        except Empty:
            return b""
        except Exception as error:  # as published: into the log, and an empty answer
            print(f"Error in StreamActions: {error!r}", file=sys.stderr)
            return b""
        size, left = b"", len(data)
        while left > 0x7F:
            size, left = size + bytes([left & 0x7F | 0x80]), left >> 7
        return b"\x0a" + size + bytes([left]) + data

    def infer(self, seen: TimedObservation) -> Any:
        if self.variant == "pickle":
            return [Bad()]
        assert self.config is not None
        given = seen.observation
        for name, feature in self.config.lerobot_features.items():
            if feature["dtype"] == "image":
                picture = given[name.removeprefix("observation.images.")]
                assert (picture.dtype, picture.ndim, picture.shape[2]) == (np.uint8, 3, 3)
            else:
                state = np.array([given[part] for part in feature["names"]], np.float32)
                assert state.shape == feature["shape"] == (8,), state
        chunk = policy.actions(given["task"])[: self.config.actions_per_chunk]
        first = seen.timestep + (self.variant == "other")
        return [
            TimedAction(seen.timestamp + index / 30, first + index, Tensor(chunk, index))
            for index in range(len(chunk))
        ]


def main(port: int, variant: str) -> None:
    stand_in()
    asked = Server(variant)
    unary, stream = grpc.unary_unary_rpc_method_handler, grpc.stream_unary_rpc_method_handler
    methods = {
        "Ready": unary(asked.ready),
        "SendPolicyInstructions": unary(asked.instructions),
        "SendObservations": stream(asked.observations),
        "GetActions": unary(asked.actions),
    }
    running = grpc.server(futures.ThreadPoolExecutor(max_workers=4))
    service = grpc.method_handlers_generic_handler("transport.AsyncInference", methods)
    running.add_generic_rpc_handlers((service,))
    running.add_insecure_port(f"127.0.0.1:{port}")
    running.start()
    threading.Event().wait()


if __name__ == "__main__":
    told = policy.arguments()
    main(told.port, told.variant)
