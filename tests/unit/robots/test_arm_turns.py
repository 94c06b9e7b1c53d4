"""An arm of one's own, turn by turn: what its file says and raises, and what that does to it."""

from __future__ import annotations

import random
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
import zenoh
from camera_rig import free_endpoint, routed_session, until
from guard_rig import JointWriter

from vla_zenoh.bus import buffers as slots
from vla_zenoh.bus.clock import Tick
from vla_zenoh.bus.session import open_session
from vla_zenoh.codec import message, records
from vla_zenoh.control.limits import joint_motion_limits
from vla_zenoh.errors import NodeError
from vla_zenoh.guard.reference_governor import BRAKE_MARGIN
from vla_zenoh.profile import load_profile, override
from vla_zenoh.robots import python_driver
from vla_zenoh.robots.node import FAILURES, LEAST_S, RobotNode
from vla_zenoh.robots.python_driver import PythonDriver
from vla_zenoh.runtime.kept_text import KeptText
from vla_zenoh.types import (
    Event,
    FloatArray,
    GripperCommand,
    GripperState,
    Header,
    JointCommand,
    JointState,
)

TICK_S, TICK_NS = 0.004, 4_000_000
SPEED_RAD_S, RAMP_S = 0.3, 0.1
JOINT = 2
MOVING = 100
"""Turns after which the arm is in full motion."""
BRAKED_RAD = 1e-5
SAG_RAD = 0.004
HEARD = 15
"""Of a fault, however brief it is, so many states tell."""
JERKED_RAD = 2.5e-4
"""Two steps differ by less: a tick of twice the acceleration of `limits.joint`."""
FAULT = "protective stop"
ARM = """
from vla_zenoh.robot import Reading

class Arm:
    def __init__(self):
        self.position_rad, self.said, self.moves, self.failing, self.tried = None, {}, [], 0, 0
        self.widths_m, self.velocity_rad_s = [], None

    def read(self):
        if "raise" in self.said:
            raise OSError("the cable is out")
        return Reading(**{"position_rad": self.position_rad, **self.said})

    def move(self, command):
        self.tried += 1
        if self.failing:
            self.failing -= 1
            raise OSError("the cable is out")
        self.moves.append(command.position_rad)
        self.position_rad, self.velocity_rad_s = command.position_rad, command.velocity_rad_s

    def grip(self, width_m, speed_m_s, force_n):
        self.widths_m.append(width_m)
"""
SLOW_S = 0.09
"""Between two turns of a loop that is late: by less than timing.command_timeout_s."""
GENTLE = "limits: {joint: {jerk_rad_s3: 0.5}}"
"""From 0.3 rad/s the robot's own stop takes 1.1 s."""
PROFILE = """
extends: panda_sim
robot: {driver: arm, command: joint}
arm: {file: my_arm.py}
cameras: {front: null, wrist: null}
hosts: {here: {nodes: [router, arm, command, worker]}}
"""


