"""From bytes of a terminal to steps of an action chunk."""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from vla_zenoh_teleop.keyboard import (
    ACTIVATE,
    HOLD_S,
    MOVES,
    QUIT,
    SILENT_S,
    STOP,
    TAKE_OVER,
    Keyboard,
    KeyEvent,
    Keystroke,
    KeystrokeParser,
)
from vla_zenoh_teleop.leader import LeaderArm, LeaderPolicy, LeaderState
from vla_zenoh_teleop.policy import (
    DEAD_ZONE,
    DT_S,
    HORIZON,
    OPENING_M_S,
    STILL,
    OperatorInput,
    TeleopPolicy,
    combined,
    without_dead_zone,
)
from vla_zenoh_teleop.sticks import Button, Gamepad, SpaceMouse

from vla_zenoh.control.actions import step_pose, step_width
from vla_zenoh.errors import NodeError, PeerError
from vla_zenoh.kinematics.kinematics import make_kinematics
from vla_zenoh.kinematics.so3 import Pose, quat_from_rotation, rotation_from_quat
from vla_zenoh.lab.check.examples import example_observation
from vla_zenoh.policy import Observation, check_steps
from vla_zenoh.profile import load_profile, override
from vla_zenoh.types import GripperState, JointState, PoseState

ATOL = 1e-7
"""m and rad, of float32."""
MAX_M = 0.08


# -- bytes to strokes ---------------------------------------------------------------------------
def test_plain_letters_are_typed_whatever_their_case() -> None:
    assert KeystrokeParser().read(b"wW \r\t") == [
        Keystroke(name, KeyEvent.TYPED) for name in ("w", "w", "space", "enter", "tab")
    ]


def test_a_terminal_with_releases_tells_them() -> None:
    strokes = KeystrokeParser().read(
        b"\x1b[?11u\x1b[119u\x1b[119;1:2u\x1b[119;1:3u\x1b[99;5u\x1b[O"
    )
    assert strokes == [
        Keystroke("releases", KeyEvent.TYPED),
        Keystroke("w", KeyEvent.PRESSED),
        Keystroke("w", KeyEvent.HELD),
        Keystroke("w", KeyEvent.RELEASED),
        Keystroke("ctrl+c", KeyEvent.PRESSED),
        Keystroke("unfocused", KeyEvent.TYPED),
    ]


@given(st.lists(st.integers(0, 30), max_size=6))
def test_where_the_bytes_are_cut_makes_no_difference(cuts: list[int]) -> None:
    data = b"w\x1b[119;1:3u\x1b[As\x1b[?11u x"
    typed, out, at = KeystrokeParser(), [], 0
    for cut in [*sorted(cuts), len(data)]:
        out += typed.read(data[at:cut])
        at = max(at, cut)
    assert out == KeystrokeParser().read(data)


@given(st.binary(max_size=200))
def test_no_bytes_stop_the_keyboard(data: bytes) -> None:
    typed = KeystrokeParser()
    typed.read(data)
    typed.read(b" " * 40)  # ends whatever had begun
    assert typed.read(b"x")[-1] == Keystroke("x", KeyEvent.TYPED)


def test_the_escape_key_does_not_swallow_the_stop_after_it() -> None:
    typed = KeystrokeParser()
    assert typed.read(b"\x1b") == []
    assert typed.read(b"x") == [Keystroke("x", KeyEvent.TYPED)]


# -- strokes to wishes ---------------------------------------------------------------------------
def typed(
    keyboard: Keyboard, keys: str, now_s: float, how: KeyEvent = KeyEvent.TYPED
) -> list[str | None]:
    return [keyboard.update(Keystroke(key, how), now_s) for key in keys]


def test_a_repeating_key_moves_until_the_repeats_end() -> None:
    keyboard = Keyboard()
    for now_s in np.arange(0.0, 1.0, 0.04):
        typed(keyboard, "w", now_s)
        assert keyboard.read(now_s + 0.02).twist == (1, 0, 0, 0, 0, 0)
    assert keyboard.read(1.0 + HOLD_S).twist == STILL


