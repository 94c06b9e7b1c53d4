"""The impedance law on the simulated arm: following, friction, pressing."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from made_arm import made_arm
from motions import circle, follow, line, make_world, still, wait

from vla_zenoh.profile import override
from vla_zenoh.simulation.impedance import ImpedanceGains
from vla_zenoh.simulation.pace import MAX_STEPS
from vla_zenoh.simulation.scene import STEP_S
from vla_zenoh.simulation.world import build_world

FOLLOW_LIMIT_M = 1e-3
FOLLOW_LIMIT_RAD = 5e-3
FRICTION_NM = 0.5
FRICTION_LIMIT_M = 5e-4
SETTLE_S = 3.0
ASIDE_M = (0.1, -0.2, -0.05)
REST_LIMIT_M = 2e-5
PRESS_SLACK_N = 0.5
PRESS_MOVING_N = 10.0  # what a reference that still moves adds through the damping
IMPACT_S = 0.1  # a moving arm that hits hard wood has to be stopped first
TABLE_MARGIN_M = 1e-3
FINGERTIP_BELOW_TCP_M = 0.0095
LIGHT_WAY_M = (0.0, 0.0, 0.03)
LIGHT_REST_RAD_S = 0.01

COMPLIANT = ImpedanceGains(
    translational_n_m=400.0, rotational_nm_rad=20.0, max_error_m=0.06, max_error_rad=0.5
)


@pytest.mark.parametrize("gains", [ImpedanceGains(), COMPLIANT])
def test_a_turning_circle_is_followed_within_a_millimetre(gains: ImpedanceGains) -> None:
    world = make_world(gains)
    start = world.hold_reference()
    reference, worst_m, worst_rad = follow(world, circle(start, 0.08, 0.4, 3.0, 1.0))
    assert worst_m < FOLLOW_LIMIT_M
    assert worst_rad < FOLLOW_LIMIT_RAD
    assert world.saturated == 0
    wait(world, reference, 2.0)
    assert np.linalg.norm(world.tcp()[0] - start.position_m) < REST_LIMIT_M


def test_integral_action_overcomes_joint_friction() -> None:
    world = make_world(friction_nm=FRICTION_NM)
    reference, _, _ = follow(world, line(world.hold_reference(), ASIDE_M, 1.0))
    wait(world, reference, SETTLE_S)
    assert np.linalg.norm(world.tcp()[0] - reference.position_m) < FRICTION_LIMIT_M


def test_without_integral_action_friction_leaves_a_larger_error() -> None:
    world = make_world(ImpedanceGains(integral_1_s=0.0), friction_nm=FRICTION_NM)
    reference, _, _ = follow(world, line(world.hold_reference(), ASIDE_M, 1.0))
    wait(world, reference, 1.0)
    assert np.linalg.norm(world.tcp()[0] - reference.position_m) > 2 * FRICTION_LIMIT_M


@pytest.mark.parametrize("gains", [ImpedanceGains(), COMPLIANT])
@pytest.mark.parametrize("duration_s", [0.4, pytest.param(2.0, marks=pytest.mark.long)])
def test_pressing_into_the_table_is_bounded(gains: ImpedanceGains, duration_s: float) -> None:
    world = make_world(gains)
    bound = gains.translational_n_m * gains.max_error_m + gains.max_integral_n
    pressed: list[float] = []
    start = world.hold_reference()
    down = list(line(start, (0.0, 0.0, -0.25), duration_s))
    for reference in down + 800 * [still(down[-1])]:
        world.tick(reference)
        pressed.append(float(world.wrench()[2]))
    touch = int(np.flatnonzero(pressed)[0])
    assert max(pressed[touch + round(IMPACT_S / STEP_S) :]) < bound + PRESS_MOVING_N
    assert pressed[-1] < bound + PRESS_SLACK_N
    assert pressed[-1] > 0.5 * gains.translational_n_m * gains.max_error_m
    assert abs(world.tcp()[0][2] - FINGERTIP_BELOW_TCP_M) < TABLE_MARGIN_M


def test_after_pressing_the_arm_comes_back_without_a_lasting_error() -> None:
    world = make_world()
    start = world.hold_reference()
    down, _, _ = follow(world, line(start, (0.0, 0.0, -0.25), 0.5))
    wait(world, down, 0.5)
    back, _, _ = follow(world, line(down, (0.0, 0.0, 0.25), 0.5))
    wait(world, back, 3.0)
    assert np.linalg.norm(world.tcp()[0] - start.position_m) < REST_LIMIT_M


def test_a_reference_that_jumps_away_pulls_with_a_bounded_force() -> None:
    gains = ImpedanceGains()
    world = make_world(gains)
    far = world.hold_reference()
    far = far._replace(position_m=far.position_m + (0.3, 0.0, 0.2))
    speeds = []
    for _ in range(200):
        world.tick(far)
        speeds.append(np.linalg.norm(world.pose_state(far).twist[:3]))
    assert max(speeds) < 0.5  # 40 N against critical damping of some 200 Ns/m


@pytest.mark.parametrize("steps", [1, 2, MAX_STEPS])
@pytest.mark.parametrize("length_m", [0.15, 0.5, 1.0])
@pytest.mark.parametrize(
    ("chain", "home_rad"),
    [("sztytz", [0.25, 0.1, 0.1]), ("tztytytytxtytz", [0.1, -0.6, 1.0, 0.6, 0.1, 0.5, 0.1])],
)
def test_an_arm_whose_links_have_a_few_grams_is_moved_and_comes_to_rest(
    tmp_path: Path, chain: str, home_rad: list[float], length_m: float, steps: int
) -> None:
    made = made_arm(tmp_path, chain, length_m)
    world = build_world(override(made, {"robot": {"home_rad": home_rad}}))
    start = world.hold_reference()
    up = list(line(start, LIGHT_WAY_M, 1.0))
    for reference in up[::steps]:
        world.tick(reference, steps)
    end = still(up[-1])
    for _ in range(round(1.0 / STEP_S / steps)):
        world.tick(end, steps)
    assert np.linalg.norm(world.tcp()[0] - end.position_m) < FOLLOW_LIMIT_M
    assert np.abs(world.joint_state().velocity_rad_s).max() < LIGHT_REST_RAD_S