@dataclass
class Turns:
    """An arm whose time passes as fast as it can; `script` is called before each turn."""

    node: RobotNode
    session: zenoh.Session
    home_rad: FloatArray
    heard: dict[type, list[Any]]
    mono_ns: int = 10**12
    turn: int = 0
    script: dict[int, Callable[[], None]] = field(default_factory=dict)
    last: int = 2 * MOVING
    period_s: float = TICK_S
    stall_s: float = 0.0
    """How late the next turn is."""
    state: str = "active"
    behind_ns: int = 0
    """By so much the clock of who leads it is behind."""
    stop: threading.Event = field(default_factory=threading.Event)

    @property
    def arm(self) -> Any:
        return cast("PythonDriver", self.node.driver).robot

    def wait(self) -> Tick:
        self.mono_ns += round(self.period_s * 1e9)
        self.stall_s = 0.0
        self.script.get(self.turn, lambda: None)()
        self.turn += 1
        if self.turn > self.last:
            self.stop.set()
        self.lead()
        return Tick(1, self.mono_ns, self.stall_s, 0.0)

    def lead(self) -> None:
        """A joint is led at a speed that it reached from rest."""
        time_s = self.turn * TICK_S
        ramp_s = min(time_s, RAMP_S)
        way_rad = SPEED_RAD_S * (ramp_s * ramp_s / (2 * RAMP_S) + time_s - ramp_s)
        names = self.node.node.profile.robot.arm_joints
        columns = np.zeros((3, len(names)))
        columns[0] = self.home_rad
        columns[:, JOINT] += (
            way_rad,
            SPEED_RAD_S * ramp_s / RAMP_S,
            SPEED_RAD_S / RAMP_S if time_s < RAMP_S else 0.0,
        )
        stamp_ns = self.node.node.clock.wall_at(self.mono_ns) - self.behind_ns
        header = Header(stamp_ns, self.turn, "command#1")
        self.session.put(
            self.node.node.keys.command_joint,
            records.encode(JointCommand(names, columns[0], columns[1], columns[2], self.state)),
            attachment=records.encode_header(header),
        )

    def ask(self, width_m: float, age_s: float = 0.0) -> None:
        """The one who leads the arm orders an opening, so long ago."""
        stamp_ns = self.node.node.clock.wall_at(self.mono_ns) - round(age_s * 1e9)
        header = Header(stamp_ns, self.turn, "command#1")
        self.session.put(
            self.node.node.keys.command_gripper,
            records.encode(GripperCommand(width_m, 0.1, 10.0)),
            attachment=records.encode_header(header),
        )

    def run(self) -> None:
        self.node._loop(self.wait, self.stop)

    def say(self, **said: Any) -> Callable[[], None]:
        return lambda: self.arm.said.update(said)

    def refused(self, reason: str) -> int:
        return self.node.node.counters[f"refused.{reason}"]

    @property
    def steps_rad(self) -> FloatArray:
        return np.diff([move[JOINT] for move in self.arm.moves])

    @property
    def faults(self) -> list[tuple[str, ...]]:
        return [state.faults for state in self.heard[GripperState]]

    def told(self, what: str) -> list[Event]:
        return [event for event in self.heard[Event] if event.what == what]


@pytest.fixture
def turns(
    tmp_path: Path, request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch
) -> Iterator[Turns]:
    (tmp_path / "my_arm.py").write_text(ARM)
    (tmp_path / "lab.yaml").write_text(PROFILE + getattr(request, "param", ""))
    profile = load_profile(str(tmp_path / "lab.yaml"))
    with routed_session() as session:
        node = RobotNode(PythonDriver(profile), session)
        home_rad = np.array(profile.robot.home_rad)
        heard: dict[type, list[Any]] = {}
        keys, subscribers = profile.keys, []
        for key, kind in (
            (keys.state_joint, JointState),
            (keys.state_gripper, GripperState),
            (keys.event("arm"), Event),
        ):
            into = heard.setdefault(kind, [])

            def keep(sample: zenoh.Sample, kind: type = kind, into: list[Any] = into) -> None:
                into.append(records.decode(kind, sample.payload.to_bytes()))

            handler = zenoh.handlers.Callback(keep, indirect=False)
            subscribers.append(session.declare_subscriber(key, handler))
        turns = Turns(node, session, home_rad, heard)
        turns.arm.position_rad = home_rad
        clock = SimpleNamespace(monotonic_ns=lambda: turns.mono_ns)
        for module in (slots, python_driver):
            monkeypatch.setattr(module, "time", clock)
        yield turns
        turns.node._close()


def stand_still(turns: Turns, stall_s: float) -> None:
    turns.mono_ns += round(stall_s * 1e9)
    turns.stall_s = stall_s


def braked(turns: Turns) -> None:
    """The motion was led to rest, and not cut."""
    full_rad = SPEED_RAD_S * TICK_S
    assert turns.steps_rad.max() > 0.9 * full_rad
    assert abs(turns.steps_rad[-1]) < BRAKED_RAD
    assert turns.refused("joint_foreign") == 0


def test_whatever_is_not_raised_the_motion_is_led_to_the_end(turns: Turns) -> None:
    turns.run()
    braked(turns)
    assert np.abs(np.diff(turns.steps_rad)).max() < JERKED_RAD


@pytest.mark.parametrize("turns", [GENTLE], indirect=True)
def test_a_brake_that_takes_long_is_brought_to_its_end(turns: Turns) -> None:
    turns.run()
    braked(turns)
    assert (turns.turn - turns.last) * TICK_S > LEAST_S
    assert not turns.told("not_braked")


def test_a_loop_that_is_too_slow_to_brake_ends_in_time_and_says_so(turns: Turns) -> None:
    turns.script[turns.last] = lambda: setattr(turns, "period_s", SLOW_S)
    turns.run()
    assert (turns.turn - turns.last) * SLOW_S < 2 * LEAST_S
    (event,) = turns.told("not_braked")
    assert "the loop was late too often" in event.why


