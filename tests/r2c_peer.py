"""A robot and a policy on the wire of Huawei's R2C, their protobuf written by hand.

They share nothing with the package that speaks to them but the libraries.
"""

from __future__ import annotations

import json
import struct
import time
from typing import Any

import cv2
import numpy as np
import zenoh

NAMES = ("joint_1", "joint_2", "joint_3", "joint_4", "joint_5", "joint_6")
DECLARED = """\
project: lab
device: so101
order: [joint_1, joint_2, joint_3, joint_4, joint_5, joint_6]
joints:
  joint_1: shoulder_pan
  joint_2: shoulder_lift
  joint_3: elbow_flex
  joint_4: wrist_flex
  joint_5: wrist_roll
unit: radians
gripper: {name: joint_6, shut: 0.0, open: 1.0}
cameras:
  front: {name: front, colours: rgb}
step_hz: 30
"""
"""An SO-101 as their dummy robot is one."""
OBSERVATIONS, ACTIONS = "lab/so101/inference/observations", "lab/so101/inference/actions"


# -- protobuf -------------------------------------------------------------------------------------
def varint(value: int) -> bytes:
    out = bytearray()
    while value > 0x7F:
        out.append(value & 0x7F | 0x80)
        value >>= 7
    out.append(value)
    return bytes(out)


def whole(field: int, value: int) -> bytes:
    return varint(field << 3) + varint(value)


def block(field: int, data: bytes | str) -> bytes:
    raw = data.encode() if isinstance(data, str) else data
    return varint(field << 3 | 2) + varint(len(raw)) + raw


def doubles(field: int, values: Any) -> bytes:
    return block(field, struct.pack(f"<{len(values)}d", *values))


def fields(data: bytes) -> list[tuple[int, Any]]:
    """Number and content of the fields of a message."""
    out, at = list[tuple[int, Any]](), 0

    def read() -> int:
        nonlocal at
        value = shift = 0
        while True:
            byte = data[at]
            at += 1
            value |= (byte & 0x7F) << shift
            shift += 7
            if byte < 0x80:
                return value

    while at < len(data):
        tag = read()
        assert tag & 7 in (0, 2), "a whole number or a block"
        value = read()
        if tag & 7 == 2:
            value, at = data[at : at + value], at + value
        out.append((tag >> 3, value))
    return out


# -- messages -------------------------------------------------------------------------------------
def jpeg(rgb: tuple[int, int, int] = (200, 40, 40)) -> bytes:
    image = np.full((48, 64, 3), rgb[::-1], np.uint8)
    return cv2.imencode(".jpg", image)[1].tobytes()


def now_ms() -> int:
    return time.time_ns() // 1_000_000


def observation(
    position: Any,
    *,
    id: int = 1,
    timestamp: int | None = None,
    task: str = "HARD: go up",
    names: tuple[str, ...] = NAMES,
    encoding: str = "raw",
    images: tuple[tuple[str, bytes], ...] = (("front", jpeg()),),
) -> bytes:
    joints = b"".join(block(1, name) for name in names) + doubles(2, position)
    pictures = b"".join(block(1, block(1, name) + block(2, file)) for name, file in images)
    return (
        whole(1, now_ms() if timestamp is None else timestamp)
        + block(2, task)
        + whole(3, id)
        + block(4, encoding)
        + block(5, pictures)
        + block(7, joints)
    )


def actions(
    rows: Any, *, id: int = 1, names: tuple[str, ...] = NAMES, chunk_size: int | None = None
) -> bytes:
    joints = b"".join(block(1, name) for name in names)
    joints += b"".join(block(2, doubles(1, row)) for row in rows)
    size = len(rows) if chunk_size is None else chunk_size
    return whole(1, now_ms()) + whole(2, id) + whole(3, size) + block(4, joints)


def read_actions(data: bytes) -> tuple[int, int, np.ndarray]:
    """Id, chunk size, and (H, n) positions of an answer."""
    found = dict(fields(data))
    steps = [value for number, value in fields(found[4]) if number == 2]
    rows = [np.frombuffer(dict(fields(step))[1], "<f8") for step in steps]
    return found[2], found[3], np.array(rows)


def read_observation(data: bytes) -> dict[str, Any]:
    found = dict(fields(data))
    joints = fields(found[7])
    images = [dict(fields(image)) for number, image in fields(found[5]) if number == 1]
    return {
        "timestamp": found[1],
        "task": found[2].decode(),
        "id": found[3],
        "encoding": found[4].decode(),
        "images": {image[1].decode(): image[2] for image in images},
        "names": [value.decode() for number, value in joints if number == 1],
        "position": np.frombuffer(dict(joints)[2], "<f8"),
    }


# -- on the bus -----------------------------------------------------------------------------------
def opened(port: int) -> zenoh.Session:
    config = zenoh.Config()
    settings = {"mode": "client", "connect/endpoints": [f"tcp/127.0.0.1:{port}"]}
    for name, value in settings.items():
        config.insert_json5(name, json.dumps(value))
    return zenoh.open(config)


class Robot:
    """A robot that asks, and keeps the answers."""

    def __init__(self, port: int) -> None:
        self.session = opened(port)
        self.answers: list[tuple[int, int, np.ndarray]] = []
        self.session.declare_subscriber(
            ACTIONS, lambda sample: self.answers.append(read_actions(sample.payload.to_bytes()))
        )

    def ask(self, payload: bytes) -> None:
        self.session.put(OBSERVATIONS, payload, congestion_control=zenoh.CongestionControl.BLOCK)


class Policy:
    """A policy that answers each observation with `reply(observation)`; None: not at all."""

    def __init__(self, port: int, reply: Any, of: str = "lab/so101") -> None:
        self.reply, self.seen = reply, list[dict[str, Any]]()
        self.session = opened(port)
        self._actions = f"{of}/inference/actions"
        self.session.declare_subscriber(f"{of}/inference/observations", self._answer)

    def _answer(self, sample: zenoh.Sample) -> None:
        asked = read_observation(sample.payload.to_bytes())
        self.seen.append(asked)
        answer = self.reply(asked)
        if answer is not None:
            self.session.put(self._actions, answer)
