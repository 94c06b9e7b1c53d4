"""Offsets of clocks: never wrong by more than they say, and steady."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vla_zenoh.bus.clock import LAST_NS, ClockOffsetFilter, Exchange, shift_stamps
from vla_zenoh.types import ActionChunk, Header

MS = 1_000_000
WALL_MINUS_MONO_NS = 1_700_000_000 * 10**9
BOUND_S = 0.1
ROUNDING_S = 1e-8


def exchange(at_ns: int, offset_ns: int, there_ns: int, back_ns: int, took_ns: int = 0) -> Exchange:
    """With a clock that is `offset_ns` ahead of ours, ours being WALL_MINUS_MONO_NS + monotonic."""
    heard = at_ns + there_ns + WALL_MINUS_MONO_NS + offset_ns
    return Exchange(at_ns, heard, heard + took_ns, at_ns + there_ns + took_ns + back_ns)


ways = st.tuples(st.integers(0, 200 * MS), st.integers(0, 200 * MS), st.integers(0, 50 * MS))


@given(st.integers(-90 * MS, 90 * MS), st.lists(ways, min_size=1, max_size=30))
def test_the_truth_is_never_further_away_than_the_uncertainty(
    offset_ns: int, delays: list[tuple[int, int, int]]
) -> None:
    found, now_ns = ClockOffsetFilter(BOUND_S), 0
    for there_ns, back_ns, took_ns in delays:
        one = exchange(now_ns, offset_ns, there_ns, back_ns, took_ns)
        assert found.add(one)
        now_ns = one.got + MS
        said = found.offset(WALL_MINUS_MONO_NS, now_ns)
        assert said is not None
        assert abs(said.offset_s - offset_ns / 1e9) <= said.uncertainty_s + 1e-9
        applied_ns = found.applied_ns(WALL_MINUS_MONO_NS, now_ns)
        worst_ns = (said.uncertainty_s * 2) * 1e9 + 2
        assert applied_ns == 0 or abs(applied_ns - offset_ns) <= worst_ns


def test_the_quickest_exchange_counts() -> None:
    found = ClockOffsetFilter(BOUND_S)
    for delay_ms in (80, 2, 60):
        found.add(exchange(0, 30 * MS, delay_ms * MS, 0))
    said = found.offset(WALL_MINUS_MONO_NS, 80 * MS)
    assert said is not None
    assert said.uncertainty_s == pytest.approx(0.001, abs=1e-5)
    assert said.offset_s == pytest.approx(0.031, abs=1e-5)
    assert said.round_trip_s == pytest.approx(0.060)


def test_stamps_do_not_tremble_with_every_exchange() -> None:
    found, seen = ClockOffsetFilter(BOUND_S), set()
    for second in range(60):
        jitter_ns = (second * 7919) % 200_000
        found.add(exchange(second * 10**9, 20 * MS, 300_000 + jitter_ns, 400_000))
        seen.add(found.applied_ns(WALL_MINUS_MONO_NS, second * 10**9 + MS))
    assert len(seen) == 1
    assert abs(seen.pop() - 20 * MS) < MS


def test_a_clock_near_ours_is_left_as_it_is() -> None:
    found = ClockOffsetFilter(BOUND_S)
    found.add(exchange(0, 100_000, 200_000, 200_000))
    assert found.applied_ns(WALL_MINUS_MONO_NS, MS) == 0


def test_a_clock_beyond_the_bound_is_not_translated() -> None:
    found = ClockOffsetFilter(BOUND_S)
    found.add(exchange(0, 2000 * MS, MS, MS))
    assert found.applied_ns(WALL_MINUS_MONO_NS, 3 * MS) == 0
    said = found.offset(WALL_MINUS_MONO_NS, 3 * MS)
    assert said is not None
    assert said.offset_s == pytest.approx(2.0, abs=0.002)


@given(st.integers(-300 * MS, 300 * MS), st.lists(ways, min_size=1, max_size=12))
def test_a_clock_is_refused_where_it_is_not_corrected_and_nowhere_else(
    offset_ns: int, delays: list[tuple[int, int, int]]
) -> None:
    found, now_ns = ClockOffsetFilter(BOUND_S), 0
    for there_ns, back_ns, took_ns in delays:
        found.add(exchange(now_ns, offset_ns, there_ns, back_ns, took_ns))
        now_ns += 10**9
    said = found.offset(WALL_MINUS_MONO_NS, now_ns)
    assert said is not None
    applied_ns = found.applied_ns(WALL_MINUS_MONO_NS, now_ns)
    if abs(said.offset_s) > BOUND_S:
        assert applied_ns == 0
    else:  # what is left as it is may be right as it is
        assert abs(said.offset_s - applied_ns / 1e9) <= said.uncertainty_s + 1e-9


@given(
    st.sampled_from([(20, 5), (50, 10), (100, 20), (200, 40)]),
    st.lists(st.tuples(st.floats(-1, 1), st.floats(-1, 1)), min_size=1, max_size=12),
)
def test_clocks_that_agree_are_never_refused_for_a_long_link(
    link_ms: tuple[int, int], jitters: list[tuple[float, float]]
) -> None:
    delay_ms, varying_ms = link_ms
    found = ClockOffsetFilter(BOUND_S)
    for second, (there, back) in enumerate(jitters):
        there_ms, back_ms = delay_ms + varying_ms * there, delay_ms + varying_ms * back
        found.add(exchange(second * 10**9, 0, int(there_ms * MS), int(back_ms * MS)))
        said = found.offset(WALL_MINUS_MONO_NS, second * 10**9 + 500 * MS)
        assert said is not None
        assert abs(said.offset_s) <= varying_ms / 1e3 + ROUNDING_S
        assert not abs(said.offset_s) > BOUND_S


def test_a_clock_that_is_set_is_noticed_at_the_next_exchange() -> None:
    found = ClockOffsetFilter(BOUND_S)
    for second in range(5):
        found.add(exchange(second * 10**9, 0, MS // 10, MS // 10))
    found.add(exchange(6 * 10**9, 50 * MS, MS, MS))
    assert found.applied_ns(WALL_MINUS_MONO_NS, 6 * 10**9 + 3 * MS) == 50 * MS


def test_our_own_clock_that_is_set_needs_no_new_exchange() -> None:
    found = ClockOffsetFilter(BOUND_S)
    found.add(exchange(0, 0, MS, MS))
    later = found.offset(WALL_MINUS_MONO_NS + 30 * MS, 3 * MS)
    assert later is not None
    assert later.offset_s == pytest.approx(-0.03, abs=1e-6)


def test_what_cannot_be_is_left_out() -> None:
    found = ClockOffsetFilter(BOUND_S)
    assert not found.add(Exchange(10 * MS, WALL_MINUS_MONO_NS, WALL_MINUS_MONO_NS - 1, 11 * MS))
    assert not found.add(Exchange(0, 0, 10 * MS, MS))
    assert found.offset(WALL_MINUS_MONO_NS, 0) is None


def test_an_old_measurement_is_worth_less() -> None:
    found = ClockOffsetFilter(BOUND_S)
    found.add(exchange(0, 0, MS, MS))
    young = found.offset(WALL_MINUS_MONO_NS, 2 * MS)
    old = found.offset(WALL_MINUS_MONO_NS, 100 * 10**9)
    assert young is not None
    assert old is not None
    assert old.uncertainty_s > young.uncertainty_s + 0.004


stamps = st.sampled_from([0, 1, LAST_NS - 1, LAST_NS]) | st.integers(0, LAST_NS)


@given(st.integers(-90 * MS, 90 * MS), st.tuples(*[stamps] * 6))
def test_any_stamp_that_a_record_takes_is_put_on_our_clock(
    ahead_ns: int, given_ns: tuple[int, ...]
) -> None:
    at_ns, observed_ns, valid_ns, began_ns, ended_ns, of_ns = given_ns
    chunk = ActionChunk(
        worker="scripted",
        spec_hash="x",
        episode=1,
        observation_stamp_ns=of_ns,
        observation_seq=0,
        valid_until_ns=valid_ns,
        steps=np.zeros((1, 7), np.float32),
        observed_ns=observed_ns,
        inference_start_ns=began_ns,
        inference_end_ns=ended_ns,
    )
    header, moved = shift_stamps(Header(at_ns, 0, "worker-scripted#1"), chunk, ahead_ns)
    found_ns = (
        header.stamp_wall_ns,
        moved.observed_ns,
        moved.valid_until_ns,
        moved.inference_start_ns,
        moved.inference_end_ns,
        moved.observation_stamp_ns,
    )
    for stamp_ns, moved_ns in zip(given_ns, found_ns, strict=True):
        assert moved_ns == min(max(stamp_ns - ahead_ns, 0), LAST_NS)
