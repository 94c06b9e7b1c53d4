"""The wire of franka-node 0.4: keys and records of one arm, little endian, without padding."""

from __future__ import annotations

import json
import math
import struct
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

import numpy as np

from vla_zenoh.errors import CodecError
from vla_zenoh.types import FloatArray

VERSION = 1
MAX_BYTES = 1 << 16
Kind = Literal["cartesian", "joints"]
KINDS = {"cartesian": 1, "joints": 2}
WIDTH, GRASP = 1, 2
PHASES = ("idle", "acquired", "active", "stopping", "faulted", "homing")
ROBOT_MODES = (
    "other",
    "idle",
    "move",
    "guiding",
    "reflex",
    "user_stopped",
    "automatic_error_recovery",
)
HOLDING = 1
"""Flag of a state: no target was accepted for the node's hold_after_ms."""
GRASPED, MOVING, FAULT = 2, 4, 8
"""Flags of a gripper's state."""
TARGET = struct.Struct("<BBHIQQ7d")
STATE = struct.Struct("<BBBBHIQQQQd7d7d7d16d6d7dQQQ")
GRIPPER = struct.Struct("<BBHIQQdd")
GRIPPER_STATE = struct.Struct("<BBHIQddd")


@dataclass(frozen=True, slots=True)
class State:
    """What the node publishes about an arm 100 times a second.

    Args:
        phase: one of `PHASES`.
        robot_mode: one of `ROBOT_MODES`.
        has_errors: the robot names errors.
        holding: no target was accepted for hold_after_ms.
        holder: the client that has the lease; 0: nobody.
        robot_time_ms: the robot's clock at the measurement.
        success_rate: the robot's control_command_success_rate.
        position_rad: (7,)
        velocity_rad_s: (7,)
        effort_nm: (7,) external torques.
        ee: (4, 4) pose of the end effector that is set in Desk, in the base frame.
        wrench: (6,) O_F_ext_hat_K.
        target: (7,) last accepted: position and quaternion xyzw, or joints.
        accepted: targets since the session began.
        refused: the same.
        dropped: the same.
    """

    phase: str
    robot_mode: str
    has_errors: bool
    holding: bool
    holder: int
    robot_time_ms: int
    success_rate: float
    position_rad: FloatArray
    velocity_rad_s: FloatArray
    effort_nm: FloatArray
    ee: FloatArray
    wrench: FloatArray
    target: FloatArray
    accepted: int
    refused: int
    dropped: int


class HandState(NamedTuple):
    """What the node publishes about a gripper 20 times a second."""

    width_m: float
    grasped: bool
    moving: bool
    fault: bool


def key(arm: str, what: str) -> str:
    """The key `what` of an arm."""
    return f"franka/{arm}/{what}"


def encode_target(kind: Kind, client_id: int, seq: int, sent_ns: int, values: FloatArray) -> bytes:
    """A target: position (m) and quaternion xyzw, or joints (rad); (7,)."""
    return TARGET.pack(VERSION, KINDS[kind], 0, client_id, seq, sent_ns, *map(float, values))


def encode_gripper(
    kind: int, client_id: int, seq: int, sent_ns: int, width_m: float, force_n: float
) -> bytes:
    """A command of the gripper; `kind` is `WIDTH` or `GRASP`."""
    return GRIPPER.pack(VERSION, kind, 0, client_id, seq, sent_ns, width_m, force_n)


def encode_request(client_id: int, **fields: str) -> bytes:
    """What a verb of ``cmd/`` is asked with."""
    return json.dumps({"client_id": client_id, **fields}).encode()


def decode_state(data: bytes) -> State:
    """The state of an arm.

    Raises:
        CodecError: it has another size or version, or a number that is not finite.
    """
    _, phase, mode, errors, flags, holder, _, _, _, time_ms, rate, *rest = _unpacked(
        STATE, "state", data
    )
    *values, accepted, refused, dropped = rest
    numbers = np.array(values)
    if not (np.isfinite(numbers).all() and math.isfinite(rate)):
        raise CodecError("not_finite", "state: a number is not finite")
    return State(
        phase=_named("phase", PHASES, phase),
        robot_mode=_named("robot_mode", ROBOT_MODES, mode),
        has_errors=bool(errors),
        holding=bool(flags & HOLDING),
        holder=holder,
        robot_time_ms=time_ms,
        success_rate=rate,
        position_rad=numbers[:7],
        velocity_rad_s=numbers[7:14],
        effort_nm=numbers[14:21],
        ee=numbers[21:37].reshape(4, 4).T,
        wrench=numbers[37:43],
        target=numbers[43:50],
        accepted=accepted,
        refused=refused,
        dropped=dropped,
    )


def decode_gripper_state(data: bytes) -> HandState:
    """The state of a gripper.

    Raises:
        CodecError: it has another size or version, or a number that is not finite.
    """
    _, flags, _, _, _, width_m, _, _ = _unpacked(GRIPPER_STATE, "gripper/state", data)
    if not math.isfinite(width_m):
        raise CodecError("not_finite", f"gripper/state: width is {width_m}")
    return HandState(width_m, bool(flags & GRASPED), bool(flags & MOVING), bool(flags & FAULT))


def decode_reply(data: bytes) -> str:
    """Why a verb was refused; empty: it was not.

    Raises:
        CodecError: it is no reply of franka-node.
    """
    try:
        reply = json.loads(data)
        if reply["ok"] is True:
            return ""
        return str(reply["error"]) or "no reason given"
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        raise CodecError("decode", f"reply: {error!r}") from error


def _unpacked(layout: struct.Struct, name: str, data: bytes) -> tuple[Any, ...]:
    if len(data) != layout.size:
        raise CodecError("size", f"{name} has {len(data)} bytes, wanted {layout.size}")
    if data[0] != VERSION:
        raise CodecError("version", f"{name} has version {data[0]}, wanted {VERSION}")
    return layout.unpack(data)


def _named(what: str, names: tuple[str, ...], code: int) -> str:
    if code >= len(names):
        raise CodecError("range", f"{what} is {code}, allowed: 0 to {len(names) - 1}")
    return names[code]
