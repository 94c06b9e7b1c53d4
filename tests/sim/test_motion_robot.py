"""The robot's own faults in motion: state frozen, jumping or missing, blocked, off, out of reach.

Rows of the fault table in docs/design.md; each looks at the arm itself in MuJoCo.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import pytest
from arm_rig import (
    SPEED_M_S,
    STILL_M_S,
    UP,
    activate,
    after,
    begin,
    check_motion,
    dropped,
    goes_on,
    mark,
    moving,
    path_m,
    speed_m_s,
    stop_time_s,
    undisturbed,
    way_m,
    with_fields,
)
from vla_zenoh_benchmarks.lockstep.loop import Lockstep
from vla_zenoh_benchmarks.lockstep.worker import Message, Tamper

from vla_zenoh.codec import message
from vla_zenoh.kinematics.so3 import norm3
from vla_zenoh.types import GripperState, JointState, PoseCommand, PoseState

PUSH_N = 150.0
"""At most, on what is in the way: stiffness times `tracking_m`, and what the brake adds."""
LASTING_N = 5.0
PUSH_WAY_M = 0.005
STANDS_M = 1e-3
LOST_M = 0.006
"""Further than a stream may begin aside of the reference, far less than `tracking_m`."""
STATES = (PoseState, GripperState, JointState)


def shifted(by_m: float) -> Tamper:
    """The measured position is said to be elsewhere, every other time."""

    def tamper(sent: Message) -> Iterable[Message]:
        if sent.kind is not PoseState or sent.header.seq % 2:
            return [sent]
        measured_m = np.array(message.unpack(sent.payload)["position_m"])
        return [with_fields(sent, position_m=measured_m + np.array([by_m, by_m, 0.0]))]

    return tamper


def test_a_measured_pose_that_jumps_a_little_moves_nothing() -> None:
    np.testing.assert_array_equal(after(0.5, shifted(0.02)), undisturbed(0.5))


def test_an_arm_that_is_blocked_pushes_no_harder_than_it_may_and_is_led_back() -> None:
    loop = begin("0 0.01 0")
    x_m, y_m, z_m = path_m(loop)[-1]
    # A wall of the open box, which cannot be pushed away, beside the hand.
    loop.world.place("box", (x_m, y_m + 0.25, z_m + 0.05))
    push_n: list[float] = []
    for _ in range(310):
        loop.run(0.01)
        push_n.append(norm3(loop.world.wrench()[:3]))
    assert max(push_n) > 10.0  # it did touch
    assert max(push_n) < PUSH_N
    assert loop.commander.state.value == "inactive"
    assert "contact_force" in loop.commander.why
    assert max(push_n[-50:]) < LASTING_N
    blocked_m = path_m(loop)[-1]
    assert speed_m_s(loop)[-100:].max() < STILL_M_S
    loop.put("prompt", "0 -0.01 0")
    activate(loop)
    loop.run(0.6)
    assert path_m(loop)[-1, 1] < blocked_m[1] - 0.02  # it comes away
    assert push_n[-1] >= norm3(loop.world.wrench()[:3])
    check_motion(loop, contact=True)


def test_an_arm_pressed_on_the_table_stops() -> None:
    loop = begin("0 0 -0.02")
    tilt = 0.02  # the table is higher than anybody knows
    loop.world.place("box", (0.43 + 0.0685, 0.0, 0.05 + tilt))
    loop.run(2.3)
    rest_m = path_m(loop)[-1]
    assert speed_m_s(loop)[-100:].max() < STILL_M_S
    assert norm3(loop.world.wrench()[:3]) < LASTING_N
    assert rest_m[2] > 0.06
    check_motion(loop, contact=True)


def test_a_stream_whose_beginning_is_lost_moves_nothing_and_ends_the_activation() -> None:
    loop = begin()
    loop.put("active", False)
    loop.run(0.3)
    loop.put("prompt", UP)
    loop.run(0.2)
    since = mark(loop)
    loop.tamper = dropped(PoseCommand)
    activate(loop)
    while ahead_m(loop, since) < LOST_M:
        loop.run(0.02)
    assert loop.commander.state.value == "active"
    loop.tamper = None
    loop.run(0.05)
    assert loop.commander.state.value == "inactive"
    assert "unheeded" in loop.commander.why
    loop.run(0.4)
    assert way_m(loop, since) < STANDS_M
    goes_on(loop)
    check_motion(loop)


def ahead_m(loop: Lockstep, since: int) -> float:
    """How far the commanded pose has gone since then."""
    told = [command for command in loop.trace.commands[since:] if command is not None]
    return float(norm3(told[-1].position_m - told[0].position_m)) if told else 0.0


def test_a_goal_out_of_reach_is_approached_and_no_further() -> None:
    loop = begin("0.03 0 0.03", bounded=True)
    loop.run(3.2)
    commanded = loop.trace.commands[-1]
    assert commanded is not None
    assert way_m(loop, mark(loop) - 125) < STANDS_M  # while it is told to go on
    assert norm3(path_m(loop)[-1] - commanded.position_m) < STANDS_M
    assert path_m(loop)[-1, 0] < loop.profile.limits.workspace.x_m[1] + STANDS_M
    assert loop.commander.state.value == "active"
    assert any(event.kind == "limit" for event in loop.events)
    loop.put("prompt", "-0.02 0 -0.02")
    loop.run(0.5)
    assert speed_m_s(loop)[-1] > 0.5 * SPEED_M_S  # and back at once
    check_motion(loop, singular=True)


@pytest.mark.long
def test_a_step_no_arm_can_make_is_not_begun() -> None:
    loop = moving()
    since = mark(loop)
    loop.put("prompt", "0 0 5")
    loop.run(0.5)
    assert loop.refused["step_m"] > 0
    assert stop_time_s(loop, since) < 0.35
    assert speed_m_s(loop)[since:].max() < 1.15 * SPEED_M_S
    loop.put("prompt", UP)
    loop.run(0.4)
    assert speed_m_s(loop)[-1] > 0.5 * SPEED_M_S
    check_motion(loop)