def test_a_tap_between_two_looks_counts_once() -> None:
    keyboard = Keyboard()
    typed(keyboard, "r", 0.0)
    assert keyboard.read(5.0).twist == (0, 0, 1, 0, 0, 0)
    assert keyboard.read(5.1).twist == STILL


def test_a_released_key_stops_at_once() -> None:
    keyboard = Keyboard()
    typed(keyboard, "a", 0.0, KeyEvent.PRESSED)
    for now_s in (0.1, 0.5):  # before it repeats
        assert keyboard.read(now_s).twist == (0, 1, 0, 0, 0, 0)
    typed(keyboard, "a", 0.5, KeyEvent.RELEASED)
    assert keyboard.read(0.5).twist == STILL


def test_a_key_whose_release_never_comes_is_let_go() -> None:
    keyboard = Keyboard()
    keyboard.update(Keystroke("releases", KeyEvent.TYPED), 0.0)
    typed(keyboard, "rw", 0.0, KeyEvent.PRESSED)
    for now_s in np.arange(0.5, 5.0, 0.04):
        typed(keyboard, "w", now_s, KeyEvent.HELD)
        assert keyboard.read(now_s + 0.02).twist == (1, 0, 1, 0, 0, 0)
    assert keyboard.read(5.0 + SILENT_S).twist == STILL
    # What the network held back, all at once.
    typed(keyboard, "www", 7.0, KeyEvent.HELD)
    typed(keyboard, "w", 7.0, KeyEvent.RELEASED)
    assert keyboard.read(7.0).twist == STILL
    typed(keyboard, "w", 8.0, KeyEvent.HELD)
    assert keyboard.read(8.0).twist == (1, 0, 0, 0, 0, 0), "it is held again"


def test_repetitions_that_come_late_move_no_longer_than_a_repetition_lasts() -> None:
    keyboard = Keyboard()
    keyboard.update(Keystroke("releases", KeyEvent.TYPED), 0.0)
    typed(keyboard, "w", 0.0, KeyEvent.PRESSED)
    assert keyboard.read(0.1).twist == (1, 0, 0, 0, 0, 0)
    assert keyboard.read(2.0).twist == STILL
    typed(keyboard, "www", 10.0, KeyEvent.HELD)  # and the release is still under way
    assert keyboard.read(10.0 + HOLD_S).twist == STILL


def test_keys_are_let_go_with_the_window() -> None:
    keyboard = Keyboard()
    typed(keyboard, "wi.", 0.0, KeyEvent.PRESSED)
    keyboard.update(Keystroke("unfocused", KeyEvent.TYPED), 0.1)
    assert keyboard.read(0.1) == OperatorInput()


def test_opposite_keys_cancel_and_others_add() -> None:
    keyboard = Keyboard()
    typed(keyboard, "wsadru", 0.0, KeyEvent.PRESSED)
    assert keyboard.read(0.0).twist == (0, 0, 1, 0, 0, 1)


def test_every_axis_has_both_directions() -> None:
    assert sorted(MOVES.values()) == sorted((axis, sign) for axis in range(6) for sign in (-1, 1))


def test_orders_levels_and_toggles() -> None:
    keyboard = Keyboard()
    given = [
        keyboard.update(Keystroke(key, KeyEvent.TYPED), 0.0)
        for key in ("q", "x", "enter", "tab", "5")
    ]
    assert given == [QUIT, STOP, ACTIVATE, TAKE_OVER, None]
    assert keyboard.level == 4
    for how in (KeyEvent.PRESSED, KeyEvent.HELD, KeyEvent.RELEASED):
        keyboard.update(Keystroke("space", how), 0.0)
    assert keyboard.read(0.0).toggles == 1


@given(st.floats(allow_nan=True, allow_infinity=True))
def test_a_stick_is_zero_in_its_middle_and_never_beyond_its_end(value: float) -> None:
    out = without_dead_zone(value)
    assert -1 <= out <= 1
    if abs(value) <= DEAD_ZONE:
        assert out == 0
    assert abs(without_dead_zone(1.0)) == 1


