"""Robots that are not quite as ours: slow joint states, a controller that is off."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from vla_zenoh_ros2.bridge_config import endpoints

from vla_zenoh.errors import SessionError

ros = pytest.importorskip("ros_messages", exc_type=ImportError)

pytestmark = [pytest.mark.ros2, pytest.mark.slow]

STATE_HZ = 30
"""What joint_state_publisher sends when nobody changes its rate."""
TOKENS = "@/*/@ros2_lv/**"
CALL_S = 10.0
STEPS, STEP_M, WAY_TOLERANCE_M = 10, 0.01, 0.002


def test_joint_states_at_30_hz_are_enough(tmp_path: Path, bridge_program: Path) -> None:
    from rig import PATIENT, running_lab

    with running_lab(tmp_path, bridge_program, state_hz=STATE_HZ, timing=PATIENT) as lab:
        lab.chain.activate_when_ready()
        began_m = lab.activate_at_rest()
        lab.chain.go("up", STEPS)
        way_m = lab.witness.wait_still() - began_m
        assert way_m == pytest.approx((0, 0, STEPS * STEP_M), abs=WAY_TOLERANCE_M)


def test_the_settings_of_the_bridge_let_through_what_is_needed_and_nothing_else(
    tmp_path: Path, bridge_program: Path
) -> None:
    from panda_robot import CURRENT_POSE
    from rig import PATIENT, running_lab

    with running_lab(tmp_path, bridge_program, timing=PATIENT) as lab:
        set_active = lab.witness.node.client(
            "/vla/set_active", ros.SetBoolRequest, ros.SetBoolResponse
        )

        def activated() -> bool:
            try:
                return bool(set_active.call(True, timeout_s=CALL_S).success)
            except TimeoutError:  # a request may be lost while the bridge is still linking both
                return False

        lab.chain.until("activated", activated, 40.0)
        began_m = lab.witness.wait_still()
        lab.chain.go("up", STEPS)
        way_m = lab.witness.wait_still() - began_m
        assert way_m == pytest.approx((0, 0, STEPS * STEP_M), abs=WAY_TOLERANCE_M)
        lab.chain.client.set_prompt("HARD: close gripper x1")
        lab.chain.until("the fingers close", lambda: lab.witness.width_m() < 0.06)
        tokens = [str(reply.ok.key_expr) for reply in lab.chain.session.liveliness().get(TOKENS)]
        used = {end.name[1:].replace("/", "§") for end in endpoints(lab.chain.profile)}
        named = {name for token in tokens for name in token.split("/")[4:5]}
        assert "joint_states" in named
        assert named <= used
        assert CURRENT_POSE[1:].replace("/", "§") not in named  # which the robot says as well


def test_a_robot_whose_controller_does_not_listen_is_not_activated(
    tmp_path: Path, bridge_program: Path
) -> None:
    from rig import PATIENT, running_lab

    with running_lab(tmp_path, bridge_program, watch_goals=False, timing=PATIENT) as lab:
        lab.chain.activate_when_ready()
        lab.move()
        lab.robot.switch_controller()
        lab.chain.until("inactive", lambda: lab.chain.state() == "inactive")
        stood_m = lab.witness.wait_still()
        with pytest.raises(SessionError, match="not listening at /panda/"):
            lab.chain.client.activate()
        lab.robot.switch_controller()
        # What was sent while nobody listened is not taken for where the arm is held.
        assert np.linalg.norm(lab.activate_at_rest() - stood_m) < WAY_TOLERANCE_M
