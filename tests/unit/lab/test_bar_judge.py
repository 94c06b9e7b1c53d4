"""The bar is lifted when it is high and level for a while."""

from __future__ import annotations

import math

import numpy as np
import pytest

from vla_zenoh.errors import RecordError
from vla_zenoh.lab.tasks.judge import BarJudge, TaskJudge, judge_of
from vla_zenoh.lab.tasks.order import Order, parse_prompt
from vla_zenoh.types import ObjectPoses

LIFT = Order("lift")
TABLE_M, HIGH_M = 0.015, 0.2


def bar(height_m: float, tilt_rad: float = 0.0) -> ObjectPoses:
    turned = [0.0, math.sin(tilt_rad / 2), 0.0, math.cos(tilt_rad / 2)]
    return ObjectPoses(("bar",), np.array([[0.6, 0.0, height_m]]), np.array([turned]))


def watched(*scenes: ObjectPoses) -> BarJudge:
    judge = BarJudge(LIFT, bar(TABLE_M))
    for index, scene in enumerate(scenes):
        assert judge.update(scene, 0.0, 0.1 * index) is None
    return judge


def test_the_prompt_is_an_order_with_a_judge_of_its_own() -> None:
    order = parse_prompt("Lift the bar.")
    assert order == LIFT
    assert isinstance(judge_of(LIFT, bar(TABLE_M)), BarJudge)
    with pytest.raises(RecordError, match="tasks are done in the scene 'bricks'"):
        assert isinstance(judge_of(Order("stay"), bar(TABLE_M)), TaskJudge)


def test_it_is_done_when_the_bar_was_high_and_level_for_a_second() -> None:
    judge = watched(*[bar(HIGH_M)] * 10)
    verdict = judge.update(bar(HIGH_M), 0.0, 1.05)
    assert verdict is not None
    assert verdict.success


@pytest.mark.parametrize(
    ("scenes", "failure"),
    [
        ([bar(TABLE_M)], "not_moved"),
        ([bar(HIGH_M), bar(TABLE_M)], "dropped"),
        ([bar(HIGH_M, tilt_rad=0.5)], "tilted"),
        ([bar(HIGH_M)], "timeout"),
    ],
)
def test_a_failure_has_a_kind(scenes: list[ObjectPoses], failure: str) -> None:
    verdict = watched(*scenes).end()
    assert (verdict.success, verdict.failure) == (False, failure)


def test_a_bar_that_fell_off_the_table_fell() -> None:
    verdict = BarJudge(LIFT, bar(TABLE_M)).update(bar(-0.3), 0.0, 0.1)
    assert verdict is not None
    assert verdict.failure == "fell"


def test_a_scene_without_a_bar_is_told() -> None:
    none = ObjectPoses(("box",), np.zeros((1, 3)), np.array([[0.0, 0.0, 0.0, 1.0]]))
    with pytest.raises(RecordError, match="there is no bar"):
        BarJudge(LIFT, none)
