"""Records that were written and never arrived, told by the numbers they carry."""

from __future__ import annotations

from typing import cast

import pytest
import zenoh

from vla_zenoh.bus.metrics import MAX_SENDERS, OTHERS, Percentiles, Traffic
from vla_zenoh.types import Header

POSE, DELTA = "vla/panda/state/pose", "vla/panda/delta/scripted"


class Written:
    """A stream as its writer counts it."""

    def __init__(self, key: str) -> None:
        self.key, self.seq, self.sent_bytes = key, 0, 0


def traffic() -> Traffic:
    return Traffic(cast("zenoh.Session", None))  # whose links nobody asks for here


def hear(found: Traffic, key: str, source: str, *numbers: int, arrived: int = 0) -> None:
    for nth, seq in enumerate(numbers, arrived + 1):
        found.received(key, Header(0, seq, source), nth)


def test_gaps_are_lost_and_what_the_slot_dropped_is_not() -> None:
    found = traffic()
    hear(found, POSE, "sim#1", 3, 4, 9)
    found.received(DELTA, Header(0, 0, "worker-scripted#1"), 1)
    found.received(DELTA, Header(0, 5, "worker-scripted#1"), 6)
    assert found.lost == {POSE: 4}


def test_who_comes_after_many_others_is_watched_too() -> None:
    found = traffic()
    for start in range(2 * MAX_SENDERS):
        hear(found, POSE, f"sim#{start}", 0, 1)
    hear(found, DELTA, "worker-scripted#1", 0, 9)
    assert found.lost == {DELTA: 8}


def test_losses_of_who_was_forgotten_stay_with_their_key() -> None:
    found = traffic()
    hear(found, POSE, "sim#before", 0, 5)
    for start in range(2 * MAX_SENDERS):
        hear(found, POSE, f"sim#{start}", 0, 2)
    assert found.lost == {POSE: 4 + 2 * MAX_SENDERS}


def test_who_speaks_all_the_time_is_not_forgotten_for_those_who_spoke_once() -> None:
    found = traffic()
    for turn in range(2 * MAX_SENDERS):
        found.received(POSE, Header(0, turn, "sim#1"), turn + 1)
        hear(found, DELTA, f"worker-scripted#{turn}", 0)
    found.received(POSE, Header(0, 2 * MAX_SENDERS + 7, "sim#1"), 2 * MAX_SENDERS + 1)
    assert found.lost == {POSE: 7}


def test_made_up_keys_take_a_bounded_place() -> None:
    found = traffic()
    for number in range(4 * MAX_SENDERS):
        hear(found, f"vla/panda/delta/ghost{number}", f"ghost{number}#1", 0, 2)
    lost = found.lost
    assert len(lost) <= 2 * MAX_SENDERS + 1
    assert sum(lost.values()) == 4 * MAX_SENDERS
    assert lost[OTHERS] > 0


def test_a_stream_that_was_ended_begins_anew() -> None:
    found, stream = traffic(), Written(POSE)
    stream.seq, stream.sent_bytes = 10, 1000
    assert set(found.sent([stream])) == {POSE}
    assert found.sent([]) == {}
    again = Written(POSE)
    again.seq, again.sent_bytes = 2, 200
    assert set(found.sent([again])) == {POSE}


# -- percentiles ----------------------------------------------------------------------------------
def test_percentiles_without_values_are_none() -> None:
    found = Percentiles(8)
    assert found.summary() is None
    assert found.spread() == {}


@pytest.mark.parametrize("before", [[], [1e9] * 100, [-5.0] * 101])
def test_percentiles_are_those_of_the_last_values(before: list[float]) -> None:
    found = Percentiles(101)
    for value in (*before, *(float(value) for value in range(100, -1, -1))):
        found.add(value)
    assert found.summary() == (50.0, 95.0)
    assert found.spread() == {"p50": 50.0, "p95": 95.0, "p99": 99.0, "max": 100.0}


def test_percentiles_of_few_values_are_some_of_them() -> None:
    found = Percentiles(100)
    found.add(3.0)
    assert found.summary() == (3.0, 3.0)
    found.add(1.0)
    assert found.spread()["max"] == 3.0
