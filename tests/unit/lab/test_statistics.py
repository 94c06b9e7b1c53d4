"""Paired comparisons: McNemar's exact test and the interval of the difference."""

from __future__ import annotations

import itertools
import math

import pytest
from hypothesis import given
from hypothesis import strategies as st
from vla_zenoh_benchmarks.statistics import ALPHA, LEAST_DIFFERING, Paired, mcnemar_exact, paired

ATOL = 1e-12
COVERED_AT_LEAST = 0.93
"""Share of drawn tables whose 95 % interval holds the true difference; it is no exact interval."""

COUNTS = st.integers(0, 60)
TABLES = st.builds(Paired, COUNTS, COUNTS, COUNTS, COUNTS)


@pytest.mark.parametrize(
    ("first", "second", "p"),
    # Twice the binomial tail, by hand.
    [
        (0, 0, 1.0),
        (5, 5, 1.0),
        (1, 0, 1.0),
        (5, 0, 2 / 32),
        (0, 6, 2 / 64),
        (9, 1, 22 / 1024),
        (2, 10, 2 * (1 + 12 + 66) / 4096),
    ],
)
def test_p_of_known_counts_is_known(first: int, second: int, p: float) -> None:
    assert mcnemar_exact(first, second) == pytest.approx(p, abs=ATOL)


@given(st.integers(0, 12), st.integers(0, 12))
def test_p_is_the_share_of_coin_tosses_that_are_as_uneven(first: int, second: int) -> None:
    n = first + second
    uneven = abs(first - second)
    as_uneven = sum(math.comb(n, heads) for heads in range(n + 1) if abs(2 * heads - n) >= uneven)
    assert mcnemar_exact(first, second) == pytest.approx(as_uneven / 2**n, abs=ATOL)


def test_p_of_thousands_of_setups_is_a_number() -> None:
    assert mcnemar_exact(2000, 2000) == 1.0
    assert 0.0 < mcnemar_exact(700, 800) < 0.05
    assert mcnemar_exact(0, 5000) == 0.0  # smaller than any float


@given(st.lists(st.tuples(st.booleans(), st.booleans())))
def test_every_setup_is_counted_once_and_the_difference_is_that_of_the_rates(
    outcomes: list[tuple[bool, bool]],
) -> None:
    counts = paired(outcomes)
    assert counts.setups == len(outcomes)
    if outcomes:
        rates = [sum(each[who] for each in outcomes) / len(outcomes) for who in (0, 1)]
        assert counts.difference == pytest.approx(rates[0] - rates[1], abs=ATOL)


@given(TABLES)
def test_the_interval_holds_the_difference_and_turns_with_the_order(table: Paired) -> None:
    low, high = table.difference_95
    assert -1.0 <= low <= table.difference <= high <= 1.0
    turned = Paired(table.both, table.second, table.first, table.neither)
    assert turned.difference_95 == pytest.approx((-high, -low), abs=ATOL)
    assert turned.p == table.p


def test_outcomes_that_agree_on_the_setups_tell_more_than_outcomes_that_do_not() -> None:
    """The same rates, once on the same setups and once on any."""
    same, apart = Paired(40, 10, 0, 50), Paired(20, 30, 20, 30)
    assert same.difference == apart.difference
    width = [high - low for low, high in (same.difference_95, apart.difference_95)]
    assert width[0] < 0.7 * width[1]
    assert same.p < apart.p


def test_without_setups_nothing_is_known() -> None:
    nothing = paired([])
    assert (nothing.difference, nothing.difference_95, nothing.p) == (0.0, (-1.0, 1.0), 1.0)


@pytest.mark.parametrize(
    ("both", "first", "second"), [(0.25, 0.25, 0.25), (0.6, 0.2, 0.1), (0.1, 0.5, 0.1)]
)
def test_the_interval_covers_the_truth_about_as_often_as_it_says(
    both: float, first: float, second: float
) -> None:
    """Every table of 20 setups, with its probability."""
    n, chances = 20, (both, first, second, 1 - both - first - second)
    covered = 0.0
    for a, b, c in itertools.product(range(n + 1), repeat=3):
        d = n - a - b - c
        if d < 0:
            continue
        low, high = Paired(a, b, c, d).difference_95
        if low <= first - second <= high:
            ways = math.factorial(n) // math.prod(map(math.factorial, (a, b, c, d)))
            covered += ways * math.prod(
                chance**count for chance, count in zip(chances, (a, b, c, d), strict=True)
            )
    assert COVERED_AT_LEAST < covered < 1.0


@given(TABLES)
def test_a_stated_interval_never_contradicts_p(table: Paired) -> None:
    if (stated := table.stated_95) is not None:
        low, high = stated
        assert (low <= 0.0 <= high) == (table.p >= ALPHA)


def test_few_setups_that_differ_are_said_to_be_too_few() -> None:
    four = Paired(0, 4, 0, 0)
    assert four.p > ALPHA
    assert four.stated_95 is None
    assert four.too_few.startswith("Too few of the 4 pairs differ to tell: 4, and 6 or more")
    six = Paired(0, LEAST_DIFFERING, 0, 0)
    assert six.p < ALPHA
    assert six.too_few == ""
    assert Paired(0, LEAST_DIFFERING - 1, 0, 0).p >= ALPHA
