"""What goes into a tick of the command node's mind, and what comes out of it."""

from __future__ import annotations

import math
from collections.abc import Sequence
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
    """Somebody put a setting. `name`: prompt, active, worker, rate, speed, slower, stop,
    reset or lose.

    Of ``active`` a text is the name of whoever holds the arm active.
    """

    name: str
    value: str | bool | float | None = None


@dataclass(slots=True)
class Inputs:
    """Everything that arrived since the last tick, oldest first.

    Args:
        settings: in the order they were put.
        chunks: of all workers.
        pose: newest TCP pose, or None when none came since.
        gripper: likewise.
        around: the nodes around; None: unchanged.
        joint: newest joints, or None when none came since, or none were looked at.
    """

    settings: Sequence[Setting] = ()
    chunks: Sequence[Stamped[ActionChunk]] = ()
    pose: Stamped[PoseState] | None = None
    gripper: Stamped[GripperState] | None = None
    peers: PeerSnapshot | None = None
    joint: Stamped[JointState] | None = None


@dataclass(slots=True)
class Outputs:
    """What to publish.

    Args:
        pose: None while nothing is streamed, or where joints are commanded.
        joint: None while nothing is streamed, or where poses are commanded.
        gripper: None unless a new width is to be sent.
        task_changed: `Commander.task` differs from the last tick's.
        events: what happened.
        refusals: counted by reason by the caller.
        accepted: the chunk that came in force with this tick, for latencies.
    """

    pose: PoseCommand | None = None
    joint: JointCommand | None = None
    gripper: GripperCommand | None = None
    task_changed: bool = False
    events: list[Event] = field(default_factory=list)
    rejections: list[Rejection] = field(default_factory=list)
    accepted: Cause | None = None

    def tell(
        self,
        level: str,
        kind: str,
        what: str,
        why: str,
        value: float | None = None,
        limit: float | None = None,
    ) -> None:
        """Add an event; a value that is not finite is left out."""
        if value is not None and not math.isfinite(value):
            value = None
        self.events.append(Event(level, kind, what, why[:MAX_TEXT], value, limit))

    def refuse(self, refusal: Rejection, worker: str) -> None:
        """Count a chunk of `worker` as refused, and tell it unless that is normal running."""
        self.rejections.append(refusal)
        if not refusal.quiet:
            why = f"{worker}: {refusal.why}"
            self.tell("warning", "refusal", refusal.reason, why, refusal.value, refusal.limit)

    def shortened(self, hits: Sequence[LimitHit]) -> None:
        """Tell what acted on the steps of a chunk, see `Composer`."""
        for hit in hits:
            if hit.name == APPROACH:
                why = f"its target is {hit.value:.3g} {hit.where} away, over a step: gone to slowly"
                self.tell("info", "limit", hit.name, why, hit.value, hit.limit)
                continue
            where = f" at {hit.where}" if hit.where else ""
            self.tell("warning", "limit", hit.name, f"shortened{where}", hit.value, hit.limit)
