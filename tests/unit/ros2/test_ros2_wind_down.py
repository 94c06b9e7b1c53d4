"""The end of the node ``ros2``, turn by turn: whatever ends it, what moves is led to rest first."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
from ros2_turns import SPEED_M_S, TICK_S, Turns, ros2_turns
from vla_zenoh_ros2.arm import Ros2Arm

from vla_zenoh.bus.clock import Tick
from vla_zenoh.robots.node import FAILURES, LEAST_S

MOVING = 60
"""Turns after which the arm is in full motion."""
BRAKED_M = 1e-5
JERKED_M = 1e-4
"""Two steps differ by less: a tick of twice the acceleration of `limits.translation`."""
STALL_S = 0.4
"""Longer than timing.command_timeout_s of the rig's profile, which is 0.3 s."""
GENTLE = "limits: {translation: {jerk_m_s3: 0.3}}\n"
"""From 0.2 m/s the robot's own stop takes 1.15 s."""
GENTLE_RAMP_S = 2.0


class Loop:
    """The pace of the node; the robot is heard and asked to rise before each turn."""

    def __init__(self, turns: Turns) -> None:
        self.turns, self.turn, self.period_s, self.stall_s = turns, 0, TICK_S, 0.0
        self.script: dict[int, Callable[[], None]] = {}
        self.stop = threading.Event()

    def wait(self) -> Tick:
        turns = self.turns
        self.script.get(self.turn, lambda: None)()
        self.turn += 1
        turns.sleep(self.period_s + self.stall_s)
        turns.joint_states()
        turns.up()
        stall_s, self.stall_s = self.stall_s, 0.0
        return Tick(1, turns.mono_ns, stall_s, 0.0)

    def run(self) -> None:
        self.turns.robot._loop(self.wait, self.stop)


@pytest.fixture
def turns(
    tmp_path: Path, request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch
) -> Iterator[Turns]:
    with ros2_turns(tmp_path, monkeypatch, getattr(request, "param", "")) as turns:
        yield turns


@pytest.fixture
def loop(turns: Turns) -> Loop:
    return Loop(turns)


@pytest.fixture
def breaks(loop: Loop, monkeypatch: pytest.MonkeyPatch) -> Callable[..., None]:
    """Raises something in the loop, and more of it in so many targets that are to be sent."""

    def unforeseen(*_: Any) -> None:
        raise RuntimeError("unforeseen" * 1000)

    def break_it(targets: int = 0) -> None:
        driver, failing = cast("Ros2Arm", loop.turns.robot.driver.parts[""]), [unforeseen] * targets
        write = driver._write
        monkeypatch.setattr(loop.turns.robot, "_watch", unforeseen)
        monkeypatch.setattr(
            driver, "_write", lambda *what: failing.pop()() if failing else write(*what)
        )

    return break_it


def braked(turns: Turns) -> None:
    """The motion was led to rest, and not cut."""
    assert turns.steps_m.max() > 0.9 * SPEED_M_S * TICK_S
    assert abs(turns.steps_m[-1]) < BRAKED_M
    assert not turns.told("not_braked")


def ends_broken(loop: Loop) -> str:
    """What is said of it."""
    with pytest.raises(RuntimeError, match="unforeseen"):
        loop.run()
    (event,) = loop.turns.told("broken")
    return event.why


def test_what_breaks_in_the_loop_brakes_the_arm_and_is_told(
    loop: Loop, breaks: Callable[..., None]
) -> None:
    loop.script[MOVING] = breaks
    assert ends_broken(loop).endswith(": braked, and ends")
    braked(loop.turns)
    assert np.abs(np.diff(loop.turns.steps_m)).max() < JERKED_M


def test_a_target_that_cannot_be_sent_is_followed_by_those_that_can(
    loop: Loop, breaks: Callable[..., None]
) -> None:
    loop.script[MOVING] = lambda: breaks(2)
    assert ends_broken(loop).endswith(": braked, and ends")
    braked(loop.turns)


def test_an_arm_that_cannot_be_told_any_more_is_given_up_and_that_is_told(
    loop: Loop, breaks: Callable[..., None]
) -> None:
    loop.script[MOVING] = lambda: breaks(1000)
    assert ends_broken(loop).endswith(": not braked, and ends")
    assert loop.turn == MOVING + FAILURES + 1
    (event,) = loop.turns.told("not_braked")
    assert event.why.startswith("it cannot be braked: unforeseen")


def test_an_arm_that_stood_while_the_loop_did_is_not_moved_again_by_its_brake(
    loop: Loop, breaks: Callable[..., None]
) -> None:
    loop.script[MOVING] = breaks
    loop.script[MOVING + 1] = lambda: setattr(loop, "stall_s", STALL_S)
    assert ends_broken(loop).endswith(": braked, and ends")
    assert loop.turns.arm.stalls == 1
    assert len(loop.turns.goals) == MOVING + 2, "after that in which it broke, once more at rest"
    assert loop.turns.steps_m[-1] == 0.0


@pytest.mark.parametrize("turns", [GENTLE], indirect=True)
def test_a_brake_that_takes_long_is_brought_to_its_end(loop: Loop) -> None:
    loop.turns.ramp_s = GENTLE_RAMP_S
    moving = round(GENTLE_RAMP_S / TICK_S)
    loop.script[moving] = loop.stop.set
    loop.run()
    braked(loop.turns)
    assert (loop.turn - moving) * TICK_S > LEAST_S
