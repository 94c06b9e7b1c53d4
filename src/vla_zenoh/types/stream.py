"""What every sample carries and every node publishes: headers, and the filter that lets one writer
through at a time; status, events, and the task in force. Without numpy, see ``form.py``.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated, Generic, Literal, NamedTuple, TypeVar

from msgspec import Meta

from vla_zenoh.errors import CodecError
from vla_zenoh.types.form import (
    MAX_WHOLE,
    Count,
    Counts,
    Details,
    Finite,
    Name,
    Numbers,
    Pairs,
    Record,
    Text,
    Wire,
    as_read,
)

EVENT_LEVELS = ("info", "warning", "error")
EVENT_KINDS = ("refusal", "transition", "limit", "fault", "notice")
LEAST_PERCENT = 1.0
MIN_DEPTH_UNIT_M, MAX_DEPTH_UNIT_M = 1e-5, 0.1

_Word = Annotated[str, Meta(max_length=256)]


@dataclass(frozen=True, slots=True)
class Header(Record):
    """Header of a streamed sample; it travels as the sample's attachment.

    Args:
        stamp_wall_ns: time of capture, nanoseconds since the Unix epoch on the writer's clock.
        seq: one more for every sample of this source on this key.
        source: node name and a number that differs after every restart.
    """

    stamp_wall_ns: Count
    seq: Count
    source: Name


Received = TypeVar("Received")


@dataclass(frozen=True, slots=True)
class Stamped(Generic[Received]):
    """A record as received at `received_ns`, on the wall clock of the receiver's host."""

    header: Header
    record: Received
    received_ns: int


class SingleWriterFilter:
    """Passes the samples of one source at a time, and each of them once.

    The first source becomes the `writer`. Samples of any other source are rejected until the writer
    is released or has been silent for `silence_s`, so no other source can interfere with a live
    stream. Times are of any clock that never goes back.

    `sources` are remembered by their last sequence number. With more than one no source becomes the
    writer: they may take turns.
    """

    def __init__(self, silence_s: float | None = None, sources: int = 1) -> None:
        self._silence_ns = None if silence_s is None else int(silence_s * 1e9)
        self._sources = sources
        self._last_seq: dict[str, int] = {}  # the source that wrote last comes last
        self._accepted_ns = 0
        self.writer = ""

    def objection(
        self, header: Header, now_ns: int = 0, writer: str = ""
    ) -> Literal["foreign", "replayed"] | None:
        """Why a sample that arrived at `now_ns` is to be rejected, None if it may be accepted.

        `writer`: the only source that may write, if the caller knows it.
        """
        if self._silent(now_ns):
            return None
        writer = writer or self.writer
        if writer and header.source != writer:
            return "foreign"
        return "replayed" if header.seq <= self._last_seq.get(header.source, -1) else None

    def check(self, header: Header, now_ns: int = 0, writer: str = "") -> None:
        """Raise a `CodecError` for a sample that is to be rejected, see `objection`."""
        reason = self.objection(header, now_ns, writer)
        if reason == "foreign":
            writer = writer or self.writer
            raise CodecError(
                reason, f"from {header.source[:60]!r}, but {writer[:60]!r} is writing this stream"
            )
        if reason == "replayed":
            raise CodecError(reason, f"sample {header.seq} is a repetition or out of order")

    def accept(self, header: Header, now_ns: int = 0) -> None:
        """Note that a sample was accepted."""
        if self._silent(now_ns):
            self._last_seq.clear()
        self._last_seq.pop(header.source, None)
        self._last_seq[header.source] = header.seq
        if len(self._last_seq) > self._sources:
            del self._last_seq[next(iter(self._last_seq))]
        self._accepted_ns = now_ns
        self.writer = header.source if self._sources == 1 else ""

    def release(self) -> None:
        """Let any source begin; samples accepted before are still replays."""
        self.writer = ""

    def _silent(self, now_ns: int) -> bool:
        return self._silence_ns is not None and now_ns - self._accepted_ns >= self._silence_ns


class HeldBox(NamedTuple):
    """What a gripper holds: a box along the axes of the TCP, and its centre from there."""

    size_m: tuple[float, float, float]
    centre_m: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def __str__(self) -> str:
        size, centre = (" ".join(f"{value:g}" for value in each) for each in self)
        return f"{size} at {centre}" if any(self.centre_m) else size


@dataclass(frozen=True, slots=True)
class NodeStatus(Record):
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

    node: _Word
    state: _Word
    host: _Word
    pid: Count
    started_wall_ns: Count
    ages_s: Numbers = field(default_factory=dict)
    rates_hz: Numbers = field(default_factory=dict)
    latency_ms: Pairs = field(default_factory=dict)
    counters: Counts = field(default_factory=dict)
    detail: Details = field(default_factory=dict)
    boot: _Word = ""


@dataclass(frozen=True, slots=True)
class Event(Record):
    """Something that happened once.

    Args:
        level: one of `EVENT_LEVELS`.
        kind: one of `EVENT_KINDS`.
        what: short stable name, for example ``stale_chunk``.
        why: a sentence.
        value, limit: the value that led to it and the bound it met, where there are any.
        count: how many of the same this stands for.
    """

    level: Annotated[str, Wire(Literal[EVENT_LEVELS], as_read)]
    kind: Annotated[str, Wire(Literal[EVENT_KINDS], as_read)]
    what: Text
    why: Text = ""
    value: Finite | None = None
    limit: Finite | None = None
    count: Annotated[int, Meta(ge=1, le=MAX_WHOLE)] = 1


@dataclass(frozen=True, slots=True)
class ClockReply(Record):
    """Reply to a query of a node's clock, on its wall clock.

    Args:
        heard_ns, said_ns: arrival of the query, and this reply.
    """

    heard_ns: Count
    said_ns: Count


@dataclass(frozen=True, slots=True)
class Task(Record):
    """The task in force, as the command node has accepted it.

    Args:
        episode: grows with every activation and every change of prompt or worker; a policy is reset
            with it, and a chunk of an older episode is rejected.
        active: the arm follows the worker.
        worker: whose chunks are executed.
        rate_hz: chunks per second requested of the workers.
        speed_percent: speed override, percent of the planned speed; 0: the arm stands, active.
    """

    episode: Count
    active: bool
    prompt: Text
    worker: Name
    rate_hz: Annotated[float, Meta(ge=0.01, le=1000.0)]
    speed_percent: Annotated[float, Meta(ge=0.0, le=100.0)] = 100.0

    @property
    def speed(self) -> float:
        """Plan seconds per second, 0 to 1: at least one percent, or the arm stands."""
        return self.speed_percent / 100.0 if self.speed_percent >= LEAST_PERCENT else 0.0

    @property
    def requested_hz(self) -> float:
        """Chunks per second requested of the worker now: at half the speed half as many, 0 if the
        arm stands. A worker that is not the chosen one is asked at the full rate."""
        return self.rate_hz * (self.speed if self.active else 1.0)
