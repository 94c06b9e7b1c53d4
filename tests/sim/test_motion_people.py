"""What people do while the arm moves: swap worker, prompt or rate, toggle, stop, open and close.

Rows of the fault table in docs/design.md; each looks at the arm itself in MuJoCo.
"""

from __future__ import annotations

import numpy as np
import pytest
from arm_rig import (
    BRAKE,
    HOLD,
    SPEED_M_S,
    STARTED_S,
    STEP_M,
    STILL_M_S,
    TICK_S,
    UP,
    Asked,
    activate,
    begin,
    changed,
    check_motion,
    dropped,
    goes_on,
    mark,
    moving,
    path_m,
    speed_m_s,
    stop_time_s,
    way_m,
)
from vla_zenoh_benchmarks.lockstep.loop import Lockstep
from vla_zenoh_benchmarks.lockstep.worker import Message

from vla_zenoh.types import FloatArray, GripperCommand, PoseCommand, PoseReference, PoseState

EXACT_M = 1e-3
SLIP_M = 1e-3
TOGGLES_S = 2.0
MOVES_M_S, TOGGLED_WAY_M = 0.02, 0.3
GRIPPER_S = 3.0
STALL_S = 1.0


def held_m(loop: Lockstep) -> FloatArray:
    """Where the robot's controller holds the arm."""
    held = loop.guard.reference
    assert isinstance(held, PoseReference)
    return held.position_m


def test_a_worker_that_takes_over_in_motion_goes_on_without_a_jump() -> None:
    loop = begin(UP, others={"other": Asked("other")})
    loop.run(STARTED_S)
    steps = loop.commander.progress.steps
    since = mark(loop)
    loop.put("worker", "other")
    loop.run(0.6)
    assert loop.commander.task.worker == "other"
    assert speed_m_s(loop)[since:].min() > 0.3 * SPEED_M_S  # it does not stop in between
    steps += loop.commander.progress.steps
    loop.put("prompt", HOLD)
    loop.run(0.8)
    way = path_m(loop)[-1] - path_m(loop)[0]
    assert way == pytest.approx([0.0, 0.0, STEP_M * steps], abs=EXACT_M)
    check_motion(loop)


@pytest.mark.long
def test_a_prompt_that_changes_in_motion_turns_the_arm_without_a_jump() -> None:
    loop = moving(0.6)
    steps = loop.commander.progress.steps
    loop.put("prompt", f"0 {STEP_M} 0")
    loop.run(0.6)
    aside = loop.commander.progress.steps
    loop.put("prompt", HOLD)
    loop.run(0.8)
    way = path_m(loop)[-1] - path_m(loop)[0]
    assert way == pytest.approx([0.0, STEP_M * aside, STEP_M * steps], abs=EXACT_M)
    assert speed_m_s(loop)[-1] < STILL_M_S
    check_motion(loop)


@pytest.mark.long
def test_a_rate_that_changes_in_motion_loses_no_step() -> None:
    loop = begin(f"0 0 {STEP_M / 2}")
    for rate_hz in (2.0, 20.0, 5.0):
        loop.put("rate", rate_hz)
        loop.run(0.8)
    loop.run(0.1)  # half a step: no chunk is under way that is in force and not counted any more
    steps = loop.commander.progress.steps
    assert steps > 15
    loop.put("prompt", HOLD)
    loop.run(0.8)
    way = path_m(loop)[-1] - path_m(loop)[0]
    assert way == pytest.approx([0.0, 0.0, STEP_M / 2 * steps], abs=EXACT_M)
    check_motion(loop)


@pytest.mark.parametrize(
    "wait_s", [0.06, *(pytest.param(s, marks=pytest.mark.long) for s in (0.02, 0.12))]
)
def test_activated_while_it_still_moves_it_does_not_jump(wait_s: float) -> None:
    loop = moving(STARTED_S)
    loop.put("active", False)
    loop.run(wait_s)
    goes_on(loop)
    check_motion(loop)


@pytest.mark.parametrize("wait_s", [0.14, pytest.param(0.2, marks=pytest.mark.long)])
def test_activated_during_the_robots_own_brake_it_does_not_jump(wait_s: float) -> None:
    loop = moving(STARTED_S)
    loop.tamper = dropped(PoseCommand)
    loop.run(wait_s)
    loop.tamper = None
    if loop.guard.braking:
        loop.put("active", True)
        loop.run(0.02)
        assert loop.commander.state.value == "inactive"
    loop.run(0.3)  # the command node still streams where its own brake ended
    goes_on(loop)
    check_motion(loop, own_brake=True)