def test_a_button_counts_when_it_goes_down() -> None:
    button = Button()
    assert [button.pressed(down) for down in (False, True, True, False, True)] == [0, 1, 1, 1, 2]


def test_two_hands_together_are_not_faster_than_one() -> None:
    both = combined(
        OperatorInput((1, 0, 0, 0, 0, 0), 1, 2), OperatorInput((1, -0.5, 0, 0, 0, 0), 0, 1)
    )
    assert both == OperatorInput((1, -0.5, 0, 0, 0, 0), 1, 3)


def test_p_moves_the_next_part() -> None:
    keyboard = Keyboard()
    for stroke in KeystrokeParser().read(b"ppw"):
        keyboard.update(stroke, 0.0)
    assert keyboard.read(0.0) == OperatorInput((1, 0, 0, 0, 0, 0), part=2)


# -- wishes to steps -----------------------------------------------------------------------------
class Person:
    """Says what it is told to."""

    def __init__(self, frame: str = "base") -> None:
        self.read, self.level = OperatorInput(), 2
        profile = load_profile("panda_sim")
        self.policy = TeleopPolicy(
            profile, "teleop", lambda: self.read, lambda: self.level, frame=frame
        )

    def steps(
        self,
        *,
        active: bool = True,
        worker: str = "teleop",
        rate_hz: float = 10.0,
        width_m: float = MAX_M,
        holding: bool = False,
    ) -> np.ndarray:
        seen: Observation = example_observation(self.policy.spec)
        task = replace(seen.task, active=active, worker=worker, rate_hz=rate_hz)
        gripper = GripperState(width_m, False, holding)
        answer = self.policy.infer(replace(seen, task=task, gripper=gripper))
        return check_steps(self.policy.spec.action, answer.steps)


@pytest.mark.parametrize("level", range(5))
def test_a_held_key_moves_at_the_speed_of_its_level(level: int) -> None:
    person = Person()
    person.level = level
    person.read = OperatorInput((0, 0, -1, 0, 0, 1))
    steps, speed = person.steps(), person.policy.speeds[level]
    spec = person.policy.spec.action
    pose = Pose(np.array([0.4, 0.0, 0.3]), np.eye(3))
    for step in steps:
        pose = step_pose(spec, np.asarray(step, float), pose)
    seconds = len(steps) * spec.dt_s
    way_m, angle_rad = seconds * speed.translation_m_s, seconds * speed.rotation_rad_s
    np.testing.assert_allclose(pose.position_m, [0.4, 0.0, 0.3 - way_m], atol=ATOL * len(steps))
    turned = [np.cos(angle_rad), np.sin(angle_rad), 0]
    np.testing.assert_allclose(pose.rotation[:, 0], turned, atol=ATOL * len(steps))


def test_a_chunk_lasts_until_the_next_one_and_no_longer_than_declared() -> None:
    person = Person()
    for rate_hz in (1.0, 5.0, 10.0, 30.0, 100.0):
        lasts_s = len(person.steps(rate_hz=rate_hz)) * DT_S
        assert lasts_s >= min(1 / rate_hz + DT_S, HORIZON * DT_S)
        assert lasts_s <= 1 / rate_hz + 0.2
    assert len(person.steps(rate_hz=0.05)) == HORIZON


def test_nothing_held_asks_for_no_motion() -> None:
    steps = Person().steps()
    np.testing.assert_array_equal(steps[:, :6], 0)
    np.testing.assert_allclose(steps[:, 6], MAX_M, atol=ATOL)


def test_steps_stay_below_the_limits_of_the_profile() -> None:
    profile = load_profile("panda_sim")
    limits = profile.limits.model_copy(update={"step_m": 0.004, "step_rad": 0.02})
    tight = profile.model_copy(update={"limits": limits})
    read = OperatorInput((1, 1, 1, -1, 1, 1))
    policy = TeleopPolicy(tight, "teleop", lambda: read, lambda: 4)
    steps = np.asarray(policy.infer(example_observation(policy.spec)).steps, np.float32)
    assert np.linalg.norm(steps[:, :3].astype(float), axis=1).max() <= 0.004
    assert np.linalg.norm(steps[:, 3:6].astype(float), axis=1).max() <= 0.02