@pytest.mark.parametrize("turns", ["timing: {state_hz: 100}"], indirect=True)
def test_states_of_a_real_arm_are_published_no_more_often_than_the_profile_says(
    turns: Turns,
) -> None:
    turns.run()
    most = 100 * turns.turn * TICK_S
    assert 0.7 * most < len(turns.heard[JointState]) <= most + 1


def test_a_writer_whose_clock_is_set_back_in_motion_goes_on(turns: Turns) -> None:
    turns.script[MOVING] = lambda: setattr(turns, "behind_ns", 3 * 10**9)
    turns.run()
    braked(turns)
    assert turns.refused("joint_stale") == 0
    assert np.abs(np.diff(turns.steps_rad)).max() < JERKED_RAD


def test_no_stream_of_old_commands_begins(turns: Turns) -> None:
    turns.behind_ns = 3 * 10**9
    turns.run()
    assert turns.refused("joint_stale") > MOVING
    assert turns.arm.moves == []


def test_over_an_ill_link_what_move_is_given_keeps_the_limits(turns: Turns) -> None:
    """As one computes velocity, acceleration and jerk who is given positions alone."""
    rng, profile = random.Random(1), turns.node.node.profile
    writer, waiting = JointWriter(profile, turns.home_rad, rng), []
    held_until = 0

    def lead() -> None:
        nonlocal held_until
        if turns.turn % 60 == 1:
            writer.aim()
        stamp_ns = turns.node.node.clock.wall_at(turns.mono_ns)
        header = Header(stamp_ns, turns.turn, "command#1")
        if rng.random() < 0.01:
            held_until = turns.turn + rng.randint(2, 20)
        if rng.random() < 0.85:
            arrives = max(turns.turn + rng.randint(0, 4), held_until)
            waiting.append((arrives, header, writer.tick()))
        else:
            writer.tick()
        for each in [each for each in waiting if each[0] <= turns.turn]:
            waiting.remove(each)
            turns.session.put(
                turns.node.node.keys.command_joint,
                records.encode(each[2]),
                attachment=records.encode_header(each[1]),
            )

    turns.lead = lead  # type: ignore[method-assign]
    turns.last = 6 * MOVING
    for late in (1, 3):
        turns.script[late * MOVING] = lambda: setattr(turns, "period_s", 0.03)
        turns.script[late * MOVING + 1] = lambda: setattr(turns, "period_s", TICK_S)
    turns.run()
    stood = np.repeat([turns.home_rad], 3, axis=0)
    path = np.vstack([stood, turns.arm.moves])
    for order, limit in enumerate(joint_motion_limits(profile, BRAKE_MARGIN), start=1):
        differences = np.abs(np.diff(path, order, axis=0)) / TICK_S**order
        assert (differences.max(axis=0) <= 1.04 * limit).all()
        assert differences.max() > 0.3 * limit.min()
    assert len(path) > 5 * MOVING


@pytest.mark.parametrize(("stall_s", "given"), [(0.2, 1), (10.0, 0)])
def test_after_a_brief_stall_the_arm_is_given_its_last_set_point_at_rest_and_no_velocity(
    turns: Turns, stall_s: float, given: int
) -> None:
    """After a long one it is given nothing: it may have been moved by other means meanwhile."""

    def stall() -> None:
        assert turns.arm.velocity_rad_s[JOINT] > 0.9 * SPEED_RAD_S
        stand_still(turns, stall_s)

    turns.script[MOVING] = stall
    turns.last = MOVING + 50
    turns.run()
    assert turns.node.arm is not None
    assert turns.node.arm.stalls == 1
    assert len(turns.arm.moves) == MOVING + given
    if given:
        np.testing.assert_array_equal(turns.arm.moves[-1], turns.arm.moves[-2])
        np.testing.assert_array_equal(turns.arm.velocity_rad_s, 0.0)


# -- what is raised ---------------------------------------------------------------------------
@pytest.mark.parametrize("failing", [1, FAILURES])
def test_moves_that_fail_brake_the_arm_by_those_that_follow(turns: Turns, failing: int) -> None:
    turns.script[MOVING] = lambda: setattr(turns.arm, "failing", failing)
    with pytest.raises(NodeError, match=r"my_arm\.py: move: OSError: the cable is out"):
        turns.run()
    assert turns.turn < turns.last
    braked(turns)
    assert turns.refused("robot_failed") == 1
    assert not turns.told("not_braked")


