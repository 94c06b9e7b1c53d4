"""Two policies on the same setups: what differs, and whether chance alone explains it."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

from vla_zenoh.lab.bench.statistics import wilson_95


@dataclass(frozen=True, slots=True)
class Paired:
    """Setups that both did once, by who succeeded. Counts are not negative.

    Args:
        both: both succeeded.
        first: the first alone succeeded.
        second: the second alone succeeded.
        neither: neither succeeded.
    """

    both: int
    first: int
    second: int
    neither: int

    @property
    def setups(self) -> int:
        """How many there are."""
        return self.both + self.first + self.second + self.neither

    @property
    def difference(self) -> float:
        """The first's success rate less the second's; 0 without setups."""
        return (self.first - self.second) / self.setups if self.setups else 0.0

    @property
    def difference_95(self) -> tuple[float, float]:
        """Interval of `difference` at 95 %; without setups nothing is known: -1 to 1.

        Method 10 of R. G. Newcombe, Statistics in Medicine 17, 2635-2650, 1998: the intervals of
        both rates, and how far both succeed on the same setups.
        """
        n = self.setups
        if n == 0:
            return -1.0, 1.0
        one, two = self.both + self.first, self.both + self.second
        low_1, high_1 = wilson_95(one, n)
        low_2, high_2 = wilson_95(two, n)
        rate_1, rate_2, phi = one / n, two / n, self._phi()

        def span(one_off: float, other_off: float) -> float:
            squared = one_off**2 - 2 * phi * one_off * other_off + other_off**2
            return math.sqrt(max(0.0, squared))

        return (
            max(-1.0, self.difference - span(rate_1 - low_1, high_2 - rate_2)),
            min(1.0, self.difference + span(high_1 - rate_1, rate_2 - low_2)),
        )

    @property
    def p(self) -> float:
        """`mcnemar_exact` of these setups."""
        return mcnemar_exact(self.first, self.second)

    def _phi(self) -> float:
        """Correlation of both outcomes, drawn towards 0 by half a setup; 0 if one is constant."""
        one, two, n = self.both + self.first, self.both + self.second, self.setups
        margins = one * (n - one) * two * (n - two)
        if margins == 0:
            return 0.0
        cross = self.both * self.neither - self.first * self.second
        if cross > 0:
            cross = max(cross - n / 2, 0.0)
        return cross / math.sqrt(margins)


def paired(outcomes: Iterable[tuple[bool, bool]]) -> Paired:
    """Counts of setups that both did.

    Args:
        outcomes: for each setup whether the first succeeded, and whether the second did.
    """
    both = first = second = neither = 0
    for one, other in outcomes:
        both += one and other
        first += one and not other
        second += other and not one
        neither += not one and not other
    return Paired(both, first, second, neither)


def mcnemar_exact(first: int, second: int) -> float:
    """Two-sided p of McNemar's test, by the binomial distribution itself.

    Were both equally good, each setup that one alone succeeded on would be either's with
    probability 1/2 (Q. McNemar, Psychometrika 12, 1947). The p is twice the smaller tail, 1 at
    most; without such setups it is 1.

    Args:
        first: setups that the first alone succeeded on, not negative.
        second: setups that the second alone succeeded on, not negative.
    """
    n = first + second
    tail = term = 1  # of n over 0; each next one is made of the last
    for k in range(1, min(first, second) + 1):
        term = term * (n - k + 1) // k
        tail += term
    return min(1.0, 2 * tail / 2**n)
