"""What takes how long in lockstep, what is on its wire, and what is kept of a run."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import Any

from vla_zenoh.types import FloatArray, Header, JointCommand, PoseCommand


@dataclass(frozen=True, slots=True)
class Delays:
    """What takes how long.

    Args:
        inference_s: from observation to chunk.
        jitter: share by which an inference varies, either way.
        camera_s: from capture to the worker.
        camera_hz: pictures per second.
        wire_s: everything else on its way.
    """

    inference_s: float = 0.0
    jitter: float = 0.0
    camera_s: float = 0.0
    camera_hz: float = 30.0
    wire_s: float = 0.0


@dataclass(frozen=True, slots=True)
class Message:
    """One record on the wire.

    Args:
        kind: class of the record.
        header: what its writer says of it.
        payload: the record as bytes.
        arrival_ns: virtual time at which it arrives.
    """

    kind: type[Any]
    header: Header
    payload: bytes
    arrival_ns: int


Tamper = Callable[[Message], Iterable[Message]]
"""What arrives in place of a message: nothing, itself, several, others."""


@dataclass(slots=True)
class LockstepTrace:
    """What was commanded and where the TCP was, one entry per command tick.

    Args:
        time_ns: (n,) virtual wall clock.
        commands: the pose commands; None where nothing was streamed.
        joints: likewise the joint commands.
        position_m: measured TCP, (3,) each.
        rotation: measured TCP, (3, 3) each.
        width_m: measured opening.
    """

    time_ns: list[int] = field(default_factory=list)
    commands: list[PoseCommand | None] = field(default_factory=list)
    joints: list[JointCommand | None] = field(default_factory=list)
    position_m: list[FloatArray] = field(default_factory=list)
    rotation: list[FloatArray] = field(default_factory=list)
    width_m: list[float] = field(default_factory=list)