def test_an_arm_that_cannot_be_moved_any_more_is_given_up_and_that_is_told(turns: Turns) -> None:
    turns.script[MOVING] = lambda: setattr(turns.arm, "failing", 1000)
    with pytest.raises(NodeError, match="move"):
        turns.run()
    assert turns.arm.tried - len(turns.arm.moves) == 1 + FAILURES
    (event,) = turns.told("not_braked")
    assert event.why.startswith("it cannot be braked: ")


def test_a_read_that_raises_brakes_the_arm(turns: Turns) -> None:
    turns.script[MOVING] = turns.say(**{"raise": True})
    with pytest.raises(NodeError, match="read: OSError"):
        turns.run()
    braked(turns)


@pytest.fixture
def breaks(turns: Turns, monkeypatch: pytest.MonkeyPatch) -> Callable[[], None]:
    """Raises something in the loop from now on."""

    def unforeseen() -> None:
        raise RuntimeError("unforeseen")

    return lambda: monkeypatch.setattr(turns.node, "_watch", unforeseen)


def test_what_breaks_in_the_loop_itself_brakes_the_arm(
    turns: Turns, breaks: Callable[[], None]
) -> None:
    turns.script[MOVING] = breaks
    with pytest.raises(RuntimeError, match="unforeseen"):
        turns.run()
    braked(turns)
    assert np.abs(np.diff(turns.steps_rad)).max() < JERKED_RAD
    (event,) = turns.told("broken")
    assert event.why.endswith(": braked, and ends")
    assert not turns.told("not_braked")


def test_an_arm_that_stood_while_the_loop_did_is_not_moved_again_by_its_brake(
    turns: Turns, breaks: Callable[[], None]
) -> None:
    turns.script[MOVING] = breaks
    turns.script[MOVING + 1] = lambda: stand_still(turns, 0.2)
    with pytest.raises(RuntimeError, match="unforeseen"):
        turns.run()
    assert turns.node.arm is not None
    assert turns.node.arm.stalls == 1
    assert len(turns.arm.moves) == MOVING + 2, "after that in which it broke, once more at rest"
    assert turns.steps_rad[-1] == 0.0


# -- what is read -----------------------------------------------------------------------------
@pytest.mark.parametrize(
    "nonsense",
    [{"width_m": float("nan")}, {"measured_ns": 0.5}, {"position_rad": [float("nan")] * 7}],
    ids=str,
)
def test_of_a_reading_that_does_not_hold_nothing_is_told_and_the_loop_goes_on(
    turns: Turns, nonsense: dict[str, Any]
) -> None:
    turns.script[MOVING] = turns.say(**nonsense)
    turns.script[MOVING + 10] = turns.arm.said.clear
    turns.run()
    assert turns.refused("invalid") == 10
    assert len(turns.heard[JointState]) == len(turns.heard[GripperState])
    assert turns.turn > turns.last
    braked(turns)


def test_what_is_no_command_of_this_arm_is_rejected_by_its_reason(turns: Turns) -> None:
    key, zeros = turns.node.node.keys.command_joint, np.zeros(7)
    strange = JointCommand(tuple("abcdefg"), zeros, zeros, zeros, "active")
    fields = message.unpack(records.encode(strange))
    wrong = [
        b"",
        b"\xff\x00nonsense",
        message.pack({"names": ["a"]}),
        message.pack(fields | {"position_rad": np.full(7, np.nan)}),
        message.pack(fields | {"velocity_rad_s": np.zeros(3)}),
        records.encode(strange),
    ]

    def put() -> None:
        stamp_ns = turns.node.node.clock.wall_at(turns.mono_ns)
        header = records.encode_header(Header(stamp_ns, 10**6, "command#1"))
        turns.session.put(key, wrong[-1])
        for payload in wrong:
            turns.session.put(key, payload, attachment=header)

    turns.script[MOVING] = put
    turns.run()
    reasons = ("no_header", "malformed", "invalid", "joint_names")
    assert [turns.refused(reason) for reason in reasons] == [1, 3, 2, 1]
    braked(turns)


def once(turns: Turns, **said: Any) -> None:
    """It is in a fault for one reading, in full motion."""
    turns.script[MOVING] = turns.say(fault=FAULT, **said)
    turns.script[MOVING + 1] = turns.arm.said.clear


