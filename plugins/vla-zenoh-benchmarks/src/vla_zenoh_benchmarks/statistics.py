"""Success rates with their intervals, and paired comparisons.

SciPy has Wilson's interval and the exact test, but would be a dependency of 100 MB for these few
lines.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass


def wilson_95(successes: int, trials: int) -> tuple[float, float]:
    """Interval of a success rate at 95 % (E. B. Wilson, J. Am. Stat. Assoc. 22, 1927).

    Without trials nothing is known: 0 to 1.
    """
    if trials == 0:
        return 0.0, 1.0
    z, rate = 1.959963984540054, successes / trials
    spread = z * math.sqrt(rate * (1 - rate) / trials + z * z / (4 * trials * trials))
    middle, scale = rate + z * z / (2 * trials), 1 + z * z / trials
    # At the ends rounding would put the rate itself outside.
    return max(0.0, min(rate, (middle - spread) / scale)), min(
        1.0, max(rate, (middle + spread) / scale)
    )


ALPHA = 0.05
LEAST_DIFFERING = 6
"""Setups that one alone succeeded on, from which on p can be below `ALPHA`: 2 / 2**6 is."""


@dataclass(frozen=True, slots=True)
class Paired:
    """Setups that both did once, by who succeeded. Counts are not negative."""

    both: int
    first: int
    second: int
    neither: int

    @property
    def setups(self) -> int:
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
        return mcnemar_exact(self.first, self.second)

    @property
    def stated_95(self) -> tuple[float, float] | None:
        """`difference_95`, where it and `p` agree whether there is a difference; else None.

        The interval is approximate, p is exact: of few setups they may contradict each other.
        """
        low, high = self.difference_95
        return (low, high) if (low <= 0.0 <= high) == (self.p >= ALPHA) else None

    @property
    def too_few(self) -> str:
        """A sentence if too few setups differ to tell anything; else empty."""
        differing = self.first + self.second
        if differing >= LEAST_DIFFERING:
            return ""
        return (
            f"Too few of the {self.setups} pairs differ to tell: {differing}, and "
            f"{LEAST_DIFFERING} or more are needed for p below {ALPHA:g}"
        )

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
    counts = Counter(outcomes)
    both, neither = counts[True, True], counts[False, False]
    return Paired(both, counts[True, False], counts[False, True], neither)


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
    tail = sum(math.comb(n, k) for k in range(min(first, second) + 1))
    return min(1.0, 2 * tail / 2**n)
