"""What the simulated arm presses with, on what gives way and what does not, by poses and by joints.

The rows are those of benchmarks/contact.py, of which these are the quick ones.
"""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from vla_zenoh.kinematics.so3 import norm3
from vla_zenoh.profile import load_profile
from vla_zenoh.simulation.world import WRENCH_FILTER_S, World, build_world

pytestmark = pytest.mark.long

LASTING_N = 5.0
HELD_N, WEIGHT_N = 5.0, 0.5
QUASI_STATIC_HAND_N = 140.0
"""ISO/TS 15066:2016, table A.2."""


@pytest.fixture(scope="module")
def bench() -> ModuleType:
    path = Path(__file__).parents[2] / "benchmarks" / "contact.py"
    spec = importlib.util.spec_from_file_location("contact_bench", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize(
    ("obstacle", "mode", "speed_m_s", "told"),
    [
        ("fixed wall", "pose", 0.1, True),
        ("fixed wall", "joint", 0.1, True),
        ("fixed wall", "joint", 0.1, False),
        ("table", "pose", 0.4, False),
        ("clamped hand", "joint", 0.4, True),
    ],
)
def test_an_arm_that_was_blocked_presses_no_more(
    bench: ModuleType, obstacle: str, mode: str, speed_m_s: float, told: bool
) -> None:
    pushed = next(each for each in bench.OBSTACLES if each.name.startswith(obstacle))
    row = bench.push(pushed, mode, speed_m_s, told=told)
    assert row.peak_n > LASTING_N  # it did touch
    assert row.lasting_n < LASTING_N
    assert row.event.startswith("contact_force" if told else "tracking")


@pytest.mark.parametrize("mode", ["pose", "joint"])
def test_a_hand_that_is_touched_slowly_is_not_pressed(bench: ModuleType, mode: str) -> None:
    hand = next(each for each in bench.OBSTACLES if "hand" in each.name)
    assert bench.push(hand, mode, 0.1).mean_peak_n < QUASI_STATIC_HAND_N / 2


# -- what the simulator tells ---------------------------------------------------------------------
def waited(world: World, seconds: float) -> np.ndarray:
    reference = world.hold_reference()
    for _ in range(round(seconds * 1e3)):
        world.tick(reference)
    wrench = world.pose_state(reference).wrench
    assert wrench is not None
    return wrench


def test_a_free_arm_tells_no_force_whatever_its_fingers_squeeze() -> None:
    world = build_world(load_profile("panda_sim"))
    assert norm3(waited(world, 0.3)[:3]) < 1e-9
    position_m, _ = world.tcp()
    world.set_gripper(0.08, 0.1, 25.0)
    world.place("brick", position_m)
    world.set_gripper(0.0, 1.0, 25.0)
    told = waited(world, 0.6)
    assert world.gripper_state().holding
    assert world.parts[""].gripper.force_n > HELD_N
    assert norm3(told[:3]) < WEIGHT_N
    assert told[2] == pytest.approx(-0.012 * 9.81, rel=0.05)


def test_what_is_told_of_a_contact_is_filtered_and_the_same_in_the_end() -> None:
    profile = load_profile("panda_sim")
    world = build_world(profile)
    x_m, y_m, z_m = world.tcp()[0]
    world.place("box", (x_m, y_m + 0.169, z_m + 0.05))  # its wall, a little into the hand
    reference = world.hold_reference()
    world.tick(reference)
    first = world.pose_state(reference).wrench
    assert first is not None
    at_once = world.wrench()
    assert norm3(at_once[:3]) > 0.0
    np.testing.assert_allclose(first, 1e-3 / WRENCH_FILTER_S * at_once, rtol=0.01, atol=1e-5)
    for _ in range(3000):
        world.tick(reference)
    told = world.pose_state(reference).wrench
    assert told is not None
    assert told[1] < 0.0  # it is pushed away from what stands at its side
    np.testing.assert_allclose(told, world.wrench(), atol=0.5)
