"""Delays, messages and trace of a lockstep run."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

from vla_zenoh.control.commander_io import MotionCommands
from vla_zenoh.types import FloatArray, Header, JointCommand, PoseCommand


@dataclass(frozen=True, slots=True)
class Delays:
    """Latencies of a lockstep run.

    Args:
        inference_s: from observation to chunk.
        jitter: share by which an inference varies.
        camera_s: from capture to the worker.
        camera_hz: images per second.
        wire_s: of every other message.
    """

    inference_s: float = 0.0
    jitter: float = 0.0
    camera_s: float = 0.0
    camera_hz: float = 30.0
    wire_s: float = 0.0


@dataclass(frozen=True, slots=True)
class Message:
    """One message on the wire.

    Args:
        kind: class of the record.
        header: of the writer.
        payload: encoded record.
        arrival_ns: virtual time of arrival.
        part: whose state or command it is, of a robot of several parts.
    """

    kind: type[Any]
    header: Header
    payload: bytes
    arrival_ns: int
    part: str = ""


Tamper = Callable[[Message], Iterable[Message]]
"""Replaces a message by any number of messages."""


@dataclass(slots=True)
class LockstepTrace:
    """Commanded and measured motion, one entry per command tick.

    Args:
        time_ns: (n,) virtual wall clock.
        commands: pose commands; None: no stream.
        joints: joint commands; None: no stream.
        position_m: measured TCP, (3,) each.
        rotation: measured TCP, (3, 3) each.
        width_m: measured gripper width.
        parts: commands to each part, of a robot of several; what is above is of the first part.
    """

    time_ns: list[int] = field(default_factory=list)
    commands: list[PoseCommand | None] = field(default_factory=list)
    joints: list[JointCommand | None] = field(default_factory=list)
    position_m: list[FloatArray] = field(default_factory=list)
    rotation: list[FloatArray] = field(default_factory=list)
    width_m: list[float] = field(default_factory=list)
    parts: list[Mapping[str, MotionCommands]] = field(default_factory=list)
