"""Inputs and outputs of one tick of the `Commander`, and the events in them."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

from vla_zenoh.control.chunk_validation import Rejection
from vla_zenoh.control.limits import APPROACH, LimitHit
from vla_zenoh.control.preflight import PeerSnapshot
from vla_zenoh.types import (
    MAX_TEXT,
    ActionChunk,
    Cause,
    Event,
    GripperCommand,
    GripperState,
    JointCommand,
    JointState,
    PoseCommand,
    PoseState,
    Stamped,
)


class Setting(NamedTuple):
    """A setting received from a client, or a loss found by the command node itself.

    Args:
        name: prompt, active, worker, rate, speed, slower, stop, reset or lose.
        value: of ``active`` a text is the name of the deadman, the client that holds the arm
            active.
        put_ns: when it was put, by the router's clock; None: unknown.
    """

    name: str
    value: str | bool | float | None = None
    put_ns: int | None = None


@dataclass(slots=True)
class Inputs:
    """Everything received since the last tick, oldest first.

    Args:
        settings: in the order they were put.
        chunks: of all workers.
        pose: newest TCP pose, None: none since the last tick.
        gripper: newest gripper state, None: none since.
        peers: the other nodes; None: unchanged.
        joint: newest joints, None: none since, or none were decoded.
    """

    settings: Sequence[Setting] = ()
    chunks: Sequence[Stamped[ActionChunk]] = ()
    pose: Stamped[PoseState] | None = None
    gripper: Stamped[GripperState] | None = None
    peers: PeerSnapshot | None = None
    joint: Stamped[JointState] | None = None


@dataclass(slots=True)
class Outputs:
    """Everything to publish after a tick.

    Args:
        pose: None while nothing is streamed, or where joints are commanded.
        joint: None while nothing is streamed, or where poses are commanded.
        gripper: None unless there is a new width to command.
        task_changed: `Commander.task` differs from that of the last tick.
        events: in the order they happened.
        rejections: of chunks and settings; the caller counts them by reason.
        accepted: the chunk whose plan came into force with this tick, for latencies.
    """

    pose: PoseCommand | None = None
    joint: JointCommand | None = None
    gripper: GripperCommand | None = None
    task_changed: bool = False
    events: list[Event] = field(default_factory=list)
    rejections: list[Rejection] = field(default_factory=list)
    accepted: Cause | None = None


def make_event(
    level: str,
    kind: str,
    what: str,
    why: str,
    value: float | None = None,
    limit: float | None = None,
) -> Event:
    """An event whose text fits into its record; a value that is not finite is left out."""
    if value is not None and not math.isfinite(value):
        value = None
    return Event(level, kind, what, why[:MAX_TEXT], value, limit)


def limit_events(hits: Iterable[LimitHit]) -> list[Event]:
    """Events for the limits that acted on the steps of a chunk, see `ChunkPlanner`."""
    events: list[Event] = []
    for hit in hits:
        level, why = "warning", f"shortened{hit.at}"
        if hit.name == APPROACH:
            level = "info"
            why = f"target {hit.value:.3g} {hit.where} away, over a step: approached slowly"
        events.append(make_event(level, "limit", hit.name, why, hit.value, hit.limit))
    return events
