"""Whether a chunk may be carried out. Each refusal has a short stable name and a sentence."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

from vla_zenoh.errors import SpecError
from vla_zenoh.policy import ModelSpec, check_steps
from vla_zenoh.types import ActionChunk, Stamped, Task

FUTURE_TOLERANCE_NS = 50_000_000


class Rejection(NamedTuple):
    """Why a chunk was not carried out.

    Args:
        reason: name of the counter.
        why: a sentence.
        value: what was found, where it is a number.
        limit: what is allowed.
        quiet: part of normal running (a chunk under way when the prompt changed): no event.
    """

    reason: str
    why: str
    value: float | None = None
    limit: float | None = None
    quiet: bool = False


@dataclass(slots=True)
class Lease:
    """What was agreed with the worker at activation, and what came from it since.

    Args:
        spec: its spec.
        source: the one source whose chunks count; a second process of the same name is foreign.
        since_ns: observations older than this were made before the arm was given to the worker.
        last_seq: of the newest chunk seen.
        last_observation_ns: of the newest chunk taken to be carried out.
    """

    spec: ModelSpec
    source: str
    since_ns: int
    last_seq: int = -1
    last_observation_ns: int = -1


def refuse(
    chunk: Stamped[ActionChunk], lease: Lease, task: Task, max_age_s: float, now_ns: int
) -> Rejection | None:
    """The first reason not to carry `chunk` out, None when there is none.

    Updates the lease's `last_seq`, so that a chunk is looked at once only.
    """
    record, header = chunk.record, chunk.header
    if header.source != lease.source:
        return Rejection(
            "foreign",
            f"a chunk for {record.worker!r} by {header.source!r}; the lease is held by "
            f"{lease.source!r}",
        )
    if header.seq <= lease.last_seq:
        return Rejection(
            "replayed", f"chunk {header.seq} came again or late", header.seq, lease.last_seq
        )
    lease.last_seq = header.seq
    agreed = lease.spec.hash
    if record.spec_hash != agreed:
        return Rejection(
            "spec_mismatch",
            f"chunk of spec {record.spec_hash!r}, agreed at activation was {agreed}",
        )
    if record.episode != task.episode:
        return Rejection(
            "superseded",
            f"chunk for episode {record.episode}, now is {task.episode}",
            record.episode,
            task.episode,
            quiet=record.episode < task.episode,
        )
    return _refuse_by_time(record, lease, max_age_s, now_ns) or _refuse_by_shape(record, lease)


def _refuse_by_time(
    record: ActionChunk, lease: Lease, max_age_s: float, now_ns: int
) -> Rejection | None:
    age_s = (now_ns - record.observation_stamp_ns) / 1e9
    if age_s < -FUTURE_TOLERANCE_NS / 1e9:
        return Rejection("future", f"its observation is {-age_s:.3f} s in the future", age_s, 0.0)
    if record.observation_stamp_ns < lease.since_ns:
        return Rejection(
            "before_activation", "its observation was taken before this activation", quiet=True
        )
    if age_s > max_age_s:
        return Rejection(
            "stale",
            f"its observation is {age_s:.3f} s old, at most {max_age_s:g} s",
            age_s,
            max_age_s,
        )
    if now_ns > record.valid_until_ns:
        late_s = (now_ns - record.valid_until_ns) / 1e9
        return Rejection("expired", f"it was valid until {late_s:.3f} s ago", late_s, 0.0)
    if record.observation_stamp_ns <= lease.last_observation_ns:
        return Rejection("out_of_order", "its observation is not newer than the last one taken")
    return None


def _refuse_by_shape(record: ActionChunk, lease: Lease) -> Rejection | None:
    try:
        check_steps(lease.spec.action, record.steps)
    except SpecError as error:
        return Rejection("shape", str(error))
    return None
