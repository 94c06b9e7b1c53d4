"""A policy of joints, with joints commanded: what the arm goes on through, and what blocks it.

Rows of the fault table in docs/design.md; faults that stop it are in test_motion_faults.py.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import numpy as np
import pytest
from arm_rig import BRAKE, delayed, mark, path_m, stop_time_s
from joint_arm_rig import begin, check_commands, goes, moving
from vla_zenoh_benchmarks.lockstep.worker import Message, Tamper

from vla_zenoh.kinematics.so3 import norm3
from vla_zenoh.types import (
    ActionChunk,
    FloatArray,
    GripperState,
    JointCommand,
    JointState,
    PoseState,
)

STATES = (PoseState, GripperState, JointState)
EXACT_M = 1e-3
PUSH_N, LASTING_N = 150.0, 5.0


def after(tamper: Tamper | None) -> FloatArray:
    loop = moving(0.6)
    loop.tamper = tamper
    loop.run(0.8)
    assert goes(loop)
    check_commands(loop)
    return path_m(loop)


@pytest.mark.slow
@pytest.mark.parametrize("kinds", [(ActionChunk,), (JointCommand,), STATES])
def test_duplicates_move_no_joint(kinds: tuple[type, ...]) -> None:
    twice = after(lambda sent: [sent, sent] if sent.kind in kinds else [sent])
    np.testing.assert_array_equal(twice, after(None))


@pytest.mark.slow
def test_commands_in_disorder_do_not_shake_the_joints() -> None:
    def mix(sent: Message) -> Iterable[Message]:
        late = sent.kind is JointCommand and sent.header.seq % 3 == 0
        return [replace(sent, arrival_ns=sent.arrival_ns + 6_000_000) if late else sent]

    assert np.abs(after(mix) - after(None)).max() < EXACT_M


@pytest.mark.slow
def test_joint_chunks_that_come_late_by_0_2_s_go_on() -> None:
    after(delayed(0.2, ActionChunk))


@pytest.mark.slow
def test_joints_active_toggled_ten_times_a_second_stay_smooth() -> None:
    loop = moving(0.6)
    for toggle in range(16):
        loop.put("active", toggle % 2 == 1)
        loop.run(0.1)
    loop.put("active", False)
    since = mark(loop)
    loop.run(0.8)
    assert stop_time_s(loop, since) < BRAKE[0]
    check_commands(loop)


@pytest.mark.slow
def test_an_arm_of_joints_that_is_blocked_is_led_back() -> None:
    loop = begin("0 0.01 0")
    x_m, y_m, z_m = path_m(loop)[-1]
    loop.world.place("box", (x_m, y_m + 0.25, z_m + 0.05))
    push_n: list[float] = []
    for _ in range(350):
        loop.run(0.01)
        push_n.append(norm3(loop.world.wrench()[:3]))
    assert max(push_n) > 10.0
    assert max(push_n) < PUSH_N
    assert loop.commander.state.value == "inactive"
    assert max(push_n[-100:]) < LASTING_N
    check_commands(loop)
