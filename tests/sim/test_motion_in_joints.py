"""The fault table for a policy of joints: each fault in motion, on the arm itself in MuJoCo.

Rows of the fault table in docs/design.md, with joints commanded; those of poses are in the
other `test_motion_` files.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import replace
from functools import cache
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from arm_rig import (
    BRAKE,
    FROZEN,
    LOST,
    OWN,
    RATE_HZ,
    SILENT,
    SPEED_M_S,
    STARVED,
    STEP_M,
    TICK_S,
    activate,
    changed,
    check_stop,
    delayed,
    dropped,
    early,
    frozen,
    mark,
    path_m,
    speed_m_s,
    spoilt,
    stop_time_s,
    with_fields,
)
from panda_arm import ARM_JOINTS, panda
from vla_zenoh_benchmarks.lockstep.loop import CAMERA, COMMAND, SIM, Lockstep
from vla_zenoh_benchmarks.lockstep.worker import Message, Tamper

from vla_zenoh.codec import message
from vla_zenoh.control.joint_space import JointBounds
from vla_zenoh.control.reachability import ReachabilityFilter
from vla_zenoh.kinematics.so3 import norm3
from vla_zenoh.policy import (
    ActionSpec,
    ActionSteps,
    CameraSpec,
    ModelSpec,
    Observation,
    ObservationSpec,
)
from vla_zenoh.profile import load_profile, override
from vla_zenoh.simulation.world import World, build_world
from vla_zenoh.types import (
    ActionChunk,
    FloatArray,
    GripperCommand,
    GripperState,
    JointCommand,
    JointState,
    PoseState,
)

PROFILE = override(load_profile("panda_sim"), {"robot": {"command": "joint"}})
WORKER = "worker-scripted"
STATES = (PoseState, GripperState, JointState)
LIMIT_RTOL, JERK_RTOL = 1e-6, 1e-3
EXACT_M = 1e-3
WATCHED_S = 0.6
PUSH_N, LASTING_N = 150.0, 5.0


class Upward:
    """A policy of joint deltas that moves the TCP by a step at every request.

    Its prompt is the step of the TCP, m, as ``0 0 0.02``.
    """

    def __init__(self) -> None:
        self.spec = ModelSpec(
            name="scripted",
            observation=ObservationSpec(
                cameras=(CameraSpec(camera="front"),), state=("joint",), prompt=True
            ),
            action=ActionSpec(
                horizon=1, dt_s=0.1, space="joint", joints=ARM_JOINTS, gripper="none"
            ),
        )

    def infer(self, observation: Observation) -> ActionSteps:
        assert observation.joint is not None
        if not observation.task.active:
            return ActionSteps(np.zeros((1, len(ARM_JOINTS))))
        way = np.array([*map(float, observation.prompt.split()), 0.0, 0.0, 0.0])
        jacobian = panda().jacobian(observation.joint.position_rad)
        return ActionSteps([np.linalg.pinv(jacobian) @ way])


@cache
def world() -> World:
    return build_world(PROFILE)


@cache
def shadow() -> ReachabilityFilter:
    return ReachabilityFilter(PROFILE)


def begin(prompt: str) -> Lockstep:
    world().reset()
    loop = Lockstep(PROFILE, world(), Upward(), reach=shadow(), steps=2)
    loop.put("rate", RATE_HZ)
    loop.put("prompt", prompt)
    loop.run(0.3)
    activate(loop)
    return loop


def moving(seconds: float = 1.0) -> Lockstep:
    loop = begin(f"0 0 {STEP_M}")
    loop.run(seconds)
    assert goes(loop)
    return loop


def goes(loop: Lockstep) -> bool:
    return bool(speed_m_s(loop)[-1] > 0.5 * SPEED_M_S)


def check_commands(loop: Lockstep) -> None:
    """Every joint command kept the limits of velocity, acceleration and jerk."""
    bounds = JointBounds(PROFILE, shadow().kinematics, shadow().barriers).motion
    told = loop.trace.joints
    rows = [(one, later) for one, later in pairwise(told) if one and later]
    assert rows
    for before, now in rows:
        assert (np.abs(now.velocity_rad_s) <= bounds.velocity_rad_s * (1 + LIMIT_RTOL)).all()
        assert (
            np.abs(now.acceleration_rad_s2) <= bounds.acceleration_rad_s2 * (1 + LIMIT_RTOL)
        ).all()
        if np.abs(now.position_rad - before.position_rad).max() < 1e-9:
            continue
        jerk = np.abs(now.acceleration_rad_s2 - before.acceleration_rad_s2) / TICK_S
        assert (jerk <= bounds.jerk_rad_s3 * (1 + JERK_RTOL)).all()


def check_speed(loop: Lockstep) -> None:
    assert np.abs(np.diff(path_m(loop), axis=0)).max() / TICK_S < 1.5 * SPEED_M_S


# -- faults that stop the arm ---------------------------------------------------------------------
def tampered(tamper: Tamper) -> Callable[[Lockstep], None]:
    def happen(loop: Lockstep) -> None:
        loop.tamper = tamper

    return happen


def astray(sent: Message) -> Iterable[Message]:
    """The measured pose is said to be elsewhere."""
    if sent.kind is not PoseState:
        return [sent]
    measured_m = np.array(message.unpack(sent.payload)["position_m"])
    return [with_fields(sent, position_m=measured_m + [0.2, 0.2, 0.0])]


def off(loop: Lockstep) -> None:
    loop.alive.discard(SIM)
    loop.tamper = dropped(*STATES, JointCommand, GripperCommand)


def lying_camera(loop: Lockstep) -> None:
    loop.camera_faults["front"] = "shows the same picture since 1.0 s"


def clock(node: str, step_s: float) -> Callable[[Lockstep], None]:
    return lambda loop: loop.set_clock(node, step_s)


def asked(name: str, value: Any) -> Callable[[Lockstep], None]:
    return lambda loop: loop.put(name, value)


FAULTS: dict[str, tuple[Callable[[Lockstep], None], tuple[float, float]]] = {
    "chunks too late": (tampered(delayed(1.2, ActionChunk)), STARVED),
    "chunks from the future": (tampered(early), STARVED),
    "chunks lost": (tampered(dropped(ActionChunk)), STARVED),
    "not a number in a chunk": (tampered(spoilt(ActionChunk, "steps")), STARVED),
    "a step of 5 m": (asked("prompt", "0 0 5"), STARVED),
    "clock of the camera +2 s": (clock(CAMERA, 2.0), STARVED),
    "clock of the worker -2 s": (clock(WORKER, -2.0), STARVED),
    "clock of the command node +2 s": (clock(COMMAND, 2.0), BRAKE),
    "clock of the command node -2 s": (clock(COMMAND, -2.0), BRAKE),
    "clock of the robot +2 s": (clock(SIM, 2.0), OWN),
    "clock of the robot -2 s": (clock(SIM, -2.0), BRAKE),
    "not a number in the pose": (tampered(spoilt(PoseState, "position_m")), LOST),
    "not a number in the joints": (tampered(spoilt(JointState, "position_rad")), LOST),
    "not a number in a command": (tampered(spoilt(JointCommand, "position_rad")), SILENT),
    "states lost": (tampered(dropped(*STATES)), LOST),
    "joint states lost": (tampered(dropped(JointState)), LOST),
    "a pose that is stuck": (tampered(frozen(PoseState, payload_only=True)), FROZEN),
    "a measured pose that jumps by 0.28 m": (tampered(astray), BRAKE),
    "a camera that lies": (lying_camera, BRAKE),
    "another mode": (tampered(changed(GripperState, mode="guiding")), BRAKE),
    "robot off": (off, SILENT),
    "commands lost": (tampered(dropped(JointCommand)), SILENT),
    "deactivated": (asked("active", False), BRAKE),
    "emergency stop": (asked("stop", None), BRAKE),
}
QUICK = ("chunks lost", "commands lost", "emergency stop", "joint states lost")


@pytest.mark.parametrize(
    "fault", [pytest.param(n, marks=() if n in QUICK else pytest.mark.slow) for n in FAULTS]
)
def test_a_fault_in_a_motion_of_joints_stops_the_arm(fault: str) -> None:
    happen, within = FAULTS[fault]
    loop = moving()
    since = mark(loop)
    happen(loop)
    loop.run(WATCHED_S)
    # After a prompt it waits for a chunk for longer than the arm needs to stop.
    assert loop.commander.state.value != "active" or loop.refused["step_rad"] > 5
    check_stop(loop, since, within)
    check_commands(loop)
    check_speed(loop)


@pytest.mark.slow
def test_states_that_are_said_again_and_again_stop_a_motion_of_joints() -> None:
    loop = moving()
    since = mark(loop)
    loop.tamper = frozen(*STATES, payload_only=False)
    loop.run(1.2)
    check_stop(loop, since, LOST)


# -- faults that it goes on through ---------------------------------------------------------------
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
