"""Every reason not to carry a chunk out, one by one."""

from __future__ import annotations

import re
from typing import Any

import numpy as np
import pytest
from command_rig import MS, SOURCE, START_NS, WORKER, model_spec

from vla_zenoh.control.policy_check import (
    FUTURE_TOLERANCE_NS,
    Lease,
    Rejection,
    validate_chunk,
)
from vla_zenoh.types import ActionChunk, Header, Stamped, Task

NOW_NS = START_NS + 10**10
MAX_AGE_S = 1.0
SPEC = model_spec(horizon=4)
TASK = Task(episode=7, active=True, prompt="hold", worker=WORKER, rate_hz=5.0)


@pytest.fixture
def lease() -> Lease:
    return Lease(SPEC, SOURCE, since_ns=START_NS, last_seq=3)


def chunk(*, seq: int = 4, source: str = SOURCE, **fields: Any) -> Stamped[ActionChunk]:
    made = {
        "worker": WORKER,
        "spec_hash": SPEC.hash,
        "episode": TASK.episode,
        "observation_stamp_ns": NOW_NS - 100 * MS,
        "observation_seq": 0,
        "valid_until_ns": NOW_NS + 100 * MS,
        "steps": np.zeros((1, 7), np.float32),
        "observed_ns": NOW_NS,
        "inference_start_ns": NOW_NS,
        "inference_end_ns": NOW_NS,
        **fields,
    }
    return Stamped(Header(NOW_NS, seq, source), ActionChunk(**made), NOW_NS)


def judge(lease: Lease, given: Stamped[ActionChunk]) -> Rejection | None:
    return validate_chunk(given, SOURCE, lease, TASK, MAX_AGE_S, NOW_NS)


def test_a_good_chunk_is_carried_out(lease: Lease) -> None:
    assert judge(lease, chunk()) is None


@pytest.mark.parametrize(
    ("reason", "match", "change"),
    [
        (
            "foreign",
            f"by 'somebody-9'; the source of this worker is {SOURCE!r}",
            {"source": "somebody-9"},
        ),
        ("replayed", "chunk 3 came twice", {"seq": 3}),
        ("replayed", "chunk 0 came twice", {"seq": 0}),
        ("spec_mismatch", "chunk of spec 'another'", {"spec_hash": "another"}),
        ("superseded", "for episode 6, the current one is 7", {"episode": 6}),
        ("superseded", "for episode 8, the current one is 7", {"episode": 8}),
        ("stale", "1.001 s old, at most 1 s", {"observation_stamp_ns": NOW_NS - 1001 * MS}),
        (
            "future",
            "0.051 s in the future",
            {"observation_stamp_ns": NOW_NS + FUTURE_TOLERANCE_NS + MS},
        ),
        ("before_activation", "before this activation", {"observation_stamp_ns": START_NS - 1}),
        ("expired", "until 0.002 s ago", {"valid_until_ns": NOW_NS - 2 * MS}),
        ("shape", r"\(H, 7\)", {"steps": np.zeros((1, 6))}),
        ("shape", "a chunk of 5 steps, the spec says 1 to 4", {"steps": np.zeros((5, 7))}),
    ],
)
def test_a_bad_chunk_is_refused_by_name_and_sentence(
    lease: Lease, reason: str, match: str, change: dict[str, Any]
) -> None:
    refusal = judge(lease, chunk(**change))
    assert refusal is not None
    assert refusal.reason == reason
    assert re.search(match, refusal.why), refusal.why


def test_an_observation_is_used_once(lease: Lease) -> None:
    lease.last_observation_ns = NOW_NS - 100 * MS
    refusal = judge(lease, chunk())
    assert refusal is not None
    assert refusal.reason == "out_of_order"
    assert judge(lease, chunk(seq=5, observation_stamp_ns=NOW_NS - 99 * MS)) is None


def test_a_chunk_is_looked_at_once_even_when_it_is_refused(lease: Lease) -> None:
    first = chunk(seq=9, episode=1)
    assert judge(lease, first) is not None
    again = judge(lease, chunk(seq=9))
    assert again is not None
    assert again.reason == "replayed"


def test_a_foreign_chunk_does_not_use_up_numbers(lease: Lease) -> None:
    assert judge(lease, chunk(seq=10**9, source="somebody-9")) is not None
    assert judge(lease, chunk(seq=4)) is None


def test_what_is_part_of_normal_running_makes_no_event(lease: Lease) -> None:
    late = judge(lease, chunk(seq=5, episode=6))
    early = judge(lease, chunk(seq=6, observation_stamp_ns=START_NS - 1))
    odd = judge(lease, chunk(seq=7, episode=8))
    assert late is not None
    assert early is not None
    assert odd is not None
    assert (late.quiet, early.quiet, odd.quiet) == (True, True, False)
