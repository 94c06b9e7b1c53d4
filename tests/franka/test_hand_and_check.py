"""The Franka Hand, and `vla-zenoh robot check`, against franka-sim."""

from __future__ import annotations

import time
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from typing import Any

import pytest
from camera_rig import until
from franka_rig import Simulator, simulator
from vla_zenoh_franka.check import fci_arm
from vla_zenoh_franka.hand import Hand

from vla_zenoh.profile import Profile, load_profile, override

WIDTH_M, EXACT_M = 0.03, 0.004
CALL_S = 0.002
"""A call of the loop may take no longer."""

pytestmark = pytest.mark.timeout(120)


@pytest.fixture(scope="module")
def robot() -> Iterator[Simulator]:
    with simulator("--gripper-object-width", str(WIDTH_M)) as running:
        yield running


@pytest.fixture
def hand(robot: Simulator) -> Iterator[Hand]:
    hand = Hand(import_module("franky").Gripper("127.0.0.1"))
    hand.ask(0.08, 0.1, 0.0)
    until("the hand is open", lambda: not hand.state().moving and hand.state().width_m > 0.07)
    yield hand
    hand.close()


def standing(hand: Hand, width_m: float) -> bool:
    state = hand.state()
    return not state.moving and abs(state.width_m - width_m) < EXACT_M


def test_the_hand_moves_to_a_width(hand: Hand) -> None:
    hand.ask(0.05, 0.1, 0.0)
    until("it is there", lambda: standing(hand, 0.05))
    assert not hand.state().holding


def test_a_grasp_holds_what_is_between_the_fingers_and_lets_it_go(hand: Hand) -> None:
    hand.ask(0.0, 0.1, 20.0)
    until("it holds", lambda: hand.state().holding)
    assert hand.state().width_m == pytest.approx(WIDTH_M, abs=EXACT_M)
    hand.ask(0.08, 0.1, 0.0)
    until("it is open", lambda: standing(hand, 0.08))
    assert not hand.state().holding


def test_requests_at_20_hz_never_wait_nor_stack_and_the_newest_wins(hand: Hand) -> None:
    longest_s = 0.0
    for number in range(100):
        began_s = time.perf_counter()
        hand.ask(0.06 if number % 2 else 0.07, 0.1, 10.0)
        hand.state()
        longest_s = max(longest_s, time.perf_counter() - began_s)
        time.sleep(0.05)
    hand.ask(0.04, 0.1, 10.0)
    until("it does the last one", lambda: standing(hand, 0.04), 3.0)
    time.sleep(1.0)
    assert standing(hand, 0.04)
    assert not hand.fault
    print(f"\nlongest call {1e3 * longest_s:.2f} ms")


@pytest.fixture
def profile(tmp_path: Path) -> Profile:
    path = tmp_path / "lab.yaml"
    path.write_text("extends: fr3\nfranka: {address: 127.0.0.1, realtime: ignore}\n")
    return load_profile(str(path))


def levels(profile: Profile) -> dict[str, str]:
    return {finding.name: finding.level for finding in fci_arm(profile, profile.driver_options)}


def test_the_arm_agrees_with_its_profile(robot: Simulator, profile: Profile) -> None:
    found = levels(profile)
    assert found["flange"] == found["description"] == found["joint ranges"] == "ok", found
    assert found["limits"] == found["connection"] == "ok", found


def test_joint_ranges_beyond_the_robots_are_found(robot: Simulator, profile: Profile) -> None:
    wide: Any = override(profile, {"robot": {"joint_range_rad": []}})
    assert levels(wide)["joint ranges"] == "fail"
