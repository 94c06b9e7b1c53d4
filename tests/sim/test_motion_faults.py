"""Faults that stop an arm in motion, on the arm itself in MuJoCo, with poses and with joints.

Rows of the fault table in docs/design.md.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from typing import Any, NamedTuple

import arm_rig
import joint_arm_rig
import numpy as np
import pytest
from arm_rig import (
    BRAKE,
    FROZEN,
    LOST,
    OWN,
    SILENT,
    SPEED_M_S,
    STARVED,
    changed,
    check_motion,
    check_stop,
    delayed,
    dropped,
    early,
    frozen,
    goes_on,
    mark,
    speed_m_s,
    spoilt,
    way_m,
    with_fields,
)
from vla_zenoh_benchmarks.lockstep.loop import CAMERA, COMMAND, SIM, Lockstep
from vla_zenoh_benchmarks.lockstep.worker import Message, Tamper

from vla_zenoh.codec import message
from vla_zenoh.types import (
    ActionChunk,
    GripperCommand,
    GripperState,
    JointCommand,
    JointState,
    PoseCommand,
    PoseState,
)

WORKER = "worker-scripted"
STATES, COMMANDS = (PoseState, GripperState, JointState), (PoseCommand, JointCommand)
MOVING_S = 1.2
"""Until the speed is steady."""
LATER_S, FURTHER_M = 0.08, 0.01
"""What a stop may take more before the speed is steady."""
NO_ROTATION = {"quat_xyzw": np.array([0.9, 0.0, 0.0, 0.0])}

Happens = Callable[[Lockstep], None]


class Fault(NamedTuple):
    """What happens, within what seconds and metres the arm stands, why a record is refused then."""

    happens: Happens
    within: tuple[float, float]
    refused: str = ""
    watched_s: float = 0.6


def tampered(tamper: Tamper) -> Happens:
    def happen(loop: Lockstep) -> None:
        loop.tamper = tamper

    return happen


def shifted(sent: Message) -> Iterable[Message]:
    """The measured pose is said to be elsewhere, every other time."""
    if sent.kind is not PoseState or sent.header.seq % 2:
        return [sent]
    measured_m = np.array(message.unpack(sent.payload)["position_m"])
    return [with_fields(sent, position_m=measured_m + [0.2, 0.2, 0.0])]


def off(loop: Lockstep) -> None:
    loop.alive.discard(SIM)
    loop.tamper = dropped(*STATES, *COMMANDS, GripperCommand)


def lying_camera(loop: Lockstep) -> None:
    loop.camera_faults["front"] = "shows the same picture since 1.0 s"


def clock(node: str, step_s: float) -> Happens:
    return lambda loop: loop.set_clock(node, step_s)


def asked(name: str, value: Any = None) -> Happens:
    return lambda loop: loop.put(name, value)


STARVING = {
    "chunks too late": Fault(tampered(delayed(1.2, ActionChunk)), STARVED, "stale", 1.9),
    "chunks from the future": Fault(tampered(early), STARVED, "future"),
    "chunks lost": Fault(tampered(dropped(ActionChunk)), STARVED),
    "not a number in a chunk": Fault(tampered(spoilt(ActionChunk, "steps")), STARVED, "invalid"),
    "clock of the camera +2 s": Fault(clock(CAMERA, 2.0), STARVED),
    "clock of the camera -2 s": Fault(clock(CAMERA, -2.0), STARVED),
    "clock of the worker +2 s": Fault(clock(WORKER, 2.0), STARVED),
    "clock of the worker -2 s": Fault(clock(WORKER, -2.0), STARVED),
}
"""When they are over the arm goes on by itself."""
ENDING = {
    "clock of the command node +2 s": Fault(clock(COMMAND, 2.0), BRAKE),
    "clock of the command node -2 s": Fault(clock(COMMAND, -2.0), BRAKE),
    "clock of the robot +2 s": Fault(clock(SIM, 2.0), OWN),
    "clock of the robot -2 s": Fault(clock(SIM, -2.0), BRAKE),
    "not a number in the pose": Fault(tampered(spoilt(PoseState, "position_m")), LOST, "invalid"),
    "not a number in the gripper": Fault(
        tampered(spoilt(GripperState, "width_m")), LOST, "invalid"
    ),
    "not a number in the joints": Fault(
        tampered(spoilt(JointState, "position_rad")), LOST, "invalid"
    ),
    "not a number in a command": Fault(
        tampered(spoilt(JointCommand, "position_rad")), SILENT, "invalid"
    ),
    "no rotation in a command": Fault(
        tampered(changed(PoseCommand, **NO_ROTATION)), SILENT, "invalid"
    ),
    "states lost": Fault(tampered(dropped(*STATES)), LOST),
    "joint states lost": Fault(tampered(dropped(JointState)), LOST),
    "states said again": Fault(tampered(frozen(*STATES, payload_only=False)), LOST),
    "a pose that is stuck": Fault(tampered(frozen(PoseState, payload_only=True)), FROZEN),
    "a measured pose that jumps by 0.28 m": Fault(tampered(shifted), BRAKE),
    "a camera that lies": Fault(lying_camera, BRAKE),
    "user_stopped": Fault(tampered(changed(GripperState, mode="user_stopped")), BRAKE),
    "guiding": Fault(tampered(changed(GripperState, mode="guiding")), BRAKE),
    "robot off": Fault(off, SILENT),
    "commands lost": Fault(tampered(dropped(*COMMANDS)), SILENT),
    "emergency stop": Fault(asked("stop"), BRAKE),
}
"""When they are over it goes on once it is activated."""
FAULTS = STARVING | ENDING
OF_ONE = {
    "not a number in the joints": "joints",
    "joint states lost": "joints",
    "not a number in a command": "joints",
    "no rotation in a command": "poses",
}
QUICK = {
    "poses": {
        "chunks lost",
        "clock of the robot +2 s",
        "states lost",
        "a pose that is stuck",
        "commands lost",
        "emergency stop",
    },
    "joints": {"joint states lost", "commands lost", "emergency stop"},
}
"""Of each reaction one; the other ways to it are tried by the unit tests of node and guard."""
OTHERS = {"poses": pytest.mark.long, "joints": pytest.mark.slow}


def rows() -> Iterator[Any]:
    for law, quick in QUICK.items():
        for fault in FAULTS:
            if OF_ONE.get(fault, law) == law:
                marks = () if fault in quick else OTHERS[law]
                yield pytest.param(law, fault, marks=marks)


def moving(law: str, seconds: float = MOVING_S) -> Lockstep:
    rig = arm_rig if law == "poses" else joint_arm_rig
    return rig.moving(seconds)


def check(law: str, loop: Lockstep, *, own_brake: bool) -> None:
    """From beginning to end the limits are kept."""
    if law == "poses":
        check_motion(loop, own_brake=own_brake)
    else:
        joint_arm_rig.check_commands(loop)
        joint_arm_rig.check_speed(loop)


def end_fault(loop: Lockstep) -> None:
    for node in (CAMERA, WORKER, COMMAND, SIM):
        loop.set_clock(node, 0.0)
    loop.tamper = None
    if SIM not in loop.alive:
        loop.guard.reset()
        loop.alive.add(SIM)
    loop.camera_faults.clear()
    if loop.commander.state.value == "stopped":
        loop.put("reset")


@pytest.mark.parametrize(("law", "fault"), [*rows()])
def test_a_fault_in_motion_stops_the_arm_until_it_is_over(law: str, fault: str) -> None:
    happens, within, refused, watched_s = FAULTS[fault]
    loop = moving(law)
    since = mark(loop)
    happens(loop)
    loop.run(watched_s)
    assert not refused or loop.refused[refused] > 0
    check_stop(loop, since, within)
    if fault in STARVING:
        assert loop.commander.state.value == "holding"
        end_fault(loop)
        loop.run(0.5)
        assert speed_m_s(loop)[-1] > 0.5 * SPEED_M_S
    else:
        if within in (BRAKE, LOST, OWN):  # else robot or node do not know that it would be wrong
            loop.put("active", True)
        loop.run(0.1)
        end_fault(loop)
        loop.run(0.2)
        assert loop.commander.state.value == "inactive"
        assert way_m(loop, since) < within[1]
        goes_on(loop)
    check(law, loop, own_brake=within in (OWN, SILENT))


@pytest.mark.long
@pytest.mark.parametrize("law", ["poses", "joints"])
@pytest.mark.parametrize(
    "fault",
    [
        "emergency stop",
        "chunks lost",
        "commands lost",
        "states lost",
        "clock of the robot +2 s",
        "a measured pose that jumps by 0.28 m",
    ],
)
def test_an_arm_that_accelerates_or_overshoots_stops_little_later(law: str, fault: str) -> None:
    happens, (stop_s, stop_m), _, watched_s = FAULTS[fault]
    for seconds in (0.55, 0.65, 0.75, 0.85, 0.95):
        loop = moving(law, seconds)
        since = mark(loop)
        happens(loop)
        loop.run(watched_s)
        check_stop(loop, since, (stop_s + LATER_S, stop_m + FURTHER_M))
