"""What presses against the arm: filtered, without what was there before, and what follows of it."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError

from vla_zenoh.control.contact import DRIFT_S, FILTER_S, Contact
from vla_zenoh.profile import ContactLimits
from vla_zenoh.types import Header, JointState, PoseState, Stamped

LIMITS = ContactLimits()
PERIOD_S = 0.005
JOINTS = ("one", "two")


class Arm:
    """Says its wrench every 5 ms."""

    def __init__(self, **limits: Any) -> None:
        self.contact = Contact(ContactLimits(**limits), simulated=True)
        self.now_ns = 10**18

    def feels(
        self, *force_n: float, torque_nm: tuple[float, ...] = (0.0, 0.0, 0.0), s: float = 1.0
    ) -> None:
        for _ in range(round(s / PERIOD_S)):
            self.says(np.array([*force_n, *torque_nm]))

    def says(self, wrench: np.ndarray | None) -> None:
        self.now_ns += round(PERIOD_S * 1e9)
        state = PoseState(np.zeros(3), np.array([0.0, 0, 0, 1]), np.zeros(6), wrench)
        self.contact.update_pose(Stamped(Header(self.now_ns, 1, "sim-1"), state, self.now_ns))

    def strains(self, *effort_nm: float, s: float = 1.0) -> None:
        for _ in range(round(s / PERIOD_S)):
            self.now_ns += round(PERIOD_S * 1e9)
            state = JointState(JOINTS, np.zeros(2), np.zeros(2), np.array(effort_nm))
            self.contact.update_joints(Stamped(Header(self.now_ns, 1, "sim-1"), state, self.now_ns))


def active(**limits: Any) -> Arm:
    arm = Arm(**limits)
    arm.feels(0.0, 0.0, 0.0)
    arm.contact.begin()
    return arm


def test_a_load_that_rises_slowly_is_told_as_the_robot_reports_it() -> None:
    arm = active(force_slow_n=15.0)
    for force_n in np.arange(0.0, 35.0, 0.01):  # 2 N/s
        arm.feels(0.0, 0.0, float(force_n), s=PERIOD_S)
    load = arm.contact.touching()
    assert load is not None
    assert str(load) == f"contact_force {force_n:.1f} N"
    assert load.value < 0.7 * force_n


def test_a_free_arm_has_all_its_speed() -> None:
    arm = active()
    arm.feels(0.5, -1.0, 0.5)
    assert arm.contact.overload() is None
    assert arm.contact.slowdown is None
    assert arm.contact.quiet


@pytest.mark.parametrize("direction", [(1.0, 0.0, 0.0), (0.0, 0.6, -0.8)])
def test_a_force_above_its_limit_is_named_with_value_and_limit(
    direction: tuple[float, ...],
) -> None:
    arm = active()
    arm.feels(*(1.3 * LIMITS.force_stop_n * np.array(direction)), s=0.2)
    pressed = arm.contact.overload()
    assert pressed is not None
    assert (pressed.name, pressed.stop, pressed.unit) == (
        "contact_force",
        LIMITS.force_stop_n,
        "N",
    )
    assert pressed.value == pytest.approx(1.3 * LIMITS.force_stop_n, rel=0.05)


def test_a_torque_above_its_limit_is_named_too() -> None:
    arm = active()
    arm.feels(0.0, 0.0, 0.0, torque_nm=(0.0, 2 * LIMITS.torque_stop_nm, 0.0), s=0.2)
    pressed = arm.contact.overload()
    assert pressed is not None
    assert pressed.name == "contact_torque"


def test_between_slow_and_stop_the_arm_gets_slower_the_more_it_presses() -> None:
    shares = []
    for part in (0.3, 0.6, 0.9):
        arm = active()
        span_n = LIMITS.force_stop_n - LIMITS.force_slow_n
        arm.feels(LIMITS.force_slow_n + part * span_n, 0.0, 0.0, s=0.2)
        slower = arm.contact.slowdown
        assert slower is not None
        assert slower.name == "contact_force"
        shares.append(slower.share)
        assert arm.contact.overload() is None
    assert 1.0 >= shares[0] > shares[1] > shares[2] >= 0.1


def test_a_blow_that_is_over_at_once_and_noise_do_not_stop_it() -> None:
    arm = active()
    arm.says(np.array([3 * LIMITS.force_stop_n, 0, 0, 0, 0, 0]))
    assert PERIOD_S < FILTER_S / 2
    assert arm.contact.overload() is None
    noise = np.random.default_rng(1).normal(0.0, LIMITS.force_slow_n / 2, (1000, 6))
    noise[:, 3:] *= 0.2
    for wrench in noise:
        arm.says(wrench)
        assert arm.contact.overload() is None


def test_what_was_there_when_it_was_activated_is_no_contact_up_to_slow() -> None:
    load_n = 0.9 * LIMITS.force_slow_n
    arm = Arm()
    arm.feels(0.0, 0.0, -load_n)
    assert arm.contact.force_n == pytest.approx(load_n)
    arm.contact.begin()
    assert arm.contact.force_n == pytest.approx(0.0, abs=1e-9)
    wedged = Arm()
    wedged.feels(0.0, 0.0, -3 * LIMITS.force_stop_n)
    wedged.contact.begin()
    assert wedged.contact.overload() is not None


def test_a_load_that_is_taken_up_is_got_used_to_but_no_more_than_slow() -> None:
    arm = active()
    arm.feels(0.0, 0.0, -0.8 * LIMITS.force_slow_n, s=3 * DRIFT_S)
    assert arm.contact.quiet
    pushed = active()
    pushed.feels(LIMITS.force_stop_n - 1.0, 0.0, 0.0, s=5 * DRIFT_S)
    left_n = LIMITS.force_stop_n - 1.0 - LIMITS.force_slow_n
    assert pushed.contact.force_n == pytest.approx(left_n, rel=1e-3)


def test_an_arm_that_is_not_active_gets_used_to_nothing() -> None:
    arm = active()
    arm.contact.end()
    arm.feels(0.0, 0.0, -8.0, s=2 * DRIFT_S)
    assert arm.contact.force_n == pytest.approx(8.0)


def test_a_robot_that_tells_no_wrench_is_not_felt() -> None:
    arm = active()
    assert arm.contact.known
    arm.says(None)
    assert not arm.contact.known
    assert arm.contact.force_n is None
    assert arm.contact.overload() is None
    assert arm.contact.slowdown is None


def test_efforts_count_only_where_a_limit_says_that_they_are_external() -> None:
    arm = active()
    arm.strains(80.0, -80.0)
    assert arm.contact.overload() is None
    told = Arm(effort_slow_nm=5.0, effort_stop_nm=12.0)
    told.strains(1.0, 1.0)
    told.contact.begin()
    told.strains(1.0, -12.5)
    pressed = told.contact.overload()
    assert pressed is not None
    assert pressed.name == "contact_effort"
    assert pressed.value == pytest.approx(13.5, rel=0.2)


@pytest.mark.parametrize(
    "limits",
    [
        {"force_slow_n": 50.0},
        {"torque_slow_nm": 15.0},
        {"effort_slow_nm": 3.0},
        {"effort_slow_nm": 3.0, "effort_stop_nm": 2.0},
    ],
)
def test_a_slow_that_is_not_below_its_stop_is_refused(limits: dict[str, float]) -> None:
    with pytest.raises(ValidationError, match="must be below"):
        ContactLimits(**limits)


def test_a_load_that_is_no_longer_measured_ends_the_activation_by_name() -> None:
    arm = active()
    assert not arm.contact.lost
    arm.says(None)
    assert "contact_force" in arm.contact.lost
    arm.contact.begin()
    assert not arm.contact.lost


def test_an_activation_needs_the_efforts_that_the_profile_limits() -> None:
    arm = active(effort_slow_nm=5.0, effort_stop_nm=10.0)
    (reason,) = arm.contact.missing
    assert "effort_stop_nm" in reason
    arm.strains(0.0, 0.01, s=0.1)
    assert not arm.contact.missing
    arm.contact.begin()
    state = JointState(JOINTS, np.zeros(2), np.zeros(2), None)
    arm.contact.update_joints(Stamped(Header(arm.now_ns, 1, "sim-1"), state, arm.now_ns))
    assert "contact_effort" in arm.contact.lost
    assert arm.contact.missing


def test_efforts_without_a_limit_are_not_needed() -> None:
    assert not active().contact.missing
