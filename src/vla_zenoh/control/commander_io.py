"""Inputs and outputs of one tick of the `Commander`, and earlier states of the robot."""

from __future__ import annotations

import math
from bisect import bisect_right
from collections import deque
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from operator import itemgetter
from typing import Generic, NamedTuple, TypeVar

from vla_zenoh.control.limits import APPROACH, LimitHit
from vla_zenoh.control.policy_check import Rejection
from vla_zenoh.control.preflight import CLOCK_TOLERANCE_S, PeerSnapshot
from vla_zenoh.types import (
    MAX_TEXT,
    ActionChunk,
    Cause,
    Event,
    GripperCommand,
    GripperState,
    HeldBox,
    JointCommand,
    JointState,
    PoseCommand,
    PoseState,
    Stamped,
)

Measured = TypeVar("Measured", PoseState, JointState)

KEPT_NS = 2_500_000_000
"""Longer than any observation that is not rejected as stale by default."""
MOST_STATES = 2500
"""Of a robot that publishes its state at up to 1 kHz all are kept."""


class Setting(NamedTuple):
    """A setting received from a client, or a loss found by the command node itself.

    Args:
        name: prompt, active, worker, rate, speed, slower, held, stop, reset or lose.
        value: of ``active`` a text is the name of the deadman, the client that holds the arm
            active.
        put_ns: when it was put, by the router's clock; None: unknown.
        part: of the robot, for ``held``.
    """

    name: str
    value: str | bool | float | HeldBox | None = None
    put_ns: int | None = None
    part: str = ""


class NewStates(NamedTuple):
    """Newest states of one part since the last tick; None: none, or none decoded."""

    pose: Stamped[PoseState] | None = None
    gripper: Stamped[GripperState] | None = None
    joint: Stamped[JointState] | None = None


class StateHistory(Generic[Measured]):
    """States of the last seconds, by the time they were measured: where the arm was then."""

    def __init__(self) -> None:
        self._states: deque[tuple[int, Measured]] = deque(maxlen=MOST_STATES)

    def restart(self, measured: Stamped[Measured] | None) -> None:
        """Drop all states but this one."""
        self._states.clear()
        if measured is not None:
            self._states.append((measured.header.stamp_wall_ns, measured.record))

    def add(self, measured: Stamped[Measured]) -> None:
        """Add a state; if time goes back, a clock was set, and only this state is kept.

        One that is stamped later than it arrived, by more than `CLOCK_TOLERANCE_S`, is not kept.
        """
        stamp_ns = measured.header.stamp_wall_ns
        if stamp_ns - measured.received_ns > CLOCK_TOLERANCE_S * 1e9:
            return
        last_ns = self._states[-1][0] if self._states else -1
        if stamp_ns < last_ns:
            self.restart(measured)
        elif stamp_ns > last_ns:
            self._states.append((stamp_ns, measured.record))
            while self._states[0][0] < stamp_ns - KEPT_NS:
                self._states.popleft()

    def around(self, t_ns: int, gap_ns: int) -> tuple[Measured, Measured, float] | None:
        """The states measured next before and after `t_ns`, and the share of time between them.

        Args:
            t_ns: on the clock of the stamps.
            gap_ns: a state measured longer before `t_ns` than this is not used.

        Returns:
            None where no state was measured within `gap_ns` before; the last one before it twice,
            with a share of 0, where none was measured after it.
        """
        index = bisect_right(self._states, t_ns, key=itemgetter(0))
        if index == 0 or t_ns - self._states[index - 1][0] > gap_ns:
            return None
        since_ns, before = self._states[index - 1]
        if index == len(self._states) or since_ns == t_ns:
            return before, before, 0.0
        until_ns, after = self._states[index]
        return before, after, (t_ns - since_ns) / (until_ns - since_ns)


class MotionCommands(NamedTuple):
    """Commands of one tick to one part, each None where there is none."""

    pose: PoseCommand | None = None
    joint: JointCommand | None = None
    gripper: GripperCommand | None = None


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
        parts: the three of each part, where the robot has several; the ones above are None then.
    """

    settings: Sequence[Setting] = ()
    chunks: Sequence[Stamped[ActionChunk]] = ()
    pose: Stamped[PoseState] | None = None
    gripper: Stamped[GripperState] | None = None
    peers: PeerSnapshot | None = None
    joint: Stamped[JointState] | None = None
    parts: Mapping[str, NewStates] = field(default_factory=dict)

    def of(self, part: str) -> NewStates:
        """States of `part`; of no name: of the robot."""
        if part:
            return self.parts.get(part, NewStates())
        return NewStates(self.pose, self.gripper, self.joint)


@dataclass(slots=True)
class Outputs:
    """Everything to publish after a tick.

    Args:
        pose: None while nothing is streamed, or where joints are commanded.
        joint: None while nothing is streamed, or where poses are commanded.
        gripper: None unless there is a new width to command.
        parts: the three of each part, where the robot has several; the ones above are None then.
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
    parts: dict[str, MotionCommands] = field(default_factory=dict)

    def of(self, part: str) -> MotionCommands:
        """Commands to `part`; of no name: to the robot."""
        if part:
            return self.parts.get(part, MotionCommands())
        return MotionCommands(self.pose, self.joint, self.gripper)


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
        level, why = "warning", f"shortened{hit.at}{hit.way_out}"
        if hit.name == APPROACH:
            level = "info"
            why = f"target {hit.value:.3g} {hit.where} away, over a step: approached slowly"
        events.append(make_event(level, "limit", hit.name, why, hit.value, hit.limit))
    return events
