"""The speed override in time: pauses, slow plans, clocks that are set, values that are repeated."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from command_rig import Rig, profile
from joint_rig import Joints, panda
from panda_arm import HOME_RAD

from vla_zenoh.control.commander import Setting
from vla_zenoh.control.step_timing import MIXED

STEP_M, DT_S = 0.02, 0.2
TEN_STEPS = [[STEP_M, 0, 0, 0, 0, 0, 0]] * 10
SAME_M = 1e-6


def moving_rig() -> Rig:
    """An arm in the sixth of ten steps."""
    rig = Rig(dt_s=DT_S)
    rig.activate()
    rig.run(0.2)
    rig.send(TEN_STEPS)
    rig.run(1.2)
    return rig


@pytest.mark.parametrize("minutes", [0.1, 11.0])
def test_after_a_pause_the_rest_of_an_old_chunk_is_not_carried_out(minutes: float) -> None:
    rig = moving_rig()
    rig.put("speed", 0.0)
    rig.run(1.0)
    stands_m = rig.position_m.copy()
    rig.now_ns += round(minutes * 60e9)
    rig.tick()
    rig.put("speed", 50.0)
    rig.run(1.0)
    np.testing.assert_allclose(rig.position_m, stands_m, atol=SAME_M)
    assert rig.state == "active"
    rig.send([[0.0, 0, STEP_M, 0, 0, 0, 0]])
    rig.run(1.5)
    np.testing.assert_allclose(rig.position_m - stands_m, [0, 0, STEP_M], atol=SAME_M)


@pytest.mark.parametrize("shut_from", [0, 1])
def test_after_a_pause_the_gripper_stays_as_it_was_told(shut_from: int) -> None:
    """The pause begins within the step that shuts it: half open it would let go."""
    rig = Rig(dt_s=DT_S, gripper="absolute_m")
    rig.activate()
    rig.send([[0.0, 0, STEP_M, 0, 0, 0, 0.08 if k < shut_from else 0.0] for k in range(10)])
    rig.run((shut_from + 0.5) * DT_S)
    assert rig.widths_m[-1:] == [0.0]
    rig.put("speed", 0.0)
    rig.run(1.0)
    rig.put("speed", 50.0)
    rig.run(1.0)
    assert rig.widths_m[-1:] == [0.0]


def test_after_a_pause_without_a_chunk_the_watchdog_brakes() -> None:
    rig = moving_rig()
    rig.put("speed", 0.0)
    rig.run(5.0)
    assert rig.state == "active"
    rig.put("speed", 100.0)
    rig.run(2.0)
    assert rig.state == "holding"


def test_a_plan_that_lasts_longer_than_any_record_of_overrides_never_goes_back() -> None:
    rig = Rig(profile(timing={"max_open_loop_s": 60.0, "watchdog_s": 5.0}), dt_s=6.0)
    rig.activate()
    rig.run(0.2)
    start_m = rig.position_m.copy()
    rig.send(TEN_STEPS)
    rig.run(2.0)
    gone_m = 0.0
    for percent in (5.0, 4.0, 3.0):
        rig.put("speed", percent)
        rig.now_ns += 200_000_000_000
        rig.run(0.5)
        now_m = float((rig.position_m - start_m)[0])
        assert now_m >= gone_m - SAME_M
        gone_m = now_m


def test_a_value_that_is_repeated_does_not_put_off_the_watchdog() -> None:
    rig = Rig(profile(timing={"max_hold_s": 5.0}), dt_s=DT_S)
    rig.activate()
    rig.send([[STEP_M, 0, 0, 0, 0, 0, 0]])
    for _ in range(8):
        rig.put("speed", 100.0)
        rig.put("slower", 100.0)
        rig.run(0.2)
    assert rig.state == "holding"
    for _ in range(26):
        rig.put("speed", 100.0)
        rig.run(0.2)
    assert rig.state == "inactive"


def test_changing_values_do_not_put_off_the_watchdog() -> None:
    rig = Rig(dt_s=DT_S)
    rig.activate()
    rig.send([[STEP_M, 0, 0, 0, 0, 0, 0]])
    for count in range(20):
        rig.put("speed", 100.0 if count % 2 else 90.0)
        rig.run(0.1)
    assert rig.state == "holding"


def test_the_override_holds_after_the_clock_was_set_back() -> None:
    rig = Rig(dt_s=DT_S)
    rig.activate()
    rig.put("speed", 30.0)
    rig.run(0.5)
    rig.now_ns -= 600_000_000_000
    rig.tick(Setting("lose", "the wall clock was set"))
    rig.run(1.0)
    rig.activate()
    rig.run(0.2)
    start_m = rig.position_m.copy()
    rig.send([[0.01, 0, 0, 0, 0, 0, 0]] * 10)
    rig.run(1.0)
    assert 0 < (rig.position_m - start_m)[0] < 0.015


def test_at_speed_zero_the_gripper_waits() -> None:
    rig = Rig(dt_s=DT_S)
    rig.activate()
    rig.send([[0, 0, 0, 0, 0, 0, -0.02]])
    rig.run(0.05)
    rig.gripper = replace(rig.gripper, moving=True)
    rig.send([[0, 0, 0, 0, 0, 0, -0.04]])
    rig.put("speed", 0.0)
    rig.run(0.3)
    sent = len(rig.widths_m)
    rig.gripper = replace(rig.gripper, moving=False)
    rig.run(0.5)
    assert len(rig.widths_m) == sent
    rig.put("speed", 100.0)
    rig.run(0.2)
    assert len(rig.widths_m) == sent + 1


@pytest.mark.parametrize("command", ["joint", "pose"])
def test_after_a_pause_joints_wait_for_a_new_chunk_as_poses_do(command: str) -> None:
    arm = Joints(panda(command))
    arm.activate()
    goal_rad = HOME_RAD + [0.5, 0, -0.2, 0, 0.2, 0, 0]
    arm.send(*(HOME_RAD + share * (goal_rad - HOME_RAD) for share in np.linspace(0, 1, 17)[1:]))
    arm.run(0.6)
    arm.tick(Setting("speed", 0.0))
    arm.run(1.0)
    stands_m = arm.places_m[-1]
    assert 1e-3 < np.abs(arm.joints_rad - HOME_RAD).max() < 0.49
    arm.tick(Setting("speed", 100.0))
    arm.run(0.5)
    assert arm.rig.state == "active"
    np.testing.assert_allclose(arm.places_m[-1], stands_m, atol=1e-4)
    arm.send(goal_rad)
    arm.settle(goal_rad)


@pytest.mark.parametrize(("percent", "seed"), [(50.0, 0), (20.0, 1), (5.0, 2)])
def test_accelerations_are_those_of_the_override_however_goals_turn_and_move(
    percent: float, seed: int
) -> None:
    """Axes of a rotation mix at every goal: none that is a little too fast frees all others."""
    rng = np.random.default_rng(seed)
    rig = Rig(dt_s=0.1)
    rig.put("speed", percent)
    rig.activate()
    rig.run(0.2)
    for _ in range(40):
        step = rng.uniform(-1, 1, 6) * [STEP_M, STEP_M, STEP_M, 0.1, 0.1, 0.1]
        rig.send([[*step, 0.0]] * 6)
        rig.run(0.1)
    limits, share = rig.profile.limits, (percent / 100.0) ** 2
    reached = np.abs([command.acceleration for command in rig.commands])
    assert reached[:, :3].max() <= MIXED * share * limits.translation.acceleration_m_s2
    assert reached[:, 3:].max() <= MIXED * share * limits.rotation.acceleration_rad_s2
    assert reached[:, :3].max() > 0.5 * share * limits.translation.acceleration_m_s2
