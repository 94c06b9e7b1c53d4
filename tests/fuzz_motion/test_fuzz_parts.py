"""Two arms under one policy never come nearer to each other than they may."""

from __future__ import annotations

import pytest
from fuzz_parts import TOLERANCE_M, least_m
from pair_rig import shipped


@pytest.mark.long
@pytest.mark.parametrize(
    ("seed", "ticks"),
    [
        pytest.param(1038, 660, id="a brake on a curve"),
        pytest.param(2042, 1050, id="joints that lag behind the pose"),
    ],
)
def test_arms_whose_stops_were_once_predicted_too_short_stay_apart(seed: int, ticks: int) -> None:
    least, _ = least_m("tcp", seed, ticks)
    assert least >= shipped().limits.reach.part_stop_m - TOLERANCE_M
