"""What nodes publish about themselves: status, events, and the task in force."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple

from vla_zenoh.errors import RecordError
from vla_zenoh.types.checks import (
    boolean,
    details,
    entries,
    integer,
    keep,
    keep_given,
    number,
    shown,
    text,
)

EVENT_LEVELS = ("info", "warning", "error")
EVENT_KINDS = ("refusal", "transition", "limit", "fault", "notice")


class HeldBox(NamedTuple):
    """What a gripper holds, as a box whose axes are those of the TCP.

    Args:
        size_m: of its edges along x, y, z.
        centre_m: from the TCP.
    """

    size_m: tuple[float, float, float]
    centre_m: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def __str__(self) -> str:
        size, centre = (" ".join(f"{value:g}" for value in each) for each in self)
        return f"{size} at {centre}" if any(self.centre_m) else size


@dataclass(frozen=True, slots=True)
class NodeStatus:
    """Status of a node, published by itself.

    Args:
        state: one word.
        host: where it runs: of the profile where it knows that, else the computer's own name.
        started_wall_ns: when it started; shows a restart.
        ages_s: age of the newest of every input.
        rates_hz: of its publishers and loops.
        latency_ms: stage -> ``[p50, p95]``.
        counters: everything counted; rejections as ``refused.<reason>``.
        detail: further details for display: text, finite numbers, bools and None, in lists and maps
            that are not nested deep.
        boot: unique id of its computer's last boot; empty if unknown.
    """

    node: str
    state: str
    host: str
    pid: int
    started_wall_ns: int
    ages_s: Mapping[str, float] = field(default_factory=dict)
    rates_hz: Mapping[str, float] = field(default_factory=dict)
    latency_ms: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    counters: Mapping[str, int] = field(default_factory=dict)
    detail: Mapping[str, Any] = field(default_factory=dict)
    boot: str = ""

    def __post_init__(self) -> None:
        keep(self, text, "node", "state", "host", "boot", limit=256)
        keep(self, integer, "pid", "started_wall_ns")
        keep(self, entries, "ages_s", "rates_hz", of=number)
        keep(self, entries, "counters", of=integer)
        keep(self, entries, "latency_ms", of=_pair)
        keep(self, entries, "detail", of=details)


def _pair(name: str, value: Any) -> tuple[float, float]:
    if not isinstance(value, (list, tuple)) or len(value) != 2:
        raise RecordError(f"{name} is not a pair of numbers: {shown(value)}")
    return number(name, value[0]), number(name, value[1])


@dataclass(frozen=True, slots=True)
class Event:
    """Something that happened once.

    Args:
        level: one of `EVENT_LEVELS`.
        kind: one of `EVENT_KINDS`.
        what: short stable name, for example ``stale_chunk``.
        why: a sentence.
        value: the value that led to it, where there is one.
        limit: the bound it met, where there is one.
        count: how many of the same this stands for.
    """

    level: str
    kind: str
    what: str
    why: str = ""
    value: float | None = None
    limit: float | None = None
    count: int = 1

    def __post_init__(self) -> None:
        keep(self, text, "level", "kind", "what", "why")
        for name, allowed in (("level", EVENT_LEVELS), ("kind", EVENT_KINDS)):
            if getattr(self, name) not in allowed:
                given = shown(getattr(self, name))
                raise RecordError(f"{name} is {given}, allowed: {', '.join(allowed)}")
        keep(self, integer, "count", minimum=1)
        keep_given(self, number, "value", "limit")


LEAST_PERCENT = 1.0


@dataclass(frozen=True, slots=True)
class Task:
    """The task in force, as the command node has accepted it.

    Args:
        episode: grows with every activation and every change of prompt or worker; a policy is reset
            with it, and a chunk of an older episode is rejected.
        active: the arm follows the worker.
        worker: whose chunks are executed.
        rate_hz: chunks per second requested of the workers.
        speed_percent: speed override, percent of the planned speed; 0: the arm stands, active.
    """

    episode: int
    active: bool
    prompt: str
    worker: str
    rate_hz: float
    speed_percent: float = 100.0

    def __post_init__(self) -> None:
        keep(self, integer, "episode")
        keep(self, boolean, "active")
        keep(self, text, "prompt")
        keep(self, text, "worker", limit=128)
        keep(self, number, "rate_hz", minimum=0.01, maximum=1000.0)
        keep(self, number, "speed_percent", minimum=0.0, maximum=100.0)

    @property
    def speed(self) -> float:
        """Plan seconds per second, 0 to 1: at least one percent, or the arm stands."""
        return self.speed_percent / 100.0 if self.speed_percent >= LEAST_PERCENT else 0.0

    @property
    def requested_hz(self) -> float:
        """Chunks per second requested of the worker now: at half the speed half as many, 0 if the
        arm stands. A worker that is not the chosen one is asked at the full rate."""
        return self.rate_hz * (self.speed if self.active else 1.0)
