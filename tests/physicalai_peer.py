"""An owner and a client of a robot on the wire of Intel's physicalai, written by hand in msgpack.

They share nothing with the package that speaks to them but the libraries.
"""

from __future__ import annotations

import json
import threading
import time
from typing import Any, Self

import msgpack
import numpy as np
import zenoh

SO101 = ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll", "gripper")
PORT_OF_ARM_2, PORT_OF_ARM_3 = 23_064, 25_196
"""Of the robots ``arm_2`` and ``arm_3``: Linux gives ports this low to nobody who does not ask."""


def packed(values: Any, dtype: str = "float32") -> dict[str, Any]:
    """An array as it travels."""
    array = np.asarray(values, dtype)
    return {"__np__": True, "dtype": dtype, "shape": list(array.shape), "data": array.tobytes()}


def unpacked(array: dict[str, Any]) -> np.ndarray:
    return np.frombuffer(array["data"], array["dtype"]).reshape(array["shape"])


def opened(**settings: Any) -> zenoh.Session:
    config = zenoh.Config()
    quiet = {"scouting/multicast/enabled": False, "scouting/gossip/enabled": False}
    for name, value in (settings | quiet).items():
        config.insert_json5(name.replace("__", "/"), json.dumps(value))
    return zenoh.open(config)


class Owner:
    """Owns a robot that is at once where an action puts it; publishes its state at 100 Hz.

    What `said` has replaces fields of each state, `metadata` those of the reply; None removes one.
    """

    def __init__(self, name: str, port: int = PORT_OF_ARM_2, **metadata: Any) -> None:
        self.name, self.key = name, f"physicalai/robot/{name}"
        self.at = np.array([0.0, -20.0, 20.0, 10.0, 0.0, 30.0])
        self.said: dict[str, Any] = {}
        self.actions: list[dict[str, Any]] = []
        self.session = opened(mode="peer", listen__endpoints=[f"tcp/127.0.0.1:{port}"])
        told = {
            "protocol_version": 1,
            "name": name,
            "robot_class": "physicalai.robot.SO101",
            "host": "here",
            "joint_names": SO101,
            "num_joints": 6,
            "state_dim": 6,
            "device_ids": ["serial:ttyACM0"],
            **metadata,
        }
        reply = msgpack.packb({key: value for key, value in told.items() if value is not None})
        key = f"{self.key}/metadata"
        self._metadata = self.session.declare_queryable(key, lambda query: query.reply(key, reply))
        self._actions = self.session.declare_subscriber(f"{self.key}/action", self._act)
        self._states = self.session.declare_publisher(f"{self.key}/state")
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def _act(self, sample: zenoh.Sample) -> None:
        action = msgpack.unpackb(sample.payload.to_bytes())
        self.actions.append(action)
        self.at = unpacked(action["action"])

    def _run(self) -> None:
        while not self._stop.wait(0.01):
            state = {
                "joint_positions": packed(self.at),
                "state": packed(self.at),
                "timestamp": time.monotonic(),
                "sensor_data": {"velocities": packed(np.zeros(6))},
                **self.said,
            }
            whole = {key: value for key, value in state.items() if value is not None}
            self._states.put(msgpack.packb(whole))

    def close(self) -> None:
        if not self._stop.is_set():
            self._stop.set()
            self._thread.join()
            self.session.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


class Client:
    """A client of a robot at `port` of this computer, as a peer, as physicalai's are."""

    def __init__(self, name: str, port: int) -> None:
        self.key = f"physicalai/robot/{name}"
        self.session = opened(mode="peer", connect__endpoints=[f"tcp/127.0.0.1:{port}"])
        self.states = self.session.declare_subscriber(
            f"{self.key}/state", zenoh.handlers.RingChannel(1)
        )
        self._actions = self.session.declare_publisher(f"{self.key}/action")

    def metadata(self) -> dict[str, Any]:
        for reply in self.session.get(f"{self.key}/metadata", timeout=2.0):
            if reply.ok is not None:
                return msgpack.unpackb(reply.ok.payload.to_bytes())
        raise AssertionError("nobody replied")

    def act(self, values: Any, **said: Any) -> None:
        action = {"action": packed(values, "float64"), "goal_time": 0.1, "ts": time.monotonic()}
        self._actions.put(msgpack.packb(action | said))
