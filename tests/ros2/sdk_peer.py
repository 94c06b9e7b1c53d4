"""A ROS 2 node made of the package zenoh-ros2-sdk, run in an environment of its own.

    python sdk_peer.py PORT

It knows nothing of ours. Lines of JSON on stdin tell it what to do, lines on stdout say what it
heard: ``{"got": topic, "fields": ...}``, ``{"asked": service, "fields": ...}`` and answers.
"""

from __future__ import annotations

import dataclasses
import json
import os
import sys
import threading
from typing import Any

import numpy as np
from rosbags.typesys import Stores, get_typestore
from zenoh_ros2_sdk import ROS2Publisher, ROS2ServiceClient, ROS2ServiceServer, ROS2Subscriber

STORE = get_typestore(Stores.ROS2_JAZZY)
SERVICES = {
    "std_srvs/srv/SetBool": ("bool data\n", "bool success\nstring message\n"),
}
_out = threading.Lock()


def say(**words: Any) -> None:
    with _out:
        print(json.dumps(words), flush=True)


def plain(value: Any) -> Any:
    if dataclasses.is_dataclass(value):
        return {f.name: plain(getattr(value, f.name)) for f in dataclasses.fields(value)}
    if isinstance(value, np.ndarray):
        return value.tolist()
    if isinstance(value, (list, tuple)):
        return [plain(item) for item in value]
    return value


def made(store: Any, kind: str, fields: dict[str, Any]) -> dict[str, Any]:
    """Fields as the SDK wants them: messages for maps, arrays for lists of numbers."""
    described = dict(STORE.fielddefs[kind][1])
    out = {}
    for name, value in fields.items():
        if isinstance(value, dict):
            inner = described[name][1]
            out[name] = store.types[inner](**made(store, inner, value))
        elif isinstance(value, list) and not (value and isinstance(value[0], str)):
            dtype = described[name][1][0][1][0]
            out[name] = np.array(value, np.dtype(dtype))
        else:
            out[name] = value
    return out


class Peer:
    def __init__(self, port: int) -> None:
        self._at = {"router_port": port, "node_name": "sdk_peer"}
        self._ends: dict[tuple[str, str], Any] = {}

    def _topic(self, kind: str) -> dict[str, Any]:
        if kind == "std_msgs/msg/String":  # a hash that the SDK computes by itself
            return {"msg_definition": "string data\n"}
        return {
            "msg_definition": STORE.generate_msgdef(kind)[0],
            "type_hash": STORE.hash_rihs01(kind),
        }

    def subscribe(self, name: str, kind: str) -> None:
        def heard(message: Any) -> None:
            say(got=name, fields=plain(message))

        end = ROS2Subscriber(name, kind, heard, **self._at, **self._topic(kind))
        self._ends["subscribe", name] = end

    def advertise(self, name: str, kind: str) -> None:
        end = ROS2Publisher(name, kind, **self._at, **self._topic(kind))
        self._ends["publish", name] = end
        say(hash=end.type_hash, of=kind)

    def publish(self, name: str, kind: str, fields: dict[str, Any]) -> None:
        end = self._ends["publish", name]
        end.publish(**made(end.session_mgr.store, kind, fields))

    def serve(self, name: str, kind: str) -> None:
        request, response = SERVICES[kind]

        def answer(asked: Any) -> Any:
            say(asked=name, fields=plain(asked))
            return server.response_msg_class(success=True, message="by the SDK")

        server = ROS2ServiceServer(
            name,
            kind,
            answer,
            request_definition=request,
            response_definition=response,
            **self._at,
        )
        self._ends["serve", name] = server
        say(hash=server.type_hash, of=kind)

    def call(self, name: str, kind: str, fields: dict[str, Any]) -> None:
        request, response = SERVICES[kind]
        client = ROS2ServiceClient(
            name,
            kind,
            request_definition=request,
            response_definition=response,
            timeout=5.0,
            **self._at,
        )
        self._ends["call", name] = client
        answer = client.call(**fields)
        say(answered=name, fields=None if answer is None else plain(answer))


def main() -> None:
    peer = Peer(int(sys.argv[1]))
    say(ready=True)
    for line in sys.stdin:
        order = json.loads(line)
        getattr(peer, order.pop("do"))(**order)
        say(done=True)
    os._exit(0)  # the SDK's threads do not end by themselves


if __name__ == "__main__":
    main()
