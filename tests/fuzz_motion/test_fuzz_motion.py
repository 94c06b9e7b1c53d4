"""Whatever policies, people and networks do, commands and references keep what is promised.

The same runs, for longer and of other seeds: ``make fuzz-motion``.
"""

from __future__ import annotations

import pytest
from fuzz_motion import CYCLE, command, run, told
from motion_case import IN_JOINTS

TICKS, JOINT_TICKS = 10_000, 6_000
"""Kinematics take their time."""
PARITY_TICKS = 2_000
SLOW = ("joint", "joint net", "reach", *IN_JOINTS)
FIRST, SHORT = 101, 0.1
EVENTFUL = (112, 116, 108, 102, 106, 122, 105, 113, 109, 106, FIRST)
"""Of each family the seed by which an arm moves, is stopped and activated again in so few ticks."""
CASES = [
    *((family, seed, SHORT) for family, seed in zip(dict.fromkeys(CYCLE), EVENTFUL, strict=True)),
    *(
        pytest.param(family, seed, 1.0, marks=pytest.mark.long)
        for family in dict.fromkeys(CYCLE)
        for seed in range(FIRST, FIRST + 2 * CYCLE.count(family))
    ),
]


@pytest.mark.parametrize(("family", "seed", "share"), CASES)
def test_nothing_that_happens_breaks_a_promise(family: str, seed: int, share: float) -> None:
    ticks = round(share * (JOINT_TICKS if family in SLOW else TICKS))
    one = run(family, seed, ticks)
    found = "\n".join(told(one, each) for each in one.violations)
    assert not found, f"{one.label}\n{found}\n{command(one, ticks)}"
