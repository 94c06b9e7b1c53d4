"""Stamps of a recording where clocks were set back, or where writers of one key have two clocks."""

from __future__ import annotations

from collections.abc import Iterable

import pytest

from vla_zenoh.keys import Keys
from vla_zenoh.lab.recording.sample import Sample
from vla_zenoh.lab.recording.stamp_order import StampOrder
from vla_zenoh.types import Header

KEYS = Keys("arm")
MS, BEGAN_NS = 1_000_000, 1_700_000_000_000_000_000


def written(rows: Iterable[tuple[str, int]]) -> tuple[list[int], list[str]]:
    """How far the stamps are from the times of reception, ms, and messages.

    A row every 10 ms: source, and how far its clock is ahead, ms.
    """
    order, off_ms = StampOrder(KEYS), []
    for number, (source, ahead_ms) in enumerate(rows):
        at_ns = BEGAN_NS + 10 * MS * number
        header = Header(at_ns + ahead_ms * MS, number, source)
        taken = order.take(Sample(KEYS.task, b"", "application/msgpack", header, at_ns))
        assert taken.header is not None
        off_ms.append((taken.header.stamp_wall_ns - at_ns) // MS)
    return off_ms, order.steps


@pytest.mark.parametrize("ahead_ms", [-60, 60, 3_600_000])
def test_two_writers_whose_clocks_differ_are_put_on_one_clock_and_told_once(ahead_ms: int) -> None:
    off_ms, told = written([("a#1", 0), ("b#1", ahead_ms)] * 50)
    assert off_ms == [off_ms[0], *[max(ahead_ms, 0)] * 99]
    (step,) = told
    behind, ahead = ("b#1", "a#1") if ahead_ms < 0 else ("a#1", "b#1")
    assert f"the clock of {behind!r} is behind that of {ahead!r}" in step
    assert "its stamps are set forward by as much" in step


def test_a_clock_that_is_set_back_beside_another_writer_shifts_its_own_stamps_alone() -> None:
    """By 0.1 s, and again by 0.2 s."""
    rows = [(source, ahead) for ahead in (0, -100, -300) for source in ["a#1", "b#1"] * 5]
    off_ms, told = written((who, ahead if who == "a#1" else 0) for who, ahead in rows)
    assert off_ms == [0] * 30
    assert [step.split("the clock of ")[1].split(",")[0] for step in told] == [
        "'a#1' was set back; its stamps are set forward by as much"
    ] * 2
    assert [step.partition("by ")[2].partition(" s")[0] for step in told] == ["0.100", "0.200"]


def test_clocks_that_differ_by_less_than_they_jitter_are_left_as_they_are() -> None:
    off_ms, told = written([("a#1", 0), ("b#1", -15)] * 5)
    assert (off_ms, told) == ([0, -15] * 5, [])


def test_a_writer_that_starts_again_after_its_clock_was_set_back_goes_on() -> None:
    off_ms, told = written([("a#1", 0)] * 3 + [("a#2", -500)] * 3)
    assert off_ms == [0] * 6
    assert len(told) == 1
