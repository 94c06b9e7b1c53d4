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
    assert stream.is_next(header(10))
    assert not stream.is_next(header(9))
    assert not stream.is_next(header(3))
    assert not stream.is_next(header(10, "stranger#1"))


def test_after_a_silence_a_repetition_is_still_not_new(stream: SingleWriterFilter) -> None:
    later_ns = round(10 * SILENCE_S * 1e9)
    assert stream.objection(header(3), later_ns) is None, "a silent writer is forgotten"
    assert not stream.is_next(header(3))
    assert stream.is_next(header(11))


def test_before_anything_was_accepted_nothing_is_new() -> None:
    assert not SingleWriterFilter(SILENCE_S).is_next(header(0))
