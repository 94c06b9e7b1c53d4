"""The robot's side of gripper orders: foreign ones, old ones, repeated ones, too great ones."""

from __future__ import annotations

import pytest

from vla_zenoh.errors import CodecError
from vla_zenoh.guard.arm_guard import MAX_SOURCES, OLDEST_NS, GripperGuard
from vla_zenoh.profile import load_profile
from vla_zenoh.types import GripperCommand, Header, Stamped

GRIPPER = load_profile("panda_sim").robot.gripper
HOUR_NS = 3_600_000_000_000
ORDER = GripperCommand(0.02, 0.05, 10.0)


def order(
    seq: int, source: str = "command#1", asked: GripperCommand = ORDER, at_ns: int = 0
) -> Stamped[GripperCommand]:
    return Stamped(Header(at_ns, seq, source), asked, at_ns)


@pytest.fixture
def guard() -> GripperGuard:
    return GripperGuard(GRIPPER)


def take(
    guard: GripperGuard,
    given: Stamped[GripperCommand],
    writer: str = "",
    late_ns: int = 0,
    *,
    leads: bool = True,
) -> GripperCommand:
    return guard.accept(given, writer, given.header.stamp_wall_ns + late_ns, writer_active=leads)


def refusal(guard: GripperGuard, given: Stamped[GripperCommand], writer: str = "") -> str:
    with pytest.raises(CodecError) as caught:
        take(guard, given, writer)
    return caught.value.reason


def test_an_order_that_comes_again_is_refused_however_much_later(guard: GripperGuard) -> None:
    assert take(guard, order(5), "command#1") == ORDER
    assert refusal(guard, order(5, at_ns=HOUR_NS)) == "replayed"
    assert refusal(guard, order(4, at_ns=HOUR_NS), "command#1") == "replayed"
    assert take(guard, order(6), "command#1") == ORDER


def test_an_order_comes_again_in_vain_after_somebody_else_gave_one(guard: GripperGuard) -> None:
    take(guard, order(5), "")
    take(guard, order(0, "command#2"), "")
    assert refusal(guard, order(5)) == "replayed"


def test_only_who_moves_the_arm_may_move_the_gripper(guard: GripperGuard) -> None:
    stranger = order(7, "stranger#1")
    assert refusal(guard, stranger, "command#1") == "foreign"
    assert take(guard, stranger, "") == ORDER, "what was refused was not used up"


def test_no_order_goes_beyond_the_profile_and_it_is_counted(guard: GripperGuard) -> None:
    given = take(guard, order(1, asked=GripperCommand(1.0, 10.0, 1000.0)))
    assert given == GripperCommand(GRIPPER.max_width_m, GRIPPER.speed_m_s, GRIPPER.force_n)
    assert guard.bounded == 1
    take(guard, order(2), "")
    assert guard.bounded == 1


def test_a_flood_of_made_up_sources_is_not_kept_and_who_speaks_on_is_remembered(
    guard: GripperGuard,
) -> None:
    for number in range(3 * MAX_SOURCES):
        take(guard, order(number), "")
        take(guard, order(0, f"stranger#{number}"), "")
    assert refusal(guard, order(3 * MAX_SOURCES - 1)) == "replayed"
    assert take(guard, order(0, "stranger#0"), "") == ORDER


def test_an_order_that_waited_too_long_on_its_way_is_not_carried_out(guard: GripperGuard) -> None:
    assert take(guard, order(1), late_ns=OLDEST_NS) == ORDER
    with pytest.raises(CodecError) as caught:
        take(guard, order(2), late_ns=OLDEST_NS + 1)
    assert caught.value.reason == "stale"
    assert refusal(guard, order(2)) == "replayed", "nor later"


def test_an_order_that_comes_when_its_writer_has_stopped_is_not_carried_out(
    guard: GripperGuard,
) -> None:
    with pytest.raises(CodecError) as caught:
        take(guard, order(1), "command#1", leads=False)
    assert caught.value.reason == "outlived"
    assert take(guard, order(2), "command#1") == ORDER
    assert take(guard, order(3), leads=False) == ORDER, "nobody moves the arm"
