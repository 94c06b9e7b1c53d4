"""Joint states as slow as joint_state_publisher sends them when nobody changes its rate."""

from __future__ import annotations

from pathlib import Path

import pytest

pytest.importorskip("ros_messages", exc_type=ImportError)

pytestmark = [pytest.mark.ros2, pytest.mark.slow]

STATE_HZ = 30
STEPS, STEP_M, WAY_TOLERANCE_M = 10, 0.01, 0.002


def test_joint_states_at_30_hz_are_enough(tmp_path: Path, bridge_program: Path) -> None:
    from rig import running_lab

    with running_lab(tmp_path, bridge_program, state_hz=STATE_HZ) as lab:
        began_m = lab.activate_at_rest()
        lab.chain.go("up", STEPS)
        ended_m = lab.witness.wait_still()
        way_m = ended_m - began_m
        assert way_m == pytest.approx((0, 0, STEPS * STEP_M), abs=WAY_TOLERANCE_M)