@pytest.mark.parametrize(
    "said",
    [{}, {"measured_ns": 10**12 + MOVING * TICK_NS}, {"position_rad": [float("nan")] * 7}],
    ids=["new", "old", "invalid"],
)
def test_a_fault_of_one_reading_is_told_for_a_while_whatever_else_it_says(
    turns: Turns, said: dict[str, Any]
) -> None:
    once(turns, **said)
    turns.run()
    told = [index for index, faults in enumerate(turns.faults) if faults == (FAULT,)]
    assert len(told) > HEARD
    assert turns.faults[-1] == ()
    assert len(turns.told("robot_fault")) == 1
    assert turns.refused("joint_fault") > 0


@pytest.mark.parametrize(
    "said", [{"measured_ns": 1}, {"position_rad": [float("nan")] * 7}], ids=["old", "invalid"]
)
def test_a_fault_that_stands_is_told_again_and_again_without_a_reading_that_holds(
    turns: Turns, said: dict[str, Any]
) -> None:
    turns.script[0] = turns.say(fault=FAULT, **said)
    turns.run()
    assert len(turns.faults) > 2
    assert set(turns.faults) == {(FAULT,)}
    assert turns.node.state == "fault"
    assert turns.arm.moves == []


def test_a_fault_is_told_in_words_that_everybody_can_read(turns: Turns) -> None:
    turns.script[0] = turns.say(fault="\udc80\x1b[2J" + "very long " * 100)
    turns.last = 10
    turns.run()
    assert turns.node.state == "fault"
    assert "\x1b" not in turns.faults[-1][0]


# -- an arm that holds its set-point in motion alone ----------------------------------------------
def test_a_stream_begins_where_the_arm_is_measured_once_nothing_holds_the_last_set_point(
    turns: Turns,
) -> None:
    idle, begins = 4 * MOVING, 5 * MOVING
    held: list[Any] = []
    given_before: list[int] = []

    def stop_short() -> None:
        sag_rad = np.zeros(7)
        sag_rad[JOINT] = SAG_RAD  # something is in its way
        turns.arm.said["position_rad"] = turns.arm.moves[-1] - sag_rad

    def begin() -> None:
        names, still = turns.node.node.profile.robot.arm_joints, np.zeros(7)
        command = JointCommand(names, turns.arm.said["position_rad"], still, still, "active")
        header = Header(turns.node.node.clock.wall_at(turns.mono_ns), turns.turn, "command#1")
        turns.session.put(
            turns.node.node.keys.command_joint,
            records.encode(command),
            attachment=records.encode_header(header),
        )

    turns.script = {
        MOVING: lambda: setattr(turns, "lead", lambda: None),
        idle - 50: stop_short,
        idle - 1: lambda: held.append(turns.heard[JointState][-1].reference_rad),
        idle: turns.say(idle=True),
        idle + 10: lambda: held.append(turns.heard[JointState][-1].reference_rad),
        begins - 1: lambda: given_before.append(len(turns.arm.moves)),
        begins: lambda: setattr(turns, "lead", begin),
    }
    turns.last = begins + 20
    turns.run()
    np.testing.assert_allclose(held[0], turns.arm.moves[given_before[0] - 1])
    assert held[1] is None
    given = np.array(turns.arm.moves[given_before[0] :])
    assert len(given) >= 20
    np.testing.assert_allclose(given - turns.arm.said["position_rad"], 0.0, atol=BRAKED_RAD)


# -- another node of its name ------------------------------------------------------------------
def test_no_arm_is_connected_by_a_node_whose_name_another_one_has(tmp_path: Path) -> None:
    (tmp_path / "my_arm.py").write_text(ARM)
    (tmp_path / "lab.yaml").write_text(PROFILE)
    endpoint, connected = free_endpoint(), list[bool]()
    where = {"session": {"listen": [endpoint], "connect": [endpoint]}}
    profile = override(load_profile(str(tmp_path / "lab.yaml")), where)
    key, there = profile.keys.clock("arm"), {"heard_ns": 0, "said_ns": 0}
    with (
        open_session(profile.session, mode="router"),
        open_session(profile.session) as theirs,
        open_session(profile.session) as ours,
    ):
        reply = message.pack(there)
        handler = zenoh.handlers.Callback(lambda query: query.reply(key, reply), indirect=False)
        _another = theirs.declare_queryable(key, handler)
        asking = ours.declare_querier(key)
        until("the other one is there", lambda: asking.matching_status.matching)
        driver = PythonDriver(profile)
        driver.connect = lambda: connected.append(True)
        with pytest.raises(NodeError, match="is already running"):
            RobotNode(driver, ours).run(threading.Event())
    assert not connected


