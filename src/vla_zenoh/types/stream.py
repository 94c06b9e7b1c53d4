"""What every sample carries and every node publishes: headers, and the filter that lets one writer
through at a time; status, events, and the task in force. At the end the checks of record fields:
each returns the value in its final form, or raises a `RecordError`.

Without numpy, which a command that only drives does not load; fields with arrays are checked in
``arrays.py``.
"""

from __future__ import annotations

import math
import reprlib
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from numbers import Integral, Real
from typing import Any, Generic, Literal, NamedTuple, TypeVar

from vla_zenoh.errors import CodecError, RecordError

EVENT_LEVELS = ("info", "warning", "error")
EVENT_KINDS = ("refusal", "transition", "limit", "fault", "notice")
LEAST_PERCENT = 1.0
MAX_TEXT = 4096
MAX_SHOWN = 300
MAX_NAMES = 1024
MAX_ENTRIES = 1024
MAX_DETAIL_TEXT = 65_536
MAX_DETAIL_DEPTH = 3
MIN_DEPTH_UNIT_M, MAX_DEPTH_UNIT_M = 1e-5, 0.1

set_field = object.__setattr__
"""Puts the final form of a field into a frozen record."""


@dataclass(frozen=True, slots=True)
class Header:
    """Header of a streamed sample; it travels as the sample's attachment.

    Args:
        stamp_wall_ns: time of capture, nanoseconds since the Unix epoch on the writer's clock.
        seq: one more for every sample of this source on this key.
        source: node name and a number that differs after every restart.
    """

    stamp_wall_ns: int
    seq: int
    source: str

    def __post_init__(self) -> None:
        set_field(self, "stamp_wall_ns", integer("stamp_wall_ns", self.stamp_wall_ns))
        set_field(self, "seq", integer("seq", self.seq))
        text("source", self.source, 128)


Record = TypeVar("Record")


@dataclass(frozen=True, slots=True)
class Stamped(Generic[Record]):
    """A record as received at `received_ns`, on the wall clock of the receiver's host."""

    header: Header
    record: Record
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

    def is_next(self, header: Header) -> bool:
        """Whether a sample is of the writer, and newer than all that were accepted."""
        return header.source == self.writer and header.seq > self._last_seq.get(header.source, -1)

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
        value, limit: the value that led to it and the bound it met, where there are any.
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
            if (given := getattr(self, name)) not in allowed:
                raise RecordError(f"{name} is {shown(given)}, allowed: {', '.join(allowed)}")
        keep(self, integer, "count", minimum=1)
        keep_given(self, number, "value", "limit")


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


def shown(value: Any) -> str:
    """`value` in short, for an error message: it may be huge, nested, or refuse to be printed."""
    if isinstance(value, (str, bytes)):
        value = value[:80]
    return reprlib.repr(value)[:MAX_SHOWN]


def is_bool(value: Any) -> bool:
    """Whether `value` is a bool, of numpy too, which is not imported for it."""
    numpy = sys.modules.get("numpy")
    return isinstance(value, bool) or (numpy is not None and isinstance(value, numpy.bool_))


def number(name: str, value: Any, minimum: float = -math.inf, maximum: float = math.inf) -> float:
    """A finite float within ``[minimum, maximum]``."""
    if type(value) is float and minimum <= value <= maximum and math.isfinite(value):
        return value
    if isinstance(value, bool) or not isinstance(value, Real):
        raise RecordError(f"{name} is not a number: {shown(value)}")
    try:
        result = float(value)
    except OverflowError:
        result = math.inf
    if not math.isfinite(result) or not minimum <= result <= maximum:
        raise RecordError(
            f"{name} is {shown(value)}, wanted a number in [{minimum:g}, {maximum:g}]"
        )
    return result


