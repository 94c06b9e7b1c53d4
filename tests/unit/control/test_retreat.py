"""A blocked arm is led back: where to, how fast, how far, and when it is not."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from command_rig import MS, OFTEN, START_M, Rig, profile
from hypothesis import given, settings
from hypothesis import strategies as st

from vla_zenoh.control.commander_io import NewStates, Setting
from vla_zenoh.control.contact import RELIEF_M, SPACE_M, CommandTrail, Contact, Retreat
from vla_zenoh.control.preflight import state_lost
from vla_zenoh.kinematics.so3 import Pose
from vla_zenoh.types import Header, PoseState, Stamped

STIFFNESS_N_M = 2000.0
QUIET_N = 3.0
STANDING_M_S = 1e-6
TICK_S = 1 / 250


class Walled(Rig):
    """An arm on a spring that follows its command until a wall, which does not give way.

    Args:
        along: (3,) the way it goes.
        gap_m: to the wall.
        told: it tells what presses against it.
    """

    def __init__(self, along: np.ndarray, gap_m: float, *, told: bool = True) -> None:
        super().__init__(profile(timing=OFTEN))
        self.along = along / np.linalg.norm(along)
        self.gap_m, self.told = gap_m, told
        self.moved_by_person_m = np.zeros(3)
        self.force_n = np.zeros(3)
        self.depths_m: list[float] = []

    def pose_state(self) -> Stamped[PoseState]:
        said = super().pose_state()
        depth_m = max(float((self.position_m - START_M) @ self.along) - self.gap_m, 0.0)
        self.depths_m.append(depth_m)
        self.force_n = -STIFFNESS_N_M * (depth_m * self.along - self.moved_by_person_m)
        wrench = np.concatenate([self.force_n, np.zeros(3)]) if self.told else None
        at_m = self.position_m - depth_m * self.along + self.moved_by_person_m
        return replace(said, record=replace(said.record, position_m=at_m, wrench=wrench))

    def push(self, step_m: float) -> None:
        """Go on until it is not active any more."""
        self.activate()
        for _ in range(400):
            self.send([[*(step_m * self.along), 0, 0, 0, 0]])
            self.run(0.096)
            if self.state != "active":
                return
        raise AssertionError("it pushes on")

    def brake(self) -> None:
        """Until the command stands for the first time."""
        for _ in range(500):
            if np.abs(self.commands[-1].twist).max() < STANDING_M_S:
                return
            self.tick()
        raise AssertionError("it does not brake")

    def linger(self) -> None:
        """Until nothing is streamed any more, and on."""
        for _ in range(1500):
            if not self.commander.streaming:
                self.run(0.1)
                return
            self.tick()
        raise AssertionError("it does not end")

    def behind_m(self) -> float:
        """How far the command is before the wall."""
        return self.gap_m - float((self.commands[-1].position_m - START_M) @ self.along)


directions = st.tuples(*[st.floats(-1, 1)] * 3).filter(lambda v: np.linalg.norm(v) > 0.5)


@settings(max_examples=6)
@given(
    along=directions,
    gap_m=st.floats(0.03, 0.08),
    step_m=st.floats(0.004, 0.045),
    told=st.booleans(),
)
def test_it_ends_where_nothing_presses_within_the_limits_and_never_goes_further_in(
    along: tuple[float, ...], gap_m: float, step_m: float, told: bool
) -> None:
    rig = Walled(np.array(along), gap_m, told=told)
    rig.push(step_m)
    rig.brake()
    since = len(rig.depths_m)
    deepest_m = max(rig.depths_m)
    rig.linger()
    assert max(rig.depths_m[since:]) <= deepest_m + 1e-6
    assert float(np.linalg.norm(rig.force_n)) < QUIET_N
    assert -QUIET_N / STIFFNESS_N_M <= rig.behind_m() <= RELIEF_M + 2 * SPACE_M
    assert rig.state == "inactive"
    rig.assert_smooth()


class Clamped(Walled):
    """An arm of which something takes hold from behind while it stands."""

    stiffness_n_m = 20_000.0

    def __init__(self) -> None:
        self.clamp_m: float | None = None
        self.aside_n = np.zeros(3)
        self.forces_n: list[float] = []
        super().__init__(np.array([1.0, 0, 0]), 0.06)

    def pose_state(self) -> Stamped[PoseState]:
        said = Rig.pose_state(self)
        way_m = float((self.position_m - START_M) @ self.along)
        at_m = min(way_m, self.gap_m)
        at_m = at_m if self.clamp_m is None else max(at_m, self.clamp_m)
        self.forces_n.append(self.stiffness_n_m * (way_m - at_m))
        force_n = self.aside_n - self.forces_n[-1] * self.along
        place_m = self.position_m + (at_m - way_m) * self.along
        wrench = np.concatenate([force_n, np.zeros(3)])
        return replace(said, record=replace(said.record, position_m=place_m, wrench=wrench))


def test_it_ends_where_something_behind_the_arm_presses() -> None:
    rig = Clamped()
    rig.push(0.01)
    rig.brake()
    rig.clamp_m, rig.aside_n = rig.gap_m - 0.002, np.array([0.0, 4.0, 0.0])
    since = len(rig.forces_n)
    rig.run(5.0)
    stop_n, brake_m = rig.profile.limits.contact.force_stop_n, 0.003
    assert stop_n is not None
    assert min(rig.forces_n[since:]) > -(stop_n + brake_m * rig.stiffness_n_m)
    assert "something behind it presses" in [e for e in rig.events if e.what == "retreat"][-1].why


@pytest.mark.parametrize("why", ["the wall clock was set", "the command loop stood still"])
def test_it_ends_with_a_loss_of_the_command_node(why: str) -> None:
    rig = retreating_rig()
    rig.tick(Setting("lose", why))
    assert not rig.commander.retreating


def test_it_goes_no_faster_than_the_profile_says() -> None:
    rig = Walled(np.array([1.0, 0, 0]), 0.08)
    rig.push(0.04)
    rig.brake()
    since = len(rig.commands)
    rig.run(4.0)
    speeds = [float(np.abs(command.twist[:3]).max()) for command in rig.commands[since:]]
    assert 0.01 < max(speeds) <= rig.profile.limits.contact.retreat_m_s * (1 + 1e-6)


def test_it_goes_back_the_way_it_came() -> None:
    rig = Walled(np.array([1.0, 0, 0]), 0.06, told=False)
    rig.push(0.02)
    rig.run(4.0)
    assert rig.behind_m() == pytest.approx(RELIEF_M, abs=2 * SPACE_M)
    np.testing.assert_allclose(rig.commands[-1].position_m[1:], START_M[1:], atol=1e-4)


def test_contact_stops_it_long_before_it_lags_and_slows_it_down_before() -> None:
    rig = Walled(np.array([0.0, 1.0, 0]), 0.05)
    rig.push(0.003)
    limits = rig.profile.limits
    assert max(rig.depths_m) < 0.6 * limits.tracking_m
    told = {event.what: event for event in rig.events if event.kind == "limit"}
    stopped = told["contact_force"]
    assert stopped.value is not None
    assert stopped.limit == limits.contact.force_stop_n
    slowed = [event for event in rig.events if event.why == "slower"]
    assert [event.limit for event in slowed] == [limits.contact.force_slow_n]
    assert "contact_force" in rig.commander.why


def test_an_arm_that_a_person_goes_on_pushing_is_not_run_after() -> None:
    rig = Walled(np.array([1.0, 0, 0]), 0.05)
    rig.push(0.02)
    rig.brake()
    ended_m = rig.commands[-1].position_m
    for _ in range(750):
        rig.moved_by_person_m = rig.moved_by_person_m + np.array([0.0, 2e-4, 0.0])
        rig.tick()
    apart_m = rig.commands[-1].position_m - ended_m
    assert np.abs(apart_m[1]) < 0.01
    assert np.linalg.norm(apart_m) < max(rig.depths_m) + RELIEF_M + 2 * SPACE_M
    assert rig.commander.at_rest
    rig.assert_smooth()


def still_after_the_brake(rig: Walled) -> bool:
    rig.brake()
    ended_m = rig.commands[-1].position_m
    rig.run(1.5)
    return bool(np.linalg.norm(rig.commands[-1].position_m - ended_m) < 1e-6)


def test_it_stands_where_the_robot_says_that_it_is_not_ready() -> None:
    rig = Walled(np.array([1.0, 0, 0]), 0.05)
    rig.push(0.02)
    rig.gripper = replace(rig.gripper, mode="guiding")
    assert still_after_the_brake(rig)


def test_it_stands_where_the_robot_has_a_fault() -> None:
    rig = Walled(np.array([1.0, 0, 0]), 0.05)
    rig.push(0.02)
    rig.gripper = replace(rig.gripper, faults=("reflex",))
    assert still_after_the_brake(rig)


def test_it_stands_where_the_robot_is_not_heard() -> None:
    rig = Walled(np.array([1.0, 0, 0]), 0.05)
    rig.push(0.02)
    rig.silent = True
    rig.run(rig.profile.timing.state_timeout_s + 0.1)
    assert still_after_the_brake(rig)


def test_a_stop_ends_it_at_once() -> None:
    rig = Walled(np.array([1.0, 0, 0]), 0.05)
    rig.push(0.04)
    rig.brake()
    rig.run(0.2)
    assert np.abs(rig.commands[-1].twist).max() > STANDING_M_S  # it is on its way back
    rig.put("stop")
    assert still_after_the_brake(rig)
    rig.assert_smooth()


def retreating_rig() -> Rig:
    """A stuck arm that anna held active, whose command is on its way back to it."""
    rig = Rig(dt_s=0.2)
    rig.peers = replace(rig.peers, holders=frozenset({"anna"}))
    rig.tick(chunks=[rig.chunk([[0.0] * 7])])
    rig.put("active", "anna")
    for _ in range(12):
        rig.send([[0.02, 0, 0, 0, 0, 0, 0]])
        rig.run(0.2)
    rig.blocked = True
    rig.send([[0.02, 0, 0, 0, 0, 0, 0]] * 10)
    while rig.state == "active":
        rig.tick()
    rig.run(0.15)
    assert not rig.commander.at_rest
    return rig


def way_after_the_brake_m(rig: Rig) -> float:
    """How far the command goes from a quarter of a second on."""
    rig.run(0.25)
    braked_m = rig.commands[-1].position_m.copy()
    rig.run(1.5)
    return float(np.linalg.norm(rig.commands[-1].position_m - braked_m))


def test_left_alone_it_goes_back_to_the_arm_and_on() -> None:
    assert way_after_the_brake_m(retreating_rig()) > 0.03


def test_to_deactivate_ends_it() -> None:
    rig = retreating_rig()
    rig.put("active", False)
    assert way_after_the_brake_m(rig) < 1e-3
    assert rig.commander.at_rest


def test_it_ends_when_the_client_that_held_the_arm_active_is_gone() -> None:
    rig = retreating_rig()
    rig.peers = replace(rig.peers, holders=frozenset())
    assert way_after_the_brake_m(rig) < 1e-3


def test_an_activation_takes_over_from_it_without_a_jump() -> None:
    rig = Walled(np.array([1.0, 0, 0]), 0.05, told=False)
    rig.push(0.04)
    rig.brake()
    rig.run(0.2)
    rig.activate()
    rig.send([[-0.03, 0, 0, 0, 0, 0, 0]])
    rig.run(0.1)
    assert rig.state == "active"
    rig.run(1.5)
    # It began at the wall, and went that step: nobody led it on.
    assert rig.behind_m() == pytest.approx(0.03, abs=1e-4)
    rig.assert_smooth()


def test_an_arm_that_lags_and_feels_nothing_stands() -> None:
    rig = Walled(np.array([1.0, 0, 0]), 9.0)
    rig.activate()
    rig.send([[0.04, 0, 0, 0, 0, 0, 0]])
    rig.run(0.1)
    rig.moved_by_person_m = np.zeros(3)
    stuck = rig.pose_state().record
    rig.pose_state = lambda: Stamped(  # pyright: ignore[reportAttributeAccessIssue]
        rig.header("sim", "sim-1"), stuck, rig.now_ns
    )
    while rig.state == "active":
        rig.send([[0.04, 0, 0, 0, 0, 0, 0]])
        rig.run(0.096)
    assert "does not follow" in rig.commander.why
    assert still_after_the_brake(rig)


def test_a_pose_that_jumped_far_away_is_not_gone_to() -> None:
    rig = Walled(np.array([1.0, 0, 0]), 9.0, told=False)
    rig.activate()
    rig.send([[0.04, 0, 0, 0, 0, 0, 0]])
    rig.run(0.1)
    rig.moved_by_person_m = np.array([0.0, 0.3, 0.0])
    rig.run(0.1)
    assert rig.state == "inactive"
    assert still_after_the_brake(rig)


def test_a_robot_without_a_wrench_is_told_about_once() -> None:
    rig = Walled(np.array([1.0, 0, 0]), 0.05, told=False)
    rig.push(0.02)
    rig.run(4.0)
    rig.activate()
    assert [event.what for event in rig.events].count("contact_not_told") == 1


# -- a brake for another reason, pressed ----------------------------------------------------------
def pressing_rig(holder: str = "") -> Walled:
    """Active, moving on into a wall that presses with 20 N: less than the stop of a contact."""
    rig = Walled(np.array([1.0, 0, 0]), 0.06)
    rig.peers = replace(rig.peers, holders=frozenset({holder}))
    rig.tick(chunks=[rig.chunk([[0.0] * 7])])
    rig.put("active", holder or True)
    while np.linalg.norm(rig.force_n) < 20.0:
        rig.send([[0.01, 0, 0, 0, 0, 0, 0]])
        for _ in range(24):
            rig.tick()
            if np.linalg.norm(rig.force_n) >= 20.0:
                break
    assert rig.state == "active"
    return rig


def pressed(rig: Rig) -> list[str]:
    return [event.why for event in rig.events if event.what == "pressed"]


LOSSES: dict[str, Callable[[Rig], object]] = {
    "camera": lambda rig: gone(rig, "camera"),
    "worker": lambda rig: gone(rig, "worker-scripted"),
    "worker restarted": lambda rig: setattr(
        rig, "peers", replace(rig.peers, spec_sources={"scripted": "worker-scripted-2"})
    ),
    "command node": lambda rig: rig.tick(Setting("lose", "the command loop stood still")),
}
ENDS: dict[str, Callable[[Rig], object]] = {
    "deactivated": lambda rig: rig.put("active", False),
    "stopped": lambda rig: rig.tick("stop"),
    "fault": lambda rig: setattr(rig, "gripper", replace(rig.gripper, faults=("reflex",))),
    "robot in another mode": lambda rig: setattr(
        rig, "gripper", replace(rig.gripper, mode="guiding")
    ),
    "deadman gone": lambda rig: setattr(rig, "peers", replace(rig.peers, holders=frozenset[str]())),
}


def gone(rig: Rig, node: str) -> None:
    rig.peers = replace(rig.peers, alive=rig.peers.alive - {node})


@pytest.mark.parametrize("loss", LOSSES)
def test_an_arm_that_a_brake_for_another_reason_pressed_on_something_retreats(loss: str) -> None:
    rig = pressing_rig()
    LOSSES[loss](rig)
    rig.run(3.0)
    assert float(np.linalg.norm(rig.force_n)) < QUIET_N
    assert rig.behind_m() <= RELIEF_M + 2 * SPACE_M
    (why,) = pressed(rig)
    assert "contact_force" in why
    assert why.endswith("it retreats")
    assert rig.state == "inactive"
    assert not rig.commander.streaming
    rig.assert_smooth()


@pytest.mark.parametrize("end", ENDS)
def test_an_arm_that_is_to_stand_says_what_presses_on_it_and_stays(end: str) -> None:
    rig = pressing_rig("anna")
    ENDS[end](rig)
    rig.brake()
    stood_m = rig.commands[-1].position_m
    rig.run(1.5)
    np.testing.assert_allclose(rig.commands[-1].position_m, stood_m, atol=1e-6)
    (why,) = pressed(rig)
    assert why.endswith("it stays there")
    assert float(why.split()[1]) == pytest.approx(np.linalg.norm(rig.force_n), abs=0.3)


def test_an_arm_that_holds_says_what_presses_and_retreats_when_it_gives_up() -> None:
    rig = Walled(np.array([1.0, 0, 0]), 0.06)
    rig.activate()
    rig.send([[0.013, 0, 0, 0, 0, 0, 0]] * 6)
    rig.run(3.0)
    assert rig.state == "holding"
    assert np.linalg.norm(rig.force_n) > rig.profile.limits.contact.force_slow_n
    rig.run(rig.profile.timing.max_hold_s + 4.0)
    assert rig.state == "inactive"
    assert [why.rpartition("; ")[2] for why in pressed(rig)] == ["it stays there", "it retreats"]
    assert float(np.linalg.norm(rig.force_n)) < QUIET_N


@pytest.mark.parametrize("gap_m", [9.0, 0.055])
def test_a_brake_that_ends_in_no_contact_is_followed_by_nothing(gap_m: float) -> None:
    """Free, or with less than what slows an arm down."""
    rig = Walled(np.array([1.0, 0, 0]), gap_m)
    rig.activate()
    rig.send([[0.03, 0, 0, 0, 0, 0, 0]] * 2)
    rig.run(0.8)
    assert np.linalg.norm(rig.force_n) < rig.profile.limits.contact.force_slow_n
    gone(rig, "camera")
    assert still_after_the_brake(rig)
    assert pressed(rig) == []


# -- the way it came ------------------------------------------------------------------------------
def at(x_m: float, y_m: float = 0.0) -> Pose:
    return Pose(np.array([x_m, y_m, 0.0]), np.eye(3))


def test_a_trail_leads_back_over_the_last_places_newest_first() -> None:
    trail = CommandTrail()
    for x_m in np.arange(0, 0.05, 0.0005):
        trail.add(at(x_m))
    back = [float(pose.position_m[0]) for pose in trail.back(0.01)]
    assert back == sorted(back, reverse=True)
    assert 0.009 < 0.0495 - back[-1] < 0.0125


def test_what_was_gone_there_and_back_is_left_out() -> None:
    trail = CommandTrail()
    for x_m in [*np.arange(0, 0.03, 0.001), *np.arange(0.03, 0.01, -0.001)]:
        trail.add(at(x_m))
    assert max(pose.position_m[0] for pose in trail.back(0.05)) <= 0.012


@pytest.mark.parametrize("speed_m_s", [0.05, 0.4, 1.0, 1.7])
def test_an_arm_of_any_speed_has_a_way_back_at_20_hz(speed_m_s: float) -> None:
    trail = CommandTrail()
    for tick in range(6):
        trail.add(at(tick * speed_m_s / 20.0))
    back_m = [float(pose.position_m[0]) for pose in trail.back(RELIEF_M)]
    assert 0.009 < 5 * speed_m_s / 20.0 - back_m[-1] < 0.0215


def test_an_arm_that_turned_up_elsewhere_has_no_way_from_there() -> None:
    trail = CommandTrail()
    for x_m in np.arange(0, 0.03, 0.001):
        trail.add(at(x_m))
    trail.add(at(0.2))
    assert trail.back(0.1) == []


def test_a_watch_says_which_state_is_missing() -> None:
    rig = Rig()
    pose, most_s = rig.pose_state(), rig.profile.timing.state_timeout_s
    assert state_lost("pose", pose, most_s, rig.now_ns) == ""
    assert "pose" in state_lost("pose", pose, most_s, rig.now_ns + 10**9)
    assert "future: pose" in state_lost("pose", pose, most_s, rig.now_ns - 10**9)


def test_a_single_false_pose_of_an_arm_without_kinematics_is_forgotten_when_it_is_back() -> None:
    rig = Rig(profile(timing=OFTEN))
    rig.activate()
    states, here_m = rig.commander.parts[0].states, rig.position_m
    rig.position_m = here_m + np.array([0.03, 0, 0])
    rig.tick()
    assert "jumped" in states.doubt
    rig.position_m = here_m
    rig.tick()
    assert not states.doubt


@pytest.mark.parametrize(("share", "doubted"), [(0.75, False), (1.25, True)])
def test_an_arm_that_is_pushed_is_no_false_pose_unless_nobody_pushes_so_fast(
    share: float, doubted: bool
) -> None:
    """Of 4 times the speed of a command, for a fifth of a second without a pose."""
    rig = Rig()
    states, now_ns = rig.commander.parts[0].states, rig.now_ns
    pushed_m = share * 0.2 * 4 * rig.profile.limits.translation.velocity_m_s
    for x_m, at_ns in ((0.0, now_ns), (pushed_m, now_ns + 200 * MS)):
        pose = rig.pose_state().record
        moved = replace(pose, position_m=pose.position_m + [x_m, 0.0, 0.0])
        states.update(NewStates(pose=Stamped(Header(at_ns, 1, "arm"), moved, at_ns)))
    assert bool(states.doubt) is doubted


def test_a_pose_that_jumped_and_stays_there_is_not_trusted_without_kinematics() -> None:
    rig = Rig(profile(timing=OFTEN))
    rig.activate()
    rig.position_m = rig.position_m + np.array([0.03, 0, 0])
    rig.blocked = True  # it stays there
    rig.run(2.0)
    assert "jumped" in rig.commander.parts[0].states.doubt


def test_it_does_not_return_to_where_a_person_has_pushed_the_arm_away_from_since() -> None:
    limits = profile().limits
    retreat, turned = Retreat(limits, Contact(limits.contact)), np.eye(3)

    def at(x_m: float) -> Pose:
        return Pose(START_M + [x_m, 0.0, 0.0], turned)

    for x_m in np.arange(0.0, 0.051, 0.0025):
        retreat.measure(at(float(x_m)))
    retreat.begin(at(0.06))
    retreat.measure(at(0.03))
    places_m: list[float] = []
    for tick in range(100):
        target, _ = retreat.step(at(0.06), tick * 10 * MS, at_rest=True)
        if target is not None:
            places_m.append(float(target.position_m[0] - START_M[0]))
    assert places_m[0] == max(places_m) == pytest.approx(0.03)


def test_one_that_begins_anew_sets_out_from_where_the_arm_is_by_then() -> None:
    limits = profile().limits
    retreat, commanded = Retreat(limits, Contact(limits.contact)), Pose(START_M, np.eye(3))
    for x_m in (0.01, 0.02):
        measured = Pose(START_M - [x_m, 0.0, 0.0], np.eye(3))
        retreat.measure(measured)
        retreat.begin(commanded)
        assert retreat.step(commanded, 0, at_rest=True)[0] is measured
