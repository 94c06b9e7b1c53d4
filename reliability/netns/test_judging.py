"""A row of the bench of faults is wrong when the arm was braked too late, whatever it did then."""

from __future__ import annotations

import numpy as np
import pytest
from netns.flight_log import Flight
from netns.measure import Span, judge, measure_motion
from netns.rows import Fault, Row

from vla_zenoh.profile import load_profile

PROFILE = load_profile("panda_sim")
SPEED_M_S = 0.1
BEGAN_S, LAST_CHUNK_S, ENDED_S, REST_S = 1.0, 2.0, 8.0, 9.0
IN_TIME_S, TOO_LATE_S = 0.4, 2.0
"""After the last chunk, where 0.5 s and a brake are allowed."""
ROBOT_IN_TIME_S, ROBOT_TOO_LATE_S = 0.15, 0.6
"""After the last command or state, where 0.1 or 0.15 s and a brake are allowed."""
TOLERANCE_S = 0.02


def flight(period_s: float, stands_s: float, silent_s: float = np.inf) -> Flight:
    """Up at `SPEED_M_S` until it stands; chunks until the last one; nothing heard any more."""
    time_s = np.arange(0.0, REST_S + 1.0, period_s)
    twist = np.zeros((len(time_s), 6))
    twist[:, 2] = np.where(time_s < stands_s, SPEED_M_S, 0.0)
    position_m = np.zeros((len(time_s), 3))
    position_m[:, 2] = np.cumsum(twist[:, 2]) * period_s
    asked_s = np.minimum(np.floor(time_s * 10) / 10, LAST_CHUNK_S)
    heard_s = np.minimum(time_s, silent_s)
    return Flight(time_s, position_m, twist, np.zeros((len(time_s), 3)), asked_s, heard_s)


def fault(*, alone: bool = False, seconds: float | None = None, goes_on: bool = False) -> Fault:
    return Fault(
        *("it", "a fault", lambda _: None, lambda _: None),
        alone=alone,
        seconds=seconds,
        goes_on=goes_on,
    )


def row(
    suffered: Fault,
    stands_s: float,
    *,
    done: bool = False,
    silent_s: float = np.inf,
    state_silent_s: float = np.inf,
) -> Row:
    made = Row("it", "a fault")
    measure_motion(
        made,
        suffered,
        PROFILE,
        flight(0.005, stands_s, silent_s),
        flight(0.004, stands_s, state_silent_s),
        Span(BEGAN_S, ENDED_S, REST_S),
        done=done,
    )
    # These flights change their speed in no time; only when is asked here.
    made.acceleration = made.jerk = 0.0
    judge(made, suffered, {"done": done} if suffered.seconds is None else {}, {})
    return made


@pytest.mark.parametrize("alone", [False, True])
@pytest.mark.parametrize("seconds", [None, 5.0])
def test_an_arm_that_stands_in_time_breaks_no_promise(alone: bool, seconds: float | None) -> None:
    stands_s = LAST_CHUNK_S + IN_TIME_S
    if alone and seconds is not None:
        stands_s = BEGAN_S + ROBOT_IN_TIME_S
    found = row(fault(alone=alone, seconds=seconds), stands_s)
    assert found.wrong == []
    assert found.stood_s == pytest.approx(stands_s - BEGAN_S, abs=TOLERANCE_S)
    assert found.braked_s is not None


@pytest.mark.parametrize("alone", [False, True])
def test_a_bad_link_that_lets_the_arm_run_on_is_wrong(alone: bool) -> None:
    found = row(fault(alone=alone), LAST_CHUNK_S + TOO_LATE_S)
    assert found.braked_s == pytest.approx(TOO_LATE_S, abs=TOLERANCE_S)
    assert [what[:12] for what in found.wrong] == ["stood after "]


def test_an_arm_that_ran_on_without_chunks_is_wrong_also_if_it_came_to_its_goal() -> None:
    found = row(fault(), LAST_CHUNK_S + TOO_LATE_S, done=True)
    assert found.stood_s is None
    assert [what[:12] for what in found.wrong] == ["stood after "]


def test_a_dead_link_under_which_the_arm_never_stands_is_wrong() -> None:
    assert row(fault(seconds=5.0), REST_S + 1.0).wrong != []


@pytest.mark.parametrize("node", ["sim", "command"])
def test_an_arm_that_runs_on_while_its_own_side_hears_nothing_is_wrong(node: str) -> None:
    def silent_for(silent_s: float) -> Row:
        since_s = LAST_CHUNK_S + IN_TIME_S - silent_s
        return row(
            fault(alone=True),
            LAST_CHUNK_S + IN_TIME_S,
            silent_s=since_s if node == "sim" else np.inf,
            state_silent_s=since_s if node == "command" else np.inf,
        )

    assert silent_for(ROBOT_IN_TIME_S).wrong == []
    (what,) = silent_for(ROBOT_TOO_LATE_S).wrong
    assert f"after {node} had last heard" in what


def test_an_arm_that_is_to_go_on_may_not_stand_on_its_way() -> None:
    suffered = fault(seconds=5.0, goes_on=True)
    found = row(suffered, LAST_CHUNK_S + IN_TIME_S)
    assert found.wrong == [f"stood on its way after {LAST_CHUNK_S + IN_TIME_S - BEGAN_S:.1f} s"]