def integer(name: str, value: Any, minimum: int = 0, maximum: int = 2**63 - 1) -> int:
    """An int within ``[minimum, maximum]``."""
    if type(value) is int and minimum <= value <= maximum:
        return value
    if isinstance(value, bool) or not isinstance(value, Integral):
        raise RecordError(f"{name} is not a whole number: {shown(value)}")
    result = int(value)
    if not minimum <= result <= maximum:
        raise RecordError(
            f"{name} is {shown(value)}, wanted a whole number in [{minimum}, {maximum}]"
        )
    return result


def text(name: str, value: Any, limit: int = MAX_TEXT) -> str:
    """A str of at most `limit` characters, all of which UTF-8 can carry."""
    if not isinstance(value, str):
        raise RecordError(f"{name} is not text: {type(value).__name__}")
    if len(value) > limit:
        raise RecordError(f"{name} has {len(value)} characters, at most {limit} are allowed")
    if not value.isascii():
        try:
            value.encode("utf-8")
        except UnicodeEncodeError as error:
            raise RecordError(f"{name} holds half a character (a surrogate)") from error
    return value


def texts(name: str, value: Any, limit: int) -> tuple[str, ...]:
    """A tuple of texts, of a list or tuple; a single str is not a list of its letters."""
    if not isinstance(value, (list, tuple)):
        raise RecordError(f"{name} is not a list of texts: {shown(value)}")
    if len(value) > MAX_NAMES:
        raise RecordError(f"{name} has {len(value)} entries, at most {MAX_NAMES} are allowed")
    return tuple(text(name, item, limit) for item in value)


def joint_names(name: str, value: Any) -> tuple[str, ...]:
    """Names of joints: at least one, none of them twice."""
    names = texts(name, value, 128)
    if not names or len(set(names)) != len(names):
        raise RecordError(f"joint names must be present and differ: {shown(names)}")
    return names


def boolean(name: str, value: Any) -> bool:
    """A bool; 0 and 1 are rejected."""
    if not is_bool(value):
        raise RecordError(f"{name} is not true or false: {shown(value)}")
    return bool(value)


def entries(name: str, value: Any, of: Callable[..., Any], **bounds: Any) -> dict[str, Any]:
    """A copy of a map from short names to what the check `of` returns."""
    if not isinstance(value, Mapping):
        raise RecordError(f"{name} is not a map: {shown(value)}")
    if len(value) > MAX_ENTRIES:
        raise RecordError(f"{name} has {len(value)} entries, at most {MAX_ENTRIES} are allowed")
    return {
        text(f"a name in {name}", key, 256): of(f"{name}.{key}", item, **bounds)
        for key, item in value.items()
    }


def details(name: str, value: Any, depth: int = MAX_DETAIL_DEPTH) -> Any:
    """Text, finite numbers, bools and None, in lists and maps that are not nested deep."""
    if value is None:
        return None
    if is_bool(value):
        return bool(value)
    if isinstance(value, str):
        return text(name, value, MAX_DETAIL_TEXT)
    if isinstance(value, Integral):
        return integer(name, value, -(2**63))
    if isinstance(value, Real):
        return number(name, value)
    if depth == 0:
        raise RecordError(f"{name} is nested too deep")
    if isinstance(value, Mapping):
        return entries(name, value, details, depth=depth - 1)
    if isinstance(value, (list, tuple)) and len(value) <= MAX_ENTRIES:
        return [details(name, item, depth - 1) for item in value]
    raise RecordError(f"{name} is not text, a number, a bool, a list or a map: {shown(value)}")


def keep(record: Any, check: Callable[..., Any], *names: str, **bounds: Any) -> None:
    """Put fields of a frozen record into the final form that `check` returns."""
    for name in names:
        set_field(record, name, check(name, getattr(record, name), **bounds))


def keep_given(record: Any, check: Callable[..., Any], *names: str, **bounds: Any) -> None:
    """`keep` for fields that may be None."""
    keep(record, check, *(name for name in names if getattr(record, name) is not None), **bounds)