def test_the_gripper_is_toggled_and_moved_only_while_obeyed() -> None:
    person = Person()
    person.read = OperatorInput(toggles=1, opening=-1)
    np.testing.assert_allclose(person.steps(active=False)[:, 6], MAX_M, atol=ATOL)
    person.read = OperatorInput(toggles=1)
    np.testing.assert_allclose(person.steps()[:, 6], MAX_M, atol=ATOL)
    person.read = OperatorInput(toggles=2)
    np.testing.assert_array_equal(person.steps()[:, 6], 0)
    np.testing.assert_array_equal(person.steps(width_m=0.04)[:, 6], 0)
    person.read = OperatorInput(toggles=3)
    np.testing.assert_allclose(person.steps(width_m=0.0)[:, 6], MAX_M, atol=ATOL)


def test_a_held_key_opens_at_its_own_speed_until_the_end() -> None:
    person = Person()
    person.read = OperatorInput(opening=-1)
    widths = [person.steps(rate_hz=10.0)[0, 6] for _ in range(30)]
    np.testing.assert_allclose(np.diff(widths[:10]), -OPENING_M_S / 10, atol=ATOL)
    assert widths[-1] == 0


def test_taking_over_keeps_what_is_held() -> None:
    person = Person()
    np.testing.assert_array_equal(
        person.steps(worker="other", width_m=0.032, holding=True)[:, 6], 0
    )
    np.testing.assert_array_equal(person.steps(width_m=0.032, holding=True)[:, 6], 0)
    person.read = OperatorInput(toggles=1)
    opened = person.steps(width_m=0.032, holding=True)[:, 6]
    np.testing.assert_allclose(opened, MAX_M, atol=ATOL)


@pytest.mark.parametrize("frame", ["base", "tcp"])
def test_every_chunk_fits_what_is_declared(frame: str) -> None:
    person = Person(frame)
    assert person.policy.spec.action.frame == frame
    person.read = OperatorInput((1, -1, 0.5, 0, 0, -1), 1, 5)
    for step in person.steps():
        assert step_width(person.policy.spec.action, step, 0.0, MAX_M) is not None


# -- a leader arm --------------------------------------------------------------------------------
class Led:
    """A leader whose joints and gripper a test says, and the policy that follows it."""

    def __init__(self, command: str = "joint") -> None:
        self.profile = override(load_profile("panda_sim"), {"robot": {"command": command}})
        self.now_s, self.here_rad = 10.0, np.array(self.profile.robot.home_rad)
        self.states = [LeaderState(self.now_s, self.here_rad + 0.3, MAX_M)]
        self.policy = LeaderPolicy(self.profile, "teleop", lambda: self.states, lambda: self.now_s)

    def move(self, turned_rad: float, seconds: float, width_m: float = MAX_M) -> None:
        before = self.states[-1]
        for share in np.linspace(0, 1, 50)[1:]:
            there = before.position_rad + share * turned_rad
            self.states.append(LeaderState(before.time_s + share * seconds, there, width_m))
        self.now_s = before.time_s + seconds

    def steps(
        self, *, worker: str = "teleop", rate_hz: float = 5.0, holding: bool = False
    ) -> np.ndarray:
        seen: Observation = example_observation(self.policy.spec)
        task = replace(seen.task, active=True, worker=worker, rate_hz=rate_hz)
        still = np.zeros(len(self.here_rad))
        joint = JointState(self.profile.robot.arm_joints, self.here_rad, still, still)
        here = make_kinematics(self.profile).forward(self.here_rad)
        quat = quat_from_rotation(here.rotation)
        pose = PoseState(here.position_m, quat, np.zeros(6))
        gripper = GripperState(0.04, False, holding)
        given = replace(seen, task=task, joint=joint, pose=pose, gripper=gripper)
        return check_steps(self.policy.spec.action, self.policy.infer(given).steps)


