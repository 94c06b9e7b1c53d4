"""The loop that keeps time: what it says of turns that come late, and of a computer that slept."""

from __future__ import annotations

import sys
import threading
import time

import pytest

from vla_zenoh.bus import clock
from vla_zenoh.bus.clock import FixedRate

RATE_HZ = 250.0
ASLEEP_S = 3600.0
BUSY_S = 60.0
"""Nothing keeps a test waiting for so long."""
READ_APART_NS = 5_000_000
"""Two clocks are read within this, on a busy computer, at least once in `TRIES`."""
TRIES = 1000
SKIPPED = 5


def test_a_computer_that_was_suspended_stalled_once_and_missed_no_turn(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    asleep_ns = [0]
    monkeypatch.setattr(clock, "suspended_ns", lambda: asleep_ns[0])
    loop = FixedRate(RATE_HZ)
    assert loop.wait().stall_s < BUSY_S
    asleep_ns[0] = round(ASLEEP_S * 1e9)
    tick = loop.wait()
    assert ASLEEP_S <= tick.stall_s < ASLEEP_S + BUSY_S
    assert tick.periods < BUSY_S * RATE_HZ
    assert loop.wait().stall_s < BUSY_S


def test_two_clocks_that_were_read_too_far_apart_are_no_suspension(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    asleep_ns = [0]
    monkeypatch.setattr(clock, "suspended_ns", lambda: asleep_ns[0])
    loop = FixedRate(RATE_HZ)
    for asleep_s in (-ASLEEP_S, 0.0):
        asleep_ns[0] = round(asleep_s * 1e9)
        assert loop.wait().stall_s < BUSY_S


def test_a_late_turn_says_by_how_much_and_how_many_it_stands_for() -> None:
    loop = FixedRate(RATE_HZ)
    loop.wait()
    time.sleep(10 / RATE_HZ)
    tick = loop.wait()
    assert tick.stall_s >= 9 / RATE_HZ
    assert tick.periods >= 10


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux says how long it was suspended")
def test_the_time_asleep_is_that_of_the_kernel() -> None:
    # Read in the other order it is never less than the truth.
    most_ns = min(
        -time.monotonic_ns() + time.clock_gettime_ns(time.CLOCK_BOOTTIME) for _ in range(TRIES)
    )
    said_ns = max(clock.suspended_ns() for _ in range(TRIES))
    assert 0 <= most_ns - said_ns < READ_APART_NS


def test_an_arrival_ends_the_wait_once_and_the_turn_is_at_its_time_all_the_same() -> None:
    loop, arrival = FixedRate(1.0), threading.Event()
    due_ns = loop.next_ns
    arrival.set()
    assert loop.wait_for(arrival)
    assert time.monotonic_ns() < due_ns
    assert not arrival.is_set()
    assert not loop.wait_for(arrival)
    assert loop.wait().nominal_ns == due_ns


def test_cycles_that_are_skipped_are_not_missed() -> None:
    loop = FixedRate(RATE_HZ)
    loop.wait()
    due_ns = loop.next_ns
    loop.skip(SKIPPED)
    tick = loop.wait()
    assert tick.nominal_ns >= due_ns + (SKIPPED - 1) * 1e9 / RATE_HZ
    assert tick.stall_s < BUSY_S
    assert tick.periods < BUSY_S * RATE_HZ


def test_a_skip_that_is_ended_goes_on_with_the_next_multiple() -> None:
    loop = FixedRate(RATE_HZ)
    due_ns = loop.next_ns
    loop.skip(1000)
    loop.resume()
    assert due_ns <= loop.next_ns < due_ns + BUSY_S * 1e9
    assert (loop.next_ns - due_ns) % round(1e9 / RATE_HZ) == 0
    loop.resume()
    assert loop.next_ns < due_ns + BUSY_S * 1e9


def test_a_loop_can_sleep_until_shortly_before_its_next_cycle() -> None:
    loop = FixedRate(1.0)
    before_ns = round(0.95e9)
    loop.wait_until(before_ns)
    assert loop.next_ns - time.monotonic_ns() <= before_ns
    loop.wait_until(round(2e9))  # that time is over: no sleep
    assert time.monotonic_ns() < loop.next_ns
