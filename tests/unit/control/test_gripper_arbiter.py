"""The gripper: absolute widths, newest wins, dead band, one command in flight."""

from __future__ import annotations

import pytest

from vla_zenoh.control.commanded_part import GRIPPER_STARTS_NS, GripperArbiter
from vla_zenoh.profile import GripperProfile
from vla_zenoh.types import GripperState, Header, Stamped

MS = 1_000_000
PROFILE = GripperProfile(max_width_m=0.08, speed_m_s=0.07, force_n=12.0)


def state(now_ns: int, *, moving: bool) -> Stamped[GripperState]:
    return Stamped(Header(now_ns, 0, "sim"), GripperState(0.05, moving, holding=False), now_ns)


def standing(width_m: float) -> GripperState:
    return GripperState(width_m, moving=False, holding=False)


@pytest.fixture
def gripper() -> GripperArbiter:
    arbiter = GripperArbiter(PROFILE)
    arbiter.keep(standing(0.08))
    return arbiter


def test_what_it_has_already_is_not_sent(gripper: GripperArbiter) -> None:
    assert gripper.step(0, None) is None
    gripper.request(0.08 - 0.9 * PROFILE.dead_band_m)
    assert gripper.step(0, None) is None


def test_a_new_width_is_sent_once_with_the_profiles_speed_and_force(
    gripper: GripperArbiter,
) -> None:
    gripper.request(0.03)
    command = gripper.step(0, None)
    assert command is not None
    assert (command.width_m, command.speed_m_s, command.force_n) == (0.03, 0.07, 12.0)
    assert gripper.step(4 * MS, None) is None


@pytest.mark.parametrize(("wanted_m", "sent_m"), [(-1.0, 0.0), (0.5, 0.08)])
def test_a_width_outside_is_brought_inside(
    gripper: GripperArbiter, wanted_m: float, sent_m: float
) -> None:
    gripper.keep(standing(0.04))
    gripper.request(wanted_m)
    command = gripper.step(0, None)
    assert command is not None
    assert command.width_m == sent_m


def test_small_wishes_add_up_until_they_leave_the_dead_band(gripper: GripperArbiter) -> None:
    sent = []
    for k in range(1, 11):
        gripper.request(0.08 - k * 0.0003)
        sent.append(gripper.step(0, None))
    assert [k for k, command in enumerate(sent, 1) if command] == [4]


def test_while_one_is_in_flight_only_the_last_wish_is_kept(gripper: GripperArbiter) -> None:
    gripper.request(0.0)
    assert gripper.step(0, None) is not None
    for wish in (0.05, 0.02, 0.07):
        gripper.request(wish)
        assert gripper.step(100 * MS, state(100 * MS, moving=True)) is None
    assert gripper.in_flight
    command = gripper.step(300 * MS, state(300 * MS, moving=False))
    assert command is not None
    assert command.width_m == 0.07
    assert gripper.timeouts == 0


def test_standing_still_right_after_a_command_is_not_its_end(gripper: GripperArbiter) -> None:
    gripper.request(0.0)
    gripper.step(0, None)
    gripper.request(0.08)
    assert gripper.step(10 * MS, state(10 * MS, moving=False)) is None
    late_ns = GRIPPER_STARTS_NS + 1
    assert gripper.step(late_ns, state(late_ns, moving=False)) is not None


def test_a_gripper_that_never_answers_gets_the_next_command_after_a_while(
    gripper: GripperArbiter,
) -> None:
    gripper.request(0.0)
    gripper.step(0, None)
    gripper.request(0.08)
    limit_ns = int(PROFILE.command_timeout_s * 1e9)
    assert gripper.step(limit_ns, state(limit_ns, moving=True)) is None
    assert gripper.step(limit_ns + 1, state(limit_ns, moving=True)) is not None
    assert gripper.timeouts == 1


def test_restart_takes_the_width_as_given(gripper: GripperArbiter) -> None:
    gripper.request(0.0)
    gripper.step(0, None)
    gripper.keep(standing(0.03))
    assert not gripper.in_flight
    assert gripper.step(1, None) is None
