"""What the gripper holds is kept from table and arms as the links are; all figures are MuJoCo's."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest
from arm_rig import begin, check_motion, path_m, shipped
from pair_rig import PARTS, Pair, tcp_steps
from pair_rig import shipped as shipped_pair
from vla_zenoh_benchmarks.lockstep.loop import Lockstep

from vla_zenoh.kinematics.collision import HELD
from vla_zenoh.types import HeldBox

BAR = HeldBox((0.04, 0.04, 0.2))
DOWN = "0 0 -0.02"
LAG_M = 3e-3
"""The measured arm may be this much further than it is commanded."""


@pytest.fixture
def loop() -> Iterator[Lockstep]:
    found = begin(bounded=True)
    yield found
    found.commander.parts[0].hold(None)  # all tests share one model of the arm


def bottom_m(loop: Lockstep) -> float:
    return float(path_m(loop)[:, 2].min()) - BAR.size_m[2] / 2


def test_a_held_bar_stops_above_the_table(loop: Lockstep) -> None:
    loop.put("held", BAR)
    loop.put("prompt", DOWN)
    loop.run(2.0)
    reach = shipped().limits.reach
    assert reach.table_z_m is not None
    assert bottom_m(loop) > reach.table_z_m + reach.table_stop_m - LAG_M
    assert bottom_m(loop) < reach.table_z_m + reach.table_stop_m + 0.02
    assert loop.commander.state.value == "active"
    limits = [event.why for event in loop.events if event.what == "table_distance"]
    assert any(HELD in why for why in limits)
    check_motion(loop)


def test_a_bar_that_is_grasped_on_the_table_is_lifted(loop: Lockstep) -> None:
    table_z_m = shipped().limits.reach.table_z_m
    assert table_z_m is not None
    height_m = float(path_m(loop)[-1, 2]) - table_z_m
    loop.put("held", HeldBox((0.04, 0.04, 2 * height_m + 0.01)))  # 5 mm inside the table
    loop.run(0.2)
    before_m = float(path_m(loop)[-1, 2])
    loop.put("prompt", "0 0 0.02")
    loop.run(0.9)
    assert path_m(loop)[-1, 2] > before_m + 0.1
    assert loop.commander.state.value == "active"


def test_what_is_let_go_bounds_the_arm_no_more(loop: Lockstep) -> None:
    loop.put("held", BAR)
    loop.put("prompt", "0 0 0 -0.01")
    loop.run(0.8)
    assert loop.commander.parts[0].held == BAR  # closing is no letting go
    loop.put("prompt", "0 0 0 0.01")
    loop.run(0.8)
    assert loop.commander.parts[0].held is None
    said = [event.why for event in loop.events if event.what == "gripper_holds"]
    assert said == ["the gripper holds a box of 0.04 0.04 0.2 m", "the gripper holds nothing"]


def towards_each_other(_: int) -> dict[str, np.ndarray]:
    return dict.fromkeys(PARTS, np.array([0.02, 0.0, 0.0, 0.0, 0.0, 0.0, 0.04]))


@pytest.mark.long
def test_an_arm_keeps_away_from_what_the_other_holds() -> None:
    pair = Pair(towards_each_other, tcp_steps())
    left = pair.commander.parts[0]
    try:
        pair.loop.put("held", HeldBox((0.2, 0.2, 0.05)), part="left")
        pair.run(6.0)
        assert pair.commander.spacing is not None
        nearest = pair.commander.spacing.nearest
        assert HELD in nearest.first
        stop_m = shipped_pair().limits.reach.part_stop_m
        assert stop_m - 1e-3 <= nearest.distance_m < stop_m + 0.02
    finally:
        left.hold(None)
