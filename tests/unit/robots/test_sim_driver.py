"""The simulated robot, driven without a bus."""

from __future__ import annotations

import time
from threading import Event, Thread

import numpy as np
import pytest
import zenoh
from camera_rig import routed_session, until
from driver_report import Report

from vla_zenoh.bus.clock import Tick
from vla_zenoh.client.client import Client
from vla_zenoh.codec import message, records
from vla_zenoh.kinematics.so3 import quat_from_rotation
from vla_zenoh.profile import load_profile, override
from vla_zenoh.robots.arm import Arm
from vla_zenoh.robots.node import RobotNode
from vla_zenoh.robots.sim_driver import SimDriver, in_world_time
from vla_zenoh.simulation.world import STEP_NS, STEP_S
from vla_zenoh.types import (
    GripperCommand,
    Header,
    JointCommand,
    JointReference,
    PoseCommand,
    PoseReference,
)

SETTLED_M, SETTLED_RAD, SHUT_M = 2e-3, 5e-3, 0.01
STILL = np.zeros(6)


@pytest.fixture(scope="module")
def driver() -> SimDriver:
    driver = SimDriver(load_profile("panda_sim"))
    Report(driver)
    return driver


def run(driver: SimDriver, reference: PoseReference | JointReference, steps: int = 1500) -> None:
    arm = driver.parts[""]
    for step in range(1, steps + 1):
        driver.poll(step * STEP_NS)
        arm.move(reference, step * STEP_NS)
        arm.read(step * STEP_NS)


def test_it_goes_to_a_pose(driver: SimDriver) -> None:
    driver.reset(None)
    here = driver.parts[""].state_now().pose
    wanted_m = here.position_m + [0.0, 0.0, 0.02]
    run(driver, PoseReference(wanted_m, here.rotation, STILL, STILL))
    np.testing.assert_allclose(
        driver.parts[""].state_now().pose.position_m, wanted_m, atol=SETTLED_M
    )


def test_it_goes_to_joint_positions(driver: SimDriver) -> None:
    driver.reset(None)
    wanted_rad = driver.parts[""].state_now().position_rad + 0.05
    zeros = np.zeros(len(wanted_rad))
    run(driver, JointReference(wanted_rad, zeros, zeros))
    np.testing.assert_allclose(
        driver.parts[""].state_now().position_rad, wanted_rad, atol=SETTLED_RAD
    )


def test_measurements_come_at_the_state_rate(driver: SimDriver) -> None:
    driver.reset(None)
    ticks = 1000 // driver.steps
    found = [driver.parts[""].read(tick * driver.steps * STEP_NS) for tick in range(1, ticks + 1)]
    count = sum(measurement is not None for measurement in found)
    assert count == pytest.approx(driver.profile.timing.state_hz, rel=0.01)


def test_states_are_published_at_the_state_rate_in_real_time() -> None:
    with routed_session() as session:
        node = RobotNode(SimDriver(load_profile("panda_sim")), session)
        driver, found = node.driver, list[zenoh.Sample]()
        key = node.node.keys.state_pose
        subscriber = session.declare_subscriber(key, found.append)
        ticks = round(1.0 / driver.period_s)
        for tick in range(1, ticks + 1):
            node.step(Tick(1, round(tick * driver.period_s * 1e9), 0.0, 0.0))
        until_s = time.monotonic() + 5.0
        while len(found) < 0.95 * driver.profile.timing.state_hz and time.monotonic() < until_s:
            time.sleep(0.01)
        assert len(found) == pytest.approx(driver.profile.timing.state_hz, rel=0.05)
        subscriber.undeclare()
        node._close()


@pytest.mark.parametrize("force_n", [20.0, 0.0])
def test_the_gripper_closes_also_with_no_force(driver: SimDriver, force_n: float) -> None:
    driver.reset(None)
    driver.parts[""].grip(GripperCommand(0.0, 0.1, force_n), 0)
    here = driver.parts[""].state_now().pose
    run(driver, PoseReference(here.position_m, here.rotation, STILL, STILL), 900)
    assert driver.world.gripper_state().width_m < SHUT_M


def test_a_reset_puts_the_arm_home_and_is_counted(driver: SimDriver) -> None:
    report = Report(driver)
    driver.reset(None)
    before = report.counters["sim.resets"]
    driver.status_changed()
    driver.reset(5)
    home_rad = driver.profile.robot.home_rad
    np.testing.assert_allclose(driver.parts[""].state_now().position_rad, home_rad, atol=1e-9)
    assert report.counters["sim.resets"] == before + 1
    assert driver.status_changed()
    assert not driver.status_changed()


