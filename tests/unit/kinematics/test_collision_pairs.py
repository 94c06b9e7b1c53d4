"""Which pairs of an arm are checked: all that can touch, however rarely the samples see it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from described_arms import SEVEN, TOOL, Row, arm, urdf

from vla_zenoh.kinematics.collision import CollisionModel
from vla_zenoh.kinematics.kinematics import Kinematics

NEAR_M = 0.05
JOINTS = tuple(f"j{n}" for n in range(1, 8))


@pytest.mark.parametrize("seed", range(6))
def test_what_only_few_configurations_touch_is_checked(tmp_path: Path, seed: int) -> None:
    """Small things of the robot's own body, each where some configuration has the TCP."""
    rows = [*arm(SEVEN), TOOL]
    path = tmp_path / "arm.urdf"
    path.write_text(urdf(rows))
    kinematics = Kinematics(path, "tcp", JOINTS)
    random = np.random.default_rng(seed)
    span_rad = kinematics.upper_rad - kinematics.lower_rad
    for number in range(4):
        joints_rad = kinematics.lower_rad + span_rad * random.random(kinematics.size)
        x, y, z = kinematics.forward(joints_rad).position_m.tolist()
        rows.append(Row(f"to_{number}", parent="base", kind="fixed", at_m=(x, y, z)))
    path.write_text(urdf(rows))
    pairs = CollisionModel(Kinematics(path, "tcp", JOINTS), near_m=NEAR_M).pairs
    for number in range(4):
        assert any({pair.first, pair.second} == {"tcp", f"to_{number}_link"} for pair in pairs)
