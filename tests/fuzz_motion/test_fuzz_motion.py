"""Whatever policies, people and networks do, commands and references keep what is promised.

The same runs, for longer and of other seeds: ``make fuzz-motion``.
"""

from __future__ import annotations

import numpy as np
import pytest
from fuzz_motion import CYCLE, command, run, told
from motion_case import FAMILIES, IN_JOINTS, make_case
from motion_rig import Rig

from vla_zenoh.control.motion_pipeline import MotionPipeline

TICKS, JOINT_TICKS = 10_000, 6_000
"""Kinematics take their time."""
PARITY_TICKS = 2_000
SLOW = ("joint", "joint net", "reach", *IN_JOINTS)
FIRST, SHORT = 101, 0.4
CASES = [
    *(pytest.param(family, FIRST, SHORT) for family in dict.fromkeys(CYCLE)),
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


@pytest.mark.parametrize("family", dict.fromkeys(FAMILIES))
def test_a_tick_computed_before_it_is_due_gives_the_commands_that_it_would_give_then(
    family: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    ticks, seed = PARITY_TICKS, FIRST + CYCLE.index(family)
    ahead = Rig(make_case(family, seed)).run(ticks)
    monkeypatch.setattr(MotionPipeline, "_tick_ahead", lambda *_: None)
    then = Rig(make_case(family, seed)).run(ticks)
    assert ahead.failed is then.failed is None
    assert len(ahead.ticks) == len(then.ticks) == ticks
    assert sum(tick.record is not None for tick in then.ticks) > ticks // 10
    for one, other in zip(ahead.ticks, then.ticks, strict=True):
        assert (one.time_ns, one.state) == (other.time_ns, other.state)
        assert type(one.record) is type(other.record)
        for name in getattr(type(one.record), "__match_args__", ()):
            value, expected = getattr(one.record, name), getattr(other.record, name)
            np.testing.assert_array_equal(value, expected, err_msg=name)