def test_a_world_that_takes_twice_its_time_is_led_twice_as_fast_from_its_first_step_on() -> None:
    joints = JointReference(np.full(7, 0.3), np.full(7, 0.1), np.full(7, 0.5))
    for ours, theirs in zip(in_world_time(joints, 1.0, 1), joints, strict=True):
        np.testing.assert_array_equal(ours, theirs)
    first = in_world_time(joints, 2.0, 4)
    np.testing.assert_allclose(first.position_rad, joints.position_rad - 3 * STEP_S * 0.2)
    np.testing.assert_allclose(first.velocity_rad_s, 2.0 * joints.velocity_rad_s)
    np.testing.assert_allclose(first.acceleration_rad_s2, 4.0 * joints.acceleration_rad_s2)


def test_velocities_of_a_slow_world_are_told_in_real_time() -> None:
    driver = SimDriver(load_profile("panda_sim"))
    part = driver.parts[""]
    reference = part.reference
    assert isinstance(reference, PoseReference)
    run(driver, reference._replace(position_m=reference.position_m + [0.0, 0.0, 0.02]), 50)
    driver.period_s = 2.0 * driver.steps * STEP_S
    inside, told = driver.world.parts[""], part.measure()
    assert told.joints.velocity_rad_s == pytest.approx(inside.joint_state().velocity_rad_s / 2)
    assert told.pose.twist == pytest.approx(inside.pose_state(part.reference).twist / 2)
    assert np.abs(told.pose.twist).max() > 0.01


def test_of_a_world_that_diverged_the_last_finite_state_is_told() -> None:
    driver = SimDriver(load_profile("panda_sim"))
    Report(driver)
    part = driver.parts[""]
    run(driver, part.reference, 5)
    known = part.measure()
    driver.world._data.qpos[:] = np.nan
    driver.fault = "the simulation diverged"
    run(driver, part.reference, 1)
    told = part.measure()
    assert told.joints is known.joints
    assert told.pose is known.pose


def test_a_commanded_arm_is_reset_only_out_of_a_fault_and_then_stands_at_home() -> None:
    with routed_session() as session:
        profile = override(load_profile("panda_sim"), {"sim": {"seed": 4}})
        node = RobotNode(SimDriver(profile, lockstep=True), session)
        (arm,), driver = node.arms.values(), node.driver
        assert isinstance(driver, SimDriver)
        writer = StreamWriter(arm, "joint")

        def steps(numbers: range) -> None:
            for step in numbers:
                session.put(*writer.command(step), attachment=writer.header(step))
                node.step(Tick(1, step * STEP_NS, 0.0, 0.0))

        steps(range(1, 100))
        session.put(node.node.keys.sim_reset, "0")
        steps(range(100, 150))
        assert arm.guard.following
        assert driver.world.seed == 4
        assert any("reset_refused" in name for name in node.node.counters)
        driver.fault = "the simulation diverged"
        session.put(node.node.keys.sim_reset, "0")
        node.step(Tick(1, 150 * STEP_NS, 0.0, 0.0))
        assert driver.world.seed == 0
        assert driver.fault == ""
        assert not arm.guard.following
        home_rad = driver.profile.robot.home_rad
        np.testing.assert_allclose(arm.guard.reference.position_rad, home_rad, atol=1e-3)
        node._close()


