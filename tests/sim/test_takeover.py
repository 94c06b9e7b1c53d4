"""A person takes the arm from a model in motion, at random moments, and gives it back.

The person is what runs in ``vla-zenoh teleop``: the policy of the keys and sticks, or that of a
leader arm. Each seed is a run of its own; what was commanded and how MuJoCo's arm moved keep the
limits of velocity, acceleration and jerk from its beginning to its end.
"""

from __future__ import annotations

import random
from collections.abc import Callable, Iterator
from functools import partial

import numpy as np
import pytest
from arm_rig import (
    STILL_M_S,
    begin,
    check_motion,
    shipped,
    speed_m_s,
)
from vla_zenoh_benchmarks.lockstep.loop import Lockstep
from vla_zenoh_benchmarks.lockstep.worker import Message
from vla_zenoh_teleop.leader import LeaderPolicy, LeaderState
from vla_zenoh_teleop.policy import AXES, OperatorInput, TeleopPolicy

from vla_zenoh.policy import Policy
from vla_zenoh.types import (
    ActionChunk,
)

SEEDS = range(10)
TAKEOVERS = 5
"""Of each seed: 50 in all."""
AWAY_RAD, AWAY_S = 0.04, 0.3
"""A leader goes this far from where it began, so that the arm stays off the table and itself."""
SUM_M, SUM_RAD = 2e-3, 0.01
"""Of a minute of actions, in float32, beside where the commanded goal went."""


class Person:
    """At the keys: pushes and turns by chance, sometimes nothing."""

    def __init__(self, rng: random.Random) -> None:
        self._rng, self.wish, self.level = rng, OperatorInput(), 2

    def change(self) -> None:
        axes = [self._rng.choice((-1.0, 0.0, 0.0, 0.4, 1.0)) for _ in range(AXES)]
        self.wish = OperatorInput(tuple(axes), self._rng.choice((0.0, 0.0, -1.0, 1.0)))
        self.level = self._rng.randrange(5)

    def policy(self) -> Policy:
        return TeleopPolicy(shipped(), "teleop", lambda: self.wish, lambda: self.level)


class Leader(Person):
    """Moves a leader arm that stands elsewhere, each joint at a speed of its own."""

    def __init__(self, rng: random.Random, now_s: Callable[[], float]) -> None:
        super().__init__(rng)
        self._now_s = now_s
        joints = len(shipped().robot.arm_joints)
        self._start = np.array([rng.uniform(-1, 1) for _ in range(joints)])
        self._path = [LeaderState(now_s(), self._start, 0.08)]
        self._rates = np.zeros(joints)

    def change(self) -> None:
        there = self._start + [self._rng.uniform(-AWAY_RAD, AWAY_RAD) for _ in self._rates]
        self._rates = (there - self.path()[-1].position_rad) / AWAY_S

    def path(self) -> list[LeaderState]:
        last = self._path[-1]
        passed_s = self._now_s() - last.time_s
        if passed_s > 0:
            there = last.position_rad + passed_s * self._rates
            self._path.append(LeaderState(last.time_s + passed_s, there, 0.08))
        return self._path[-200:]

    def policy(self) -> Policy:
        return LeaderPolicy(shipped(), "teleop", self.path, self._now_s)


def wandering(rng: random.Random) -> str:
    """A prompt by which the model moves the arm by some millimetres per step, near its home."""
    return " ".join(f"{rng.uniform(-0.012, 0.012):.4f}" for _ in range(3))


def taken_over(
    seed: int, make: Callable[[random.Random, Callable[[], float]], Person], *, bounded: bool
) -> tuple[Lockstep, list[Message]]:
    """A run in which the arm changes hands at random moments; all that was on the wire."""
    rng = random.Random(seed)
    now: list[Lockstep] = []
    person = make(rng, lambda: now[0].now_ns / 1e9 if now else 0.0)
    # The elbow of seed 5 drifts to 31 mrad before the end of joint 4, and in steps of two
    # milliseconds to 23, where the arm brakes: design.md, Not done.
    others = {"teleop": person.policy()}
    loop = begin("0 0 0.012", others=others, bounded=bounded, clear=True, steps=1)
    now.append(loop)
    wire: list[Message] = []
    loop.tamper = partial(_noted, wire)
    moving = 0
    for _ in range(TAKEOVERS):
        loop.put("prompt", wandering(rng))
        loop.run(rng.uniform(0.3, 0.9))
        moving += bool(speed_m_s(loop)[-1] > STILL_M_S)
        person.change()
        chunks = len(_chunks(wire, "scripted"))
        _lead(loop, "teleop")
        for _ in range(rng.randrange(1, 4)):
            loop.run(rng.uniform(0.1, 0.5))
            person.change()
        assert len(_chunks(wire, "scripted")) > chunks, "the model goes on in shadow"
        _lead(loop, "scripted")
    loop.run(0.5)
    assert moving >= TAKEOVERS - 1, "the arm was taken in motion"
    return loop, wire


def _noted(wire: list[Message], message: Message) -> Iterator[Message]:
    wire.append(message)
    yield message


def _lead(loop: Lockstep, worker: str) -> None:
    loop.put("worker", worker)
    loop.run(0.01)
    assert loop.commander.task.worker == worker, loop.commander.why


def _chunks(wire: list[Message], worker: str) -> list[Message]:
    return [each for each in wire if each.kind is ActionChunk and worker in each.header.source]


@pytest.mark.slow
@pytest.mark.parametrize("seed", SEEDS)
def test_an_arm_that_is_taken_over_in_motion_keeps_its_limits(seed: int) -> None:
    loop, _ = taken_over(seed, lambda rng, _: Person(rng), bounded=seed % 2 == 1)
    assert loop.commander.state.value == "active", loop.commander.why
    check_motion(loop)


@pytest.mark.slow
@pytest.mark.parametrize("seed", SEEDS)
def test_an_arm_that_a_leader_arm_takes_over_in_motion_keeps_its_limits(seed: int) -> None:
    """The leader stands elsewhere, and moves while it does not lead."""
    loop, _ = taken_over(seed, Leader, bounded=True)
    assert loop.commander.state.value == "active", loop.commander.why
    check_motion(loop)
