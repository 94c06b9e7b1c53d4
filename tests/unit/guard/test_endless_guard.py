"""The robot's side of joints that turn without an end: many turns pass, and nothing else does."""

from __future__ import annotations

import math

import numpy as np
import pytest

from vla_zenoh.control.limits import JointMotionLimits
from vla_zenoh.guard.stream_guard import JointGuard
from vla_zenoh.types import Header, JointCommand, Stamped

NAMES = ("shoulder", "wrist")
BRAKE = JointMotionLimits(np.full(2, 2.0), np.full(2, 10.0), np.full(2, 200.0))
ENDS = np.array([-1.0, -math.inf]), np.array([1.0, math.inf])
HERE = np.array([0.0, 3.0])
TURNS = np.zeros(2, bool)
TICK_NS, START_NS = 4_000_000, 10**18
SPEED_RAD_S, RAMP_S = 1.5, 0.5


class Stream:
    """Commands to a guard of an arm that stands at `HERE`."""

    def __init__(self) -> None:
        self.guard = JointGuard(NAMES, HERE, TICK_NS / 1e9, 0.1, BRAKE, ENDS, TURNS)
        self.seq = 0

    @property
    def now_ns(self) -> int:
        return START_NS + self.seq * TICK_NS

    def offer(self, *at: float, speed: float = 0.0, change: float = 0.0) -> str | None:
        """A command for both joints, with the wrist's speed and acceleration."""
        self.seq += 1
        rates = np.array([0.0, speed]), np.array([0.0, change])
        record = JointCommand(NAMES, np.array(at), *rates, "active")
        command = Stamped(Header(self.now_ns, self.seq, "command#1"), record, self.now_ns)
        reason = self.guard.offer(command, self.now_ns)
        self.guard.tick(self.now_ns)
        return reason


def test_three_turns_pass_without_a_jump() -> None:
    stream, wrist, places = Stream(), HERE[1], []
    turn_1_s, end = math.pi / RAMP_S, HERE[1] + 6 * math.pi
    while wrist < end:
        since_s = min((stream.seq + 1) * TICK_NS / 1e9, RAMP_S)
        speed = SPEED_RAD_S * (1 - math.cos(turn_1_s * since_s)) / 2
        change = SPEED_RAD_S * turn_1_s * math.sin(turn_1_s * since_s) / 2
        wrist += speed * TICK_NS / 1e9
        assert stream.offer(0.0, wrist, speed=speed, change=change) is None
        places.append(stream.guard.motion.position_rad[1])
    steps = np.diff(places)
    assert steps.max() < 1.001 * SPEED_RAD_S * TICK_NS / 1e9 + 1e-6
    assert steps.min() > -1e-6
    assert places[-1] == pytest.approx(end, abs=0.02)


def test_too_fast_a_turn_is_rejected() -> None:
    stream = Stream()
    assert stream.offer(*HERE) is None
    assert stream.offer(0.0, 3.0, speed=2.1) == "too_fast"


@pytest.mark.parametrize("turns", [-1, 1, 20])
def test_the_same_place_some_turns_away_is_a_jump(turns: int) -> None:
    """As of a command node that went on while the robot's was started again."""
    stream = Stream()
    assert stream.offer(0.0, 3.0 + 2 * math.pi * turns) == "jump"
    assert stream.offer(*HERE) is None
    assert stream.offer(0.0, 3.0 + 2 * math.pi * turns) == "jump"


def test_the_ends_of_the_other_joint_hold() -> None:
    guard = JointGuard(NAMES, np.array([1.0, 99.0]), TICK_NS / 1e9, 0.1, BRAKE, ENDS, TURNS)
    record = JointCommand(NAMES, np.array([1.001, 99.0]), np.zeros(2), np.zeros(2), "active")
    command = Stamped(Header(START_NS, 1, "command#1"), record, START_NS)
    assert guard.offer(command, START_NS) == "out_of_range"
