"""The filter that lets one writer of a stream through, and each of its samples once."""

from __future__ import annotations

import pytest

from vla_zenoh.types import Header, SingleWriterFilter

SILENCE_S = 0.5
MS = 1_000_000


def header(seq: int, source: str = "robot#1") -> Header:
    return Header(seq * 10 * MS, seq, source)


@pytest.fixture
def stream() -> SingleWriterFilter:
    found = SingleWriterFilter(SILENCE_S)
    for seq in range(10):
        found.accept(header(seq), seq * 10 * MS)
    return found


def test_the_next_sample_of_the_writer_is_new_and_no_other(stream: SingleWriterFilter) -> None:
    now_ns = 100 * MS
    assert stream.objection(header(10), now_ns) is None
    assert stream.objection(header(9), now_ns) == "replayed"
    assert stream.objection(header(3), now_ns) == "replayed"
    assert stream.objection(header(10, "stranger#1"), now_ns) == "foreign"


def test_a_silent_writer_is_forgotten(stream: SingleWriterFilter) -> None:
    later_ns = round(10 * SILENCE_S * 1e9)
    assert stream.objection(header(3), later_ns) is None
    assert stream.objection(header(11), later_ns) is None
    assert stream.objection(header(0, "stranger#1"), later_ns) is None