# -- the gripper ------------------------------------------------------------------------------
def test_the_gripper_outlives_neither_a_stop_nor_the_age_of_its_orders(turns: Turns) -> None:
    turns.script[MOVING] = lambda: turns.ask(0.05)
    turns.script[MOVING + 1] = lambda: turns.ask(0.06, age_s=2.0)
    turns.script[MOVING + 9] = lambda: setattr(turns, "state", "stopped")
    turns.script[MOVING + 10] = lambda: turns.ask(0.07)
    turns.script[turns.last] = lambda: turns.ask(0.08)  # this node is told to end
    turns.run()
    assert turns.arm.widths_m == [0.05]
    assert turns.refused("stale") == 1
    assert turns.refused("outlived") == 1


def test_a_stop_is_heard_without_a_command_node_and_latches(turns: Turns) -> None:
    keys, stopped_at = turns.node.node.keys, turns.last // 2
    turns.script[stopped_at] = lambda: turns.session.put(keys.stop, "stop")
    turns.run()
    braked(turns)
    moved = len(turns.arm.moves)
    assert moved < turns.last  # the stream goes on, and the arm is sent nothing more
    assert turns.heard[GripperState][-1].mode == "latched"
    assert turns.node.state == "latched"
    assert [event.what for event in turns.heard[Event]].count("running->latched") == 1


def test_a_gripper_command_that_comes_after_a_stop_is_ignored_also_after_a_reset(
    turns: Turns,
) -> None:
    keys, stopped_at = turns.node.node.keys, turns.last // 2
    turns.script[stopped_at] = lambda: turns.session.put(keys.stop, "stop")
    turns.script[stopped_at + 5] = lambda: turns.ask(0.01)
    turns.script[stopped_at + 10] = lambda: turns.session.put(keys.reset, "reset")
    turns.run()
    assert not turns.arm.widths_m
    assert turns.node.state != "latched"


def test_a_stop_outlives_the_robot_node_that_heard_it(
    turns: Turns, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    latch = tmp_path / "stopped-arm"
    turns.node._latch = KeptText(latch)
    turns.session.put(turns.node.node.keys.stop, "stop")
    turns.node.step(turns.wait())
    until("the latch is written", latch.exists)
    driver = PythonDriver(turns.node.node.profile)
    keys = turns.node.node.keys
    turns.node._close()
    again = RobotNode(driver, turns.session, latch=latch)
    try:
        assert again.state == "waiting"
        driver.robot.position_rad = turns.home_rad
        again.step(turns.wait())
        assert again.state == "latched"
        turns.session.put(keys.reset, "reset")
        again.step(turns.wait())
        assert again.state == "running"
        until("the latch is removed", lambda: not latch.exists())
    finally:
        turns.node = again


@pytest.mark.parametrize("late", [False, True])
def test_a_reset_that_was_put_before_a_stop_does_not_clear_it(turns: Turns, late: bool) -> None:
    keys = turns.node.node.keys
    for key in (keys.stop, keys.reset) if late else (keys.reset, keys.stop):
        turns.session.put(key, "")
    turns.node.step(turns.wait())
    assert turns.node.state in ("latched", "waiting")
    assert all(arm.stop_latched for arm in turns.node.arms.values())
    assert turns.refused("reset_refused") == 1


@pytest.mark.parametrize(("waits_s", "clears"), [(0.1, False), (60.0, True)])
def test_of_two_stops_the_one_that_was_put_last_counts_for_a_while(
    turns: Turns, waits_s: float, clears: bool
) -> None:
    keys, session = turns.node.node.keys, turns.session
    turns.script, turns.last = {}, 10**6
    first, between, last = (session.new_timestamp() for _ in range(3))
    for stamp in (last, first):
        session.put(keys.stop, "stop", timestamp=stamp)
        turns.node.step(turns.wait())
    stand_still(turns, waits_s)
    session.put(keys.reset, "reset", timestamp=between)
    turns.node.step(turns.wait())
    assert all(arm.stop_latched is not clears for arm in turns.node.arms.values())