def test_to_take_over_by_a_leader_that_stands_elsewhere_asks_for_no_motion() -> None:
    led = Led()
    for worker in ("scripted", "teleop"):
        steps = led.steps(worker=worker)
        np.testing.assert_allclose(steps[:, :-1], np.tile(led.here_rad, (len(steps), 1)), atol=ATOL)
    np.testing.assert_allclose(steps[:, -1], 0.04, atol=ATOL)


def test_the_arm_goes_the_way_of_its_leader_from_the_takeover_on() -> None:
    led = Led()
    led.move(0.5, 1.0)
    led.steps(worker="scripted")
    led.move(0.2, 1.0)
    led.steps()
    led.move(0.1, 0.2)
    steps = led.steps(rate_hz=5.0)[:, :-1] - led.here_rad
    wanted = np.minimum(np.arange(1, len(steps) + 1) * DT_S / 0.2, 1.0) * 0.1
    np.testing.assert_allclose(steps, np.tile(wanted[:, None], (1, steps.shape[1])), atol=1e-6)


def test_an_arm_that_takes_poses_follows_the_tcp_of_its_leader() -> None:
    led = Led("pose")
    led.here_rad = led.states[0].position_rad
    led.steps()
    led.move(0.05, 0.2)
    last = led.steps()[-1].astype(float)
    there = make_kinematics(led.profile).forward(led.states[-1].position_rad)
    np.testing.assert_allclose(last[:3], there.position_m, atol=1e-6)
    turned = rotation_from_quat(last[3:7] / np.linalg.norm(last[3:7]))
    np.testing.assert_allclose(turned, there.rotation, atol=1e-6)


def test_the_gripper_follows_once_the_leaders_is_moved() -> None:
    led = Led()
    np.testing.assert_array_equal(led.steps(holding=True)[:, -1], 0.0)
    led.move(0.0, 0.2, width_m=MAX_M - 0.005)
    np.testing.assert_array_equal(led.steps(holding=True)[:, -1], 0.0)
    led.move(0.0, 0.2, width_m=0.06)
    np.testing.assert_allclose(led.steps(holding=True)[:, -1], 0.06, atol=ATOL)


def test_a_leader_that_cannot_be_read_is_named(tmp_path: Path) -> None:
    file = tmp_path / "broken.py"
    file.write_text(
        "class Broken:\n"
        "    def read(self): raise ConnectionError('the cable is out')\n"
        "    def move(self, command): pass\n"
    )
    leader = LeaderArm(file, {}, 7)
    try:
        with pytest.raises(PeerError, match=r"leader broken.py: (the cable|it reads)"):
            leader.path()
    finally:
        leader.close()


def _path(leader: LeaderArm) -> list[LeaderState]:
    try:
        return leader.path()
    except PeerError:  # before its first reading
        return []


def test_a_leader_that_fills_one_array_again_and_again_has_a_path(tmp_path: Path) -> None:
    file = tmp_path / "filled.py"
    file.write_text(
        "import numpy as np\n"
        "from vla_zenoh.robot import Reading\n"
        "class Filled:\n"
        "    position_rad = np.zeros(7)\n"
        "    def read(self):\n"
        "        self.position_rad += 0.01\n"
        "        return Reading(self.position_rad)\n"
        "    def move(self, command): pass\n"
    )
    leader = LeaderArm(file, {}, 7)
    try:
        while len(path := _path(leader)) < 5:
            time.sleep(DT_S)
        turned_rad = [state.position_rad[0] for state in path]
    finally:
        leader.close()
    np.testing.assert_allclose(np.diff(turned_rad), 0.01, atol=ATOL)


# -- devices -------------------------------------------------------------------------------------
@pytest.mark.parametrize("device", [Gamepad, SpaceMouse])
def test_a_device_that_is_not_there_is_named(device: type) -> None:
    with pytest.raises(NodeError, match=r"no (gamepad|SpaceMouse) .*use the keyboard"):
        device()