def test_activated_away_from_where_its_controller_holds_it_the_arm_is_not_pulled() -> None:
    loop = begin("0 0.01 0")
    loop.put("active", False)
    loop.run(0.3)
    # It feels nothing, and is stopped before it is led back.
    loop.tamper = changed(PoseState, wrench=None)
    loop.run(0.1)
    activate(loop)
    x_m, y_m, z_m = path_m(loop)[-1]
    loop.world.place("box", (x_m, y_m + 0.25, z_m + 0.05))
    assert loop.run_until(lambda: loop.commander.state.value != "active", 3.0)
    loop.put("stop")
    loop.run(0.5)
    loop.put("reset")
    loop.run(0.1)
    at = path_m(loop)[-1]
    held = held_m(loop)
    assert np.linalg.norm(held - at) > 0.03
    loop.put("prompt", HOLD)
    activate(loop)
    loop.run(1.0)
    # Its controller is led back to where the arm is.
    assert np.linalg.norm(held_m(loop) - path_m(loop)[-1]) < 0.01
    assert np.linalg.norm(path_m(loop)[-1] - at) < 0.01
    check_motion(loop, contact=True)


def test_active_toggled_ten_times_a_second_stays_smooth() -> None:
    # Often, so that the arm is under way each time before it is told to stop again.
    loop = begin(UP, rate_hz=30.0)
    for toggle in range(round(TOGGLES_S * 10)):
        if toggle % 10 == 0:  # there and back, for the workspace ends
            loop.put("prompt", UP if toggle % 20 == 0 else f"0 0 -{STEP_M}")
        loop.put("active", toggle % 2 == 1)
        loop.run(0.1)
    since = mark(loop)
    loop.put("active", False)
    loop.run(0.4)
    assert stop_time_s(loop, since) < BRAKE[0]
    assert speed_m_s(loop).max() > MOVES_M_S
    assert way_m(loop, 1) < TOGGLED_WAY_M
    check_motion(loop)


def test_a_stop_while_something_is_held_does_not_drop_it() -> None:
    loop = begin()
    loop.world.place("brick", (0.43, 0.0, 0.0096))
    for prompt, duration_s in (("0 0 -0.02", 0.75), (f"{HOLD} -0.03", 1.0), (UP, 0.6)):
        loop.put("prompt", prompt)
        loop.run(duration_s)
    assert loop.world.gripper_state().holding
    assert speed_m_s(loop)[-1] > 0.5 * SPEED_M_S
    held = loop.world.objects()["brick"][0] - loop.world.tcp()[0]
    since = mark(loop)
    loop.put("stop")
    loop.run(0.4)
    assert stop_time_s(loop, since) <= BRAKE[0]
    assert loop.world.gripper_state().holding
    slipped = loop.world.objects()["brick"][0] - loop.world.tcp()[0] - held
    assert np.linalg.norm(slipped) < SLIP_M
    loop.put("reset")
    activate(loop)
    loop.run(0.6)
    assert loop.world.gripper_state().holding
    assert loop.world.objects()["brick"][0][2] > 0.05
    check_motion(loop, contact=True)


def test_a_gripper_told_to_open_and_close_twenty_times_a_second_neither_stacks_nor_stalls() -> None:
    loop = begin(rate_hz=20.0)
    sent_ns: list[int] = []

    def watch(sent: Message) -> list[Message]:
        if sent.kind is GripperCommand:
            sent_ns.append(loop.now_ns)
        return [sent]

    loop.tamper = watch
    for turn in range(round(GRIPPER_S * 20)):
        loop.put("prompt", f"{HOLD} {'-0.05' if turn % 2 == 0 else '0.05'}")
        loop.run(0.05)
    width_m = np.array(loop.trace.width_m)
    assert len(sent_ns) > 4
    assert np.diff(sent_ns).min() > 60e6  # one in flight
    stall = round(STALL_S / TICK_S)
    travel_m = [np.ptp(width_m[at : at + stall]) for at in range(300, len(width_m) - stall, stall)]
    assert min(travel_m) > 0.005
    count = len(sent_ns)
    loop.put("prompt", f"{HOLD} 0.08")
    loop.run(1.5)
    assert len(sent_ns) - count <= 3  # nothing was queued
    assert loop.world.gripper_state().width_m == pytest.approx(0.08, abs=EXACT_M)
    assert way_m(loop, 1) < EXACT_M
    check_motion(loop)
