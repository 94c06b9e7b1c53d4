"""What ``benchmarks codec`` measures: the wire forms of images, states and commands."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from vla_zenoh_ros2.messages import Messages
from vla_zenoh_ros2.readers import READERS, read
from vla_zenoh_ros2.writers import POSE_STAMPED, Stamp, header, pose_writer

from benchmarks.codec.other_cdr import MODULES, OtherCdr
from vla_zenoh.codec import records
from vla_zenoh.codec.image import decode_jpeg, decode_raw, encode_jpeg, encode_raw, raw_schema
from vla_zenoh.types import ActionChunk, Image, JointState, PoseCommand

HEIGHT, WIDTH = 480, 640
ARM = 7
JOINTS = tuple(f"panda_joint{index}" for index in range(1, ARM + 1))
GOAL = "multi_mode_control_msgs/msg/CartesianImpedanceGoal"
_POSE = PoseCommand(
    np.array([0.43, 0.0, 0.16]),
    np.array([1.0, 0.0, 0.0, 0.0]),
    np.zeros(6),
    np.zeros(6),
    np.array([0.43, 0.0, 0.16]),
    np.array([1.0, 0.0, 0.0, 0.0]),
    "active",
)


@dataclass(frozen=True, slots=True)
class Case:
    """One thing to encode and decode.

    Args:
        name: for the table.
        payload_bytes: size on the wire.
        encode: makes the bytes; for ROS, from an existing message.
        decode: reads them; for ROS topics that we read, to the sample we use.
        others: library -> (encode, decode) of the same bytes.
    """

    name: str
    payload_bytes: int
    encode: Callable[[], Any]
    decode: Callable[[], Any]
    others: dict[str, tuple[Callable[[], Any], Callable[[], Any]]] = field(default_factory=dict)


def cases(distribution: str = "jazzy") -> list[Case]:
    """All of them; libraries that are not installed are left out."""
    messages = Messages(distribution)
    others = []
    for library in MODULES:
        try:
            others.append((library, OtherCdr(library, messages)))
        except ImportError:
            continue
    picture = np.random.default_rng(0).integers(0, 255, (HEIGHT, WIDTH, 3), np.uint8)
    smooth = np.tile(np.arange(WIDTH, dtype=np.uint8)[None, :, None], (HEIGHT, 1, 3))
    stamp = Stamp(1_700_000_000_000_000_000, "panda_link0")
    pictures = {
        "height": HEIGHT,
        "width": WIDTH,
        "step": 3 * WIDTH,
        "data": picture.ravel(),
        "header": header(messages, stamp),
    }
    states = {
        "header": header(messages, stamp),
        "name": list(JOINTS),
        "position": np.zeros(ARM),
        "velocity": np.zeros(ARM),
        "effort": np.zeros(ARM),
    }
    ros = (
        ("Image rgb8 640x480", messages.new("sensor_msgs/msg/Image", encoding="rgb8", **pictures)),
        ("Image bgr8 640x480", messages.new("sensor_msgs/msg/Image", encoding="bgr8", **pictures)),
        ("JointState", messages.new("sensor_msgs/msg/JointState", **states)),
        *(
            (name, pose_writer(messages, kind, np.zeros(ARM))(_POSE, stamp))
            for name, kind in (("PoseStamped", POSE_STAMPED), ("CartesianImpedanceGoal", GOAL))
        ),
    )
    return [*_own(picture, smooth), *(_ros(name, m, messages, others) for name, m in ros)]


def _own(picture: Any, smooth: Any) -> list[Case]:
    raw, jpeg = Image(picture), Image(smooth)
    raw_bytes, jpeg_bytes, schema = encode_raw(raw), encode_jpeg(jpeg), raw_schema(raw)
    zeros = np.zeros(ARM)
    chunk = ActionChunk("w", "h", 1, 2, 3, 4, np.zeros((8, ARM), np.float32), 5, 6, 7)
    state = JointState(JOINTS, zeros, zeros, zeros)
    return [
        Case(
            "our raw picture 640x480",
            len(raw_bytes),
            lambda: encode_raw(raw),
            lambda: decode_raw(raw_bytes, schema),
        ),
        Case(
            "our JPEG 640x480 (smooth)",
            len(jpeg_bytes),
            lambda: encode_jpeg(jpeg),
            lambda: decode_jpeg(jpeg_bytes),
        ),
        *(_record(record) for record in (state, _POSE, chunk)),
    ]


def _record(record: Any) -> Case:
    payload = records.encode(record)
    return Case(
        f"our {type(record).__name__}",
        len(payload),
        lambda: records.encode(record),
        lambda: records.decode(type(record), payload),
    )


def _ros(name: str, message: Any, messages: Messages, others: list[tuple[str, OtherCdr]]) -> Case:
    kind, payload = message.__msgtype__, messages.encode(message)

    def decode() -> Any:
        return (read if kind in READERS else Messages.decode)(messages, kind, payload)

    return Case(
        f"ROS {name}",
        len(payload),
        lambda: messages.encode(message),
        decode,
        {library: _other(other, message, kind, payload) for library, other in others},
    )


def _other(
    other: OtherCdr, message: Any, kind: str, payload: bytes
) -> tuple[Callable[[], Any], Callable[[], Any]]:
    theirs = other.of(message)
    return lambda: other.encode(theirs), lambda: other.decode(kind, payload)
