"""What is measured: each stream by itself, poses against joints, forces as they are; late arms."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from command_rig import DOWN, START_M, START_NS, Rig, profile, reach_of

from vla_zenoh.control.commanded_part import CommandedPart
from vla_zenoh.control.contact import Contact
from vla_zenoh.control.monitor import Monitor
from vla_zenoh.errors import ProfileError
from vla_zenoh.kinematics.so3 import Pose, quat_from_rotation, rotation_from_quat
from vla_zenoh.profile import ContactLimits, Limits, Profile, load_profile, override
from vla_zenoh.profile.limits import Workspace
from vla_zenoh.types import FloatArray, Header, JointState, PoseState, Stamped

MS = 1_000_000
STOP_N, MOST_N = 40.0, 44.0
DOWN_M, AT_EDGE_M = 0.05, 1e-3


class Arm(Rig):
    """An arm whose joints and reported pose agree, unless a test tampers with one of them."""

    def __init__(self, of: Profile | None = None, *, command: str = "pose") -> None:
        of = of or profile(robot={"command": command})
        reach = reach_of(of)
        super().__init__(of, reach=reach)
        self.reach = reach
        self.at_rad: FloatArray = reach.joints_rad.copy()
        self.stand_at(reach.kinematics, self.at_rad)
        self.jump_m = np.zeros(3)
        self.frozen: set[str] = set()
        self.late_ns: dict[str, int] = {}
        self.last: dict[str, Stamped[Any]] = {}

    def tick(self, *settings: Any, **more: Any) -> Any:
        out = super().tick(*settings, **more)
        if out.joint is not None:
            pose = self.reach.kinematics.forward(out.joint.position_rad)
            self.at_rad = out.joint.position_rad
            self.position_m, self.quat_xyzw = pose.position_m, quat_from_rotation(pose.rotation)
        return out

    def _said(self, stream: str, state: Stamped[Any]) -> Stamped[Any]:
        """As it is told: frozen values have new stamps, late ones old stamps."""
        if stream in self.frozen and stream in self.last:
            state = replace(state, record=self.last[stream].record)
        self.last[stream] = state
        header = state.header
        late_ns = self.late_ns.get(stream, 0)
        return replace(state, header=replace(header, stamp_wall_ns=header.stamp_wall_ns - late_ns))

    def pose_state(self) -> Stamped[PoseState]:
        state = super().pose_state()
        moved = replace(state.record, position_m=state.record.position_m + self.jump_m)
        return self._said("pose", replace(state, record=moved))

    def gripper_state(self) -> Any:
        return self._said("gripper", super().gripper_state())

    def joint_state(self) -> Stamped[JointState]:
        pose = Pose(self.position_m, rotation_from_quat(self.quat_xyzw))
        found = self.reach.solve(pose, self.at_rad)
        self.at_rad = self.at_rad if found is None else found
        zero = np.zeros(len(self.at_rad))
        names = self.reach.kinematics.arm_joints
        record = JointState(names, self.at_rad, zero, zero, self.at_rad)
        state = Stamped(self.header("joint", "sim-1"), record, self.now_ns)
        return self._said("joints", state)

    def moving(self, step_m: float = 0.01, count: int = 4) -> None:
        """Active, and on its way down."""
        self.activate()
        for _ in range(count):
            self.send([[0, 0, -step_m, 0, 0, 0, 0]] * 8)
            self.run(0.1)
        assert self.state == "active", self.commander.why


def test_an_arm_is_asked_by_every_monitor_there_is() -> None:
    of = profile()
    part = CommandedPart(of, reach_of(of))
    assert {type(monitor) for monitor in part.monitors} == {
        kind for kind in Monitor.__subclasses__() if kind.__module__.startswith("vla_zenoh.")
    }


# -- forces ------------------------------------------------------------------------------------
def pressed(force_n: FloatArray, at_ns: int) -> Stamped[PoseState]:
    wrench = np.concatenate([force_n, np.zeros(3)])
    moved_m = START_M + 1e-12 * (at_ns - START_NS)
    return Stamped(Header(at_ns, 0, "sim-1"), PoseState(moved_m, DOWN, np.zeros(6), wrench), at_ns)


@pytest.mark.parametrize(
    ("rate_n_s", "offset_n", "degrees"),
    [
        *((0.1, 14.0, 60), (0.3, 5.0, 180), (1.0, 0.0, 0), (1.0, 14.0, 90), (3.0, 5.0, 0)),
        *((10.0, 14.0, 180), (30.0, 14.0, 0), (100.0, 0.0, 0), (100.0, 5.0, 60)),
    ],
)
def test_the_arm_brakes_at_its_force_however_slowly_it_rises_and_whatever_was_there_before(
    rate_n_s: float, offset_n: float, degrees: float
) -> None:
    contact = Contact(ContactLimits(force_stop_n=STOP_N))
    angle = np.radians(degrees)
    offset = offset_n * np.array([np.cos(angle), np.sin(angle), 0.0])
    step_ns = 4 * MS if rate_n_s > 3.0 else 40 * MS
    now_ns = START_NS
    for _ in range(100):
        contact.update_pose(pressed(offset, now_ns))
        now_ns += step_ns
    contact.begin()
    assert contact.overload() is None
    began_ns = now_ns
    while contact.overload() is None:
        rising_n = rate_n_s * (now_ns - began_ns) / 1e9
        force_n = offset + np.array([rising_n, 0.0, 0.0])
        assert rising_n < MOST_N, "the zero of the sensor may be false: its change counts as well"
        assert np.linalg.norm(force_n) < MOST_N
        contact.update_pose(pressed(force_n, now_ns))
        now_ns += step_ns


@pytest.mark.parametrize("gap_s", [30.0, -30.0])
def test_a_load_is_not_got_used_to_while_nothing_is_measured(gap_s: float) -> None:
    contact, now_ns = Contact(ContactLimits(force_slow_n=20.0, force_stop_n=STOP_N)), START_NS
    contact.update_pose(pressed(np.array([0.01, 0.0, 0.0]), now_ns))
    contact.begin()
    now_ns += round(gap_s * 1e9)
    for _ in range(50):
        contact.update_pose(pressed(np.array([15.0, 0.0, 0.0]), now_ns))
        now_ns += 4 * MS
    assert contact.force_n == pytest.approx(15.0, abs=0.6)


def test_an_arm_that_is_pressed_harder_than_the_stop_is_not_activated() -> None:
    contact = Contact(ContactLimits(force_stop_n=STOP_N))
    for tick in range(100):
        contact.update_pose(pressed(np.array([0, 0, 41.0]), START_NS + 4 * MS * tick))
    assert any("contact_force is 41.0 N at rest" in why for why in contact.missing)


@pytest.mark.parametrize("force_n", [(1.0, 2.0, 3.0), (0.0, 0.0, 0.0)])
def test_a_wrench_that_stays_the_same_while_the_arm_moves_is_not_measured(
    force_n: tuple[float, ...],
) -> None:
    contact = Contact(ContactLimits())
    contact.update_pose(pressed(np.array([0.5, 0.0, 0.0]), START_NS))
    contact.begin()
    for tick in range(1, 100):
        state = pressed(np.array(force_n), START_NS + 4 * MS * tick)
        at_m = START_M + [0.0, 0.0, 0.001 * tick]
        contact.update_pose(replace(state, record=replace(state.record, position_m=at_m)))
    assert "no longer measures contact_force" in contact.lost
    assert "report none" in contact.lost


def test_a_wrench_that_was_never_anything_but_zeros_is_not_measured() -> None:
    contact = Contact(ContactLimits())
    contact.update_pose(pressed(np.zeros(3), START_NS))
    event = contact.news()
    assert event is not None
    assert event.what == "contact_not_told"
    contact.begin()
    for tick in range(1, 100):
        state = pressed(np.zeros(3), START_NS + 4 * MS * tick)
        at_m = START_M + [0.0, 0.0, 0.001 * tick]
        contact.update_pose(replace(state, record=replace(state.record, position_m=at_m)))
    assert not contact.lost, "it was none when the activation began"
    # A sensor with a dead band: what presses counts from the first reading on.
    for tick in range(100, 150):
        contact.update_pose(pressed(np.array([41.0, 0.0, 0.0]), START_NS + 4 * MS * tick))
    load = contact.overload()
    assert load is not None
    assert load.name == "contact_force"


def joints(effort_nm: tuple[float, ...], at_rad: float, tick: int) -> Stamped[JointState]:
    state = JointState(("one", "two"), np.array([at_rad, 0.0]), np.zeros(2), np.array(effort_nm))
    now_ns = START_NS + 4 * MS * tick
    return Stamped(Header(now_ns, tick, "arm-1"), state, now_ns)


@pytest.mark.parametrize("effort_nm", [(0.0, 0.0), (1.0, 2.0)])
@pytest.mark.parametrize(("moves", "why"), [(0.0, ""), (0.003, "measures contact_effort")])
def test_efforts_that_stay_the_same_while_the_joints_move_are_not_measured(
    effort_nm: tuple[float, ...], moves: float, why: str
) -> None:
    contact = Contact(ContactLimits(effort_stop_nm=10.0))
    contact.update_joints(joints((0.1, 0.1), 0.0, 0))
    contact.begin()
    for tick in range(1, 100):
        contact.update_joints(joints(effort_nm, moves * tick, tick))
    assert why in contact.lost
    assert bool(contact.lost) == bool(why)


def test_an_arm_whose_efforts_are_zeros_is_not_activated_where_they_have_a_limit() -> None:
    contact = Contact(ContactLimits(effort_stop_nm=10.0))
    contact.update_joints(joints((0.0, 0.0), 0.0, 0))
    assert any("or only zeros" in why for why in contact.missing)
    contact.update_joints(joints((0.0, 0.01), 0.0, 1))
    assert not contact.missing


def test_a_simulated_arm_that_touches_nothing_may_move_as_far_as_it_likes() -> None:
    contact = Contact(ContactLimits(), simulated=True)
    contact.update_pose(pressed(np.zeros(3), START_NS))
    contact.begin()
    for tick in range(100):
        state = pressed(np.zeros(3), START_NS + 4 * MS * tick)
        at_m = START_M + [0.0, 0.0, 0.001 * tick]
        contact.update_pose(replace(state, record=replace(state.record, position_m=at_m)))
    assert contact.lost == ""


class Felt(Rig):
    """An arm with a sensor of forces."""

    wrench: FloatArray | None = np.zeros(6)

    def pose_state(self) -> Stamped[PoseState]:
        state = super().pose_state()
        return replace(state, record=replace(state.record, wrench=self.wrench))


def test_a_load_that_is_no_longer_measured_ends_the_activation() -> None:
    rig = Felt()
    rig.activate()
    rig.wrench = None
    rig.tick()
    assert rig.state == "inactive"
    assert "no longer measures contact_force" in rig.commander.why


# -- poses against joints -----------------------------------------------------------------------
@pytest.mark.parametrize(
    ("command", "jump_m", "moving"),
    [("pose", 0.05, True), ("joint", 0.05, False), ("joint", 0.055, True), ("pose", 0.065, False)],
)
def test_an_arm_does_not_move_to_a_reported_pose_that_its_joints_contradict(
    command: str, jump_m: float, moving: bool
) -> None:
    rig = Arm(command=command)
    rig.moving() if moving else rig.activate()
    rig.jump_m = np.array([0.0, jump_m, 0.0])
    rig.run(0.05)
    rig.run(0.2)
    assert rig.state == "inactive"
    assert "TCP" in rig.commander.why, rig.commander.why
    rig.run(0.3)
    stood_m = rig.position_m.copy()
    rig.run(0.5)
    assert np.linalg.norm(rig.position_m - stood_m) < 1e-3


@pytest.mark.parametrize("command", ["pose", "joint"])
def test_a_pose_that_its_joints_contradict_for_less_than_the_timeout_ends_nothing(
    command: str,
) -> None:
    rig = Arm(command=command)
    rig.activate()
    for away_m in (0.03, 0.0, 0.03, 0.0):
        rig.jump_m = np.array([0.0, away_m, 0.0])
        rig.run(0.3 * rig.profile.timing.state_timeout_s)
        assert rig.state == "active", rig.commander.why
    rig.jump_m = np.array([0.0, 0.03, 0.0])
    rig.run(2.0 * rig.profile.timing.state_timeout_s)
    assert rig.state == "inactive"
    assert "the measured joints put the TCP" in rig.commander.why


def test_a_retreat_stops_before_a_bound_as_any_other_motion_does() -> None:
    rig = Arm()
    rig.activate()
    motion = rig.commander.parts[0].motion
    table_z_m = rig.profile.limits.reach.table_z_m
    assert table_z_m is not None
    here = Pose(rig.position_m, rotation_from_quat(rig.quat_xyzw))
    into = Pose(np.array([*rig.position_m[:2], table_z_m - 0.05]), here.rotation)
    bounded, hits = motion._within_reach(here, into)
    assert {hit.name for hit in hits} == {"table_distance"}
    assert bounded.position_m[2] > table_z_m


class RaisedLimits(Limits):
    """Limits with one more on the height of the TCP."""

    least_m: float = 0.0

    @property
    def tcp_box(self) -> Workspace:
        return self.workspace.model_copy(update={"z_m": (self.least_m, self.workspace.z_m[1])})


@pytest.mark.parametrize("command", ["pose", "joint"])
def test_a_further_limit_on_the_height_of_the_tcp_holds_for_everything_that_makes_goals(
    command: str,
) -> None:
    of = profile(robot={"command": command})
    least_m = float(Arm(of).position_m[2]) - DOWN_M
    limits = RaisedLimits.model_construct(**dict(of.limits), least_m=least_m)
    arm = Arm(of.model_copy(update={"limits": limits}))
    arm.activate()
    for _ in range(6):
        arm.send([[0, 0, -0.02, 0, 0, 0, 0]] * 8)
        arm.run(0.2)
        assert arm.position_m[2] > least_m - AT_EDGE_M
    assert arm.state == "active", arm.commander.why
    assert arm.position_m[2] < least_m + AT_EDGE_M
    assert "workspace" in {event.what for event in arm.events}


# -- each stream has its own age ----------------------------------------------------------------
@pytest.mark.parametrize("command", ["pose", "joint"])
@pytest.mark.parametrize("stream", ["pose", "joints", "gripper"])
def test_a_state_that_comes_late_or_is_repeated_ends_the_activation_by_name(
    command: str, stream: str
) -> None:
    rig = Arm(command=command)
    rig.moving()
    rig.late_ns = {stream: 2000 * MS}
    rig.run(0.02)
    assert rig.state == "inactive"
    assert f"late: {stream}" in rig.commander.why


@pytest.mark.parametrize("command", ["pose", "joint"])
@pytest.mark.parametrize("stream", ["pose", "joints"])
def test_values_that_stand_still_while_the_arm_moves_end_the_activation(
    command: str, stream: str
) -> None:
    rig = Arm(command=command)
    rig.moving()
    rig.frozen = {stream}
    for _ in range(10):
        rig.send([[0, 0, -0.02, 0, 0, 0, 0]] * 8)
        rig.run(0.1)
        if rig.state != "active":
            break
    assert rig.state == "inactive"
    assert "the measured joints put the TCP" in rig.commander.why, rig.commander.why


# -- late arms ----------------------------------------------------------------------------------
@pytest.mark.parametrize("velocity_m_s", [0.5, 0.03])
def test_an_arm_on_its_way_to_the_last_step_of_a_chunk_arrives(velocity_m_s: float) -> None:
    limits = profile().limits
    slow = limits.translation.model_copy(update={"velocity_m_s": velocity_m_s})
    rig = Rig(profile(limits={"translation": slow}), dt_s=0.05)
    rig.activate()
    asked_m = np.zeros(3)
    for _ in range(2):
        steps = [[0.005, 0, -0.005, 0, 0, 0, 0]] * 8
        rig.send(steps)
        asked_m += np.sum(steps, axis=0)[:3]
        rig.run(1.5 + 0.06 / velocity_m_s)
    dropped = [event for event in rig.events if event.what == "dropped"]
    cut_m = sum(event.value or 0.0 for event in dropped)
    np.testing.assert_allclose(np.linalg.norm(rig.moved_m() - asked_m), cut_m, atol=1e-5)
    assert not dropped


def test_what_of_a_chunk_is_dropped_is_reported_with_its_amount() -> None:
    limits = profile().limits
    slow = limits.translation.model_copy(update={"velocity_m_s": 0.01})
    rig = Rig(profile(limits={"translation": slow}), dt_s=0.05)
    rig.activate()
    rig.send([[0.01, 0, 0, 0, 0, 0, 0]] * 10)
    rig.run(6.0)
    dropped = [event for event in rig.events if event.what == "dropped"]
    assert len(dropped) == 1
    assert dropped[0].value == pytest.approx(0.1 - rig.moved_m()[0], abs=1e-5)
    assert "m and 0.0" in dropped[0].why


@pytest.mark.parametrize("rate_hz", [0.1, 1.0, 30.0])
def test_without_a_model_the_arm_stands_after_max_open_loop_at_any_rate(rate_hz: float) -> None:
    rig = Rig(dt_s=0.1)
    rig.activate()
    rig.put("rate", rate_hz)
    rig.send([[0.01, 0, 0, 0, 0, 0, 0]] * 16)
    timing = rig.profile.timing
    rig.run(timing.max_open_loop_s + timing.watchdog_s + 0.3)
    stood_m = rig.position_m.copy()
    assert rig.moved_m()[0] > 0.1
    rig.run(1.0 + 1 / rate_hz)
    np.testing.assert_allclose(rig.position_m, stood_m, atol=1e-6)


@pytest.mark.parametrize("posture", ["start", "home"])
def test_an_elbow_on_its_way_to_its_posture_does_not_put_off_the_watchdog(posture: str) -> None:
    robot = {"command": "joint", "posture": posture}
    arm = Arm(override(load_profile("panda_sim"), {"robot": robot}))
    arm.at_rad = arm.at_rad + np.array([0.3, 0.0, -0.3, 0.0, 0.3, 0.0, 0.0])
    arm.stand_at(arm.reach.kinematics, arm.at_rad)
    arm.activate()
    arm.run(0.5)
    arm.send([[0.0] * 7])
    heard_ns, elbow_rad = arm.now_ns, arm.at_rad
    while arm.state == "active":
        arm.tick()
    waited_s = (arm.now_ns - heard_ns) / 1e9
    period_s = 1 / arm.commander.task.rate_hz
    due_s = arm.spec.action.dt_s + period_s + arm.profile.timing.watchdog_s
    assert waited_s == pytest.approx(due_s, abs=0.01)
    assert (np.abs(arm.at_rad - elbow_rad).max() > 0.02) == (posture == "home")
    assert "within the watchdog" in arm.commander.why


def test_an_arm_whose_elbow_creeps_to_its_posture_is_at_rest_within_seconds() -> None:
    changes = {"robot": {"command": "joint", "posture": "home"}, "timing": {"command_hz": 50}}
    arm = Arm(override(load_profile("panda_sim"), changes))
    arm.at_rad = arm.at_rad + np.array([0.3, 0.0, -0.3, 0.0, 0.3, 0.0, 0.0])
    arm.stand_at(arm.reach.kinematics, arm.at_rad)
    arm.activate()
    begun_ns = arm.now_ns
    arm.run(0.5)
    assert not arm.commander.at_rest
    while not arm.commander.at_rest:
        arm.send([[0.0] * 7])
        arm.run(0.2)
    assert (arm.now_ns - begun_ns) / 1e9 < 9.0
    stood_rad = arm.at_rad
    arm.run(1.0)
    assert np.abs(arm.at_rad - stood_rad).max() < 2e-3


# -- profiles -----------------------------------------------------------------------------------
LEAST_LIMITS: dict[str, dict[str, float]] = {
    "translation": {"velocity_m_s": 1e-3, "acceleration_m_s2": 1e-2, "jerk_m_s3": 0.1},
    "rotation": {"velocity_rad_s": 1e-3, "acceleration_rad_s2": 1e-2, "jerk_rad_s3": 0.1},
    "joint": {"velocity_rad_s": 1e-3, "acceleration_rad_s2": 1e-2, "jerk_rad_s3": 0.1},
}


@pytest.mark.parametrize("command", ["pose", "joint"])
def test_an_arm_moves_within_the_least_limits_of_a_profile_without_a_fault(command: str) -> None:
    limits = {"limits": LEAST_LIMITS, "robot": {"command": command}}
    rig = Arm(override(load_profile("panda_sim"), limits))
    rig.activate()
    for _ in range(5):
        rig.send([[0.01, 0.002, 0, 0, 0, 0.02, 0]] * 8)
        rig.run(0.2)
        assert rig.state == "active", rig.commander.why
    assert rig.moved_m()[0] > 1e-5


@pytest.mark.parametrize(
    ("section", "name"), [(part, name) for part, of in LEAST_LIMITS.items() for name in of]
)
def test_smaller_limits_are_refused_by_name(section: str, name: str) -> None:
    less = {"limits": {section: {name: 0.9 * LEAST_LIMITS[section][name]}}}
    with pytest.raises(ProfileError, match=f"limits.{section}.{name}"):
        override(load_profile("panda_sim"), less)