def test_in_lockstep_a_part_of_a_millisecond_is_refused() -> None:
    with routed_session() as session:
        node = RobotNode(SimDriver(load_profile("panda_sim"), lockstep=True), session)
        stop, key = Event(), node.node.keys.sim_step
        thread = Thread(target=node.driver.serve_lockstep, args=(node, stop))
        thread.start()
        part = message.pack({"ns": 3 * STEP_NS // 2})
        (refused,) = until("it answers", lambda: list(session.get(key, payload=part)))
        assert refused.err is not None
        (reply,) = session.get(key, payload=message.pack({"ns": 2 * STEP_NS}))
        assert reply.ok is not None
        assert message.unpack(reply.ok.payload.to_bytes())["time_ns"] == 2 * STEP_NS
        stop.set()
        thread.join()
        node._close()


@pytest.mark.parametrize(("mode", "name"), [("pose", "two_pandas_sim"), ("joint", "panda_sim")])
def test_every_arm_brakes_by_itself_when_a_stop_is_put(name: str, mode: str) -> None:
    with routed_session() as session:
        node = RobotNode(SimDriver(load_profile(name), lockstep=True), session)
        writers = [StreamWriter(arm, mode) for arm in node.arms.values()]
        fastest_rad_s = 0.0
        for step in range(1, 800):
            if step % 4 == 0:
                for writer in writers:
                    session.put(*writer.command(step), attachment=writer.header(step))
            if step == 400:
                assert all(arm.guard.following for arm in node.arms.values())
                assert node.driver.status().detail["command"] == mode
                session.put(node.node.keys.stop, "stop")
            node.step(Tick(1, step * STEP_NS, 0.0, 0.0))
            states = [arm.guard._measure() for arm in node.arms.values()]
            speed_rad_s = max(np.abs(state.velocity_rad_s).max() for state in states)
            fastest_rad_s = max(fastest_rad_s, speed_rad_s)
        assert fastest_rad_s > 0.05
        for arm in node.arms.values():
            assert arm.state == "latched"
            assert not arm.guard.moving
        assert speed_rad_s < 0.02
        node._close()


def test_a_starved_robot_node_says_how_late_and_how_many_ticks_were_missed() -> None:
    with routed_session() as session:
        node = RobotNode(SimDriver(load_profile("panda_sim"), lockstep=True), session)
        client = Client(node.node.profile, session).subscribe()
        at = 0
        for periods in (1, 1, 300, 1, 300, 1):
            at += periods
            node.step(Tick(periods, at * STEP_NS, 0.0, 0.0))
            node._watched_s = 0.0
        node._watch()
        why = (
            "this computer is too busy: in the last 2 s 30% of the ticks of node 'sim' were "
            "missed, the latest was 0.299 s late"
        )
        node.watch(now=True)
        assert client.wait_for(lambda: client.events and client.status("sim"), 5.0)
        status = client.status("sim")
        assert status is not None
        assert status.detail["busy"] == why
        busy = [event.why for _, _, event in client.pop_events() if event.what == "busy"]
        assert len(busy) == 1
        assert "the latest was 0.299 s late" in busy[0]
        node.step(Tick(1, (at + 3000) * STEP_NS, 0.0, 0.0))
        node._watched_s = 0.0
        node._watch()
        node.watch(now=True)
        assert client.wait_for(lambda: client.status("sim").detail["busy"] == "", 5.0)  # pyright: ignore[reportOptionalMemberAccess]
        node._close()


def test_a_world_that_is_slower_than_real_time_is_reported_once_until_it_is_not() -> None:
    with routed_session() as session:
        driver = SimDriver(load_profile("panda_sim"))
        node = RobotNode(driver, session)
        client = Client(node.node.profile, session).subscribe()
        driver.pace()
        pace = driver._pace
        assert pace is not None
        slower = "slower than real time: x 0.70"
        for factor, told in ((1.0, ""), (0.7, slower), (0.93, slower), (1.0, "")):
            pace.factor = factor
            driver._watch_pace()
            assert driver.status().detail["slow"] == told
        assert client.wait_for(lambda: client.events, 5.0)
        slow = [event.why for _, _, event in client.pop_events() if event.what == "slow"]
        assert len(slow) == 1
        assert "it meets objects harder" in slow[0]
        node._close()


class StreamWriter:
    """A command node that does not hear the stop: it goes on to lead one joint, or the TCP down."""

    def __init__(self, arm: Arm, mode: str) -> None:
        self._arm, self._mode = arm, mode
        self._keys = arm._driver.profile.keys
        here = arm.guard._measure()
        self._pose, self._position_rad = here.pose, here.position_rad

    def header(self, step: int) -> bytes:
        return records.encode_header(Header(step * STEP_NS, step, "command#1"))

    def command(self, step: int) -> tuple[str, bytes]:
        time_s, ramp_s = step * STEP_NS / 1e9, 0.3
        speeding_s = min(time_s, ramp_s)
        way = 0.1 * (speeding_s**2 / (2 * ramp_s) + time_s - speeding_s)
        rate, change = 0.1 * speeding_s / ramp_s, 0.1 / ramp_s * (time_s < ramp_s)
        if self._mode == "joint":
            names = self._arm._driver.profile.robot.arm_joints
            first = np.eye(len(names))[3]
            record = JointCommand(
                names, self._position_rad + way * first, rate * first, change * first, "active"
            )
            return self._keys.command_joint, records.encode(record)
        down, quat_xyzw = -np.eye(6)[2], quat_from_rotation(self._pose.rotation)
        at_m = self._pose.position_m + way * down[:3]
        record = PoseCommand(at_m, quat_xyzw, rate * down, change * down, at_m, quat_xyzw, "active")
        return self._keys.command_pose, records.encode(record)
