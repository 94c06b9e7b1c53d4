"""The way from an image to a command: what chunks and commands say of it, as times of its stages.

No clock, no Zenoh, no OpenTelemetry. Times of a chunk that was executed are all those that its
command carries, on the clock of the command node's host; of another one those of the chunk, on the
clock of the worker's host.
"""

from __future__ import annotations

import hashlib
from collections import OrderedDict
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

from vla_zenoh.types import ActionChunk, Cause, Stamped

PATIENCE_NS = 5_000_000_000
"""A chunk without a command for so long has none: it was not obeyed, rejected or overtaken."""
MAX_WAITING, MAX_EARLY = 4096, 64
STAGES = ("observe", "wait", "infer", "publish", "receive", "command")
"""Stage -> what happens in it, in this order: the image is taken and reaches its worker, waits for
its turn, is inferred from; the chunk is published, reaches the command node, and is executed."""


class Stage(NamedTuple):
    """One stage of a journey, wall clock."""

    name: str
    start_ns: int
    end_ns: int


@dataclass(frozen=True)
class Journey:
    """One observation and what became of it.

    Args:
        chunk: that answers it.
        seq: of the chunk.
        times_ns: image, observation complete, inference began, ended, chunk published, received by
            the command node, first command; without the last two where there was no command.
    """

    robot: str
    chunk: ActionChunk
    seq: int
    source: str
    times_ns: tuple[int, ...]

    @property
    def executed(self) -> bool:
        """A command follows its chunk."""
        return len(self.times_ns) > len(STAGES)

    @property
    def trace_id(self) -> int:
        """128 bits that say robot, worker and observation: who knows these finds the trace."""
        chunk = self.chunk
        return trace_id(self.robot, chunk.worker, chunk.observation_stamp_ns)

    def stages(self) -> Iterator[Stage]:
        """Those whose times are known and in order."""
        for name, (start_ns, end_ns) in zip(STAGES, pairwise(self.times_ns), strict=False):
            if start_ns <= end_ns:
                yield Stage(name, start_ns, end_ns)

    @property
    def disordered(self) -> bool:
        """A stage ends before it begins: a clock was set, or clocks of hosts are apart."""
        return any(start_ns > end_ns for start_ns, end_ns in pairwise(self.times_ns))


def trace_id(robot: str, worker: str, observation_stamp_ns: int) -> int:
    """Trace of the observation that a worker stamped so."""
    text = f"{robot}\n{worker}\n{observation_stamp_ns}"
    return int.from_bytes(hashlib.sha256(text.encode()).digest()[:16], "big")


class Journeys:
    """Collects chunks and commands of one robot."""

    def __init__(self, robot: str) -> None:
        self._robot = robot
        self._waiting: OrderedDict[tuple[str, int], Stamped[ActionChunk]] = OrderedDict()
        # Commands overtake chunks: they have another priority.
        self._early: OrderedDict[tuple[str, int], tuple[int, ...]] = OrderedDict()
        self._last: tuple[str, int] | None = None
        self.lost = 0
        """Chunks that were given up because too many waited."""

    def take_chunk(self, chunk: Stamped[ActionChunk]) -> Journey | None:
        """Take a chunk, which waits for its command; the journey, if that came first."""
        key = (chunk.record.worker, chunk.header.seq)
        times_ns = self._early.pop(key, None)
        if times_ns is not None:
            return self._journey(chunk, times_ns)
        self._waiting.pop(key, None)
        self._waiting[key] = chunk
        if len(self._waiting) > MAX_WAITING:
            self._waiting.popitem(last=False)
            self.lost += 1
        return None

    def take_command(self, cause: Cause | None, stamp_ns: int) -> Journey | None:
        """Take a command; the journey that it ends, if it is the first of its chunk."""
        if cause is None or (cause.worker, cause.chunk_seq) == self._last:
            return None
        self._last = key = (cause.worker, cause.chunk_seq)
        times_ns = (
            cause.observation_stamp_ns,
            cause.observed_ns,
            cause.inference_start_ns,
            cause.inference_end_ns,
            cause.published_ns,
            cause.received_ns,
            stamp_ns,
        )
        chunk = self._waiting.pop(key, None)
        if chunk is not None:
            return self._journey(chunk, times_ns)
        self._early[key] = times_ns
        if len(self._early) > MAX_EARLY:
            self._early.popitem(last=False)
        return None

    def overdue(self, now_ns: int) -> Iterator[Journey]:
        """Those that end without a command; `now_ns` on the clock of ``received_ns``."""
        while self._waiting:
            key, chunk = next(iter(self._waiting.items()))
            if now_ns - chunk.received_ns < PATIENCE_NS:
                return
            del self._waiting[key]
            record = chunk.record
            times_ns = (
                record.observation_stamp_ns,
                record.observed_ns,
                record.inference_start_ns,
                record.inference_end_ns,
                chunk.header.stamp_wall_ns,
            )
            yield self._journey(chunk, times_ns)

    def _journey(self, chunk: Stamped[ActionChunk], times_ns: tuple[int, ...]) -> Journey:
        header = chunk.header
        return Journey(self._robot, chunk.record, header.seq, header.source, times_ns)
