"""The simulated arm commanded by joints, in the closed loop: its elbow, and its measured joints."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from arm_rig import Asked, activate, mark, speed_m_s, stop_time_s, way_m, with_fields
from vla_zenoh_benchmarks.lockstep.loop import Lockstep
from vla_zenoh_benchmarks.lockstep.worker import Message

from vla_zenoh.codec import message
from vla_zenoh.control.reachability import ReachabilityFilter
from vla_zenoh.profile import load_profile, override
from vla_zenoh.simulation.world import build_world
from vla_zenoh.types import JointState

PROFILE = override(load_profile("panda_sim"), {"robot": {"command": "joint"}})
SWIVELLED_RAD = np.array([0.5128, 0.0709, -0.6078, -2.5886, 0.0527, 2.5753, 0.6893])
STILL_RAD = 2e-3
STOP_S, STOP_M = 0.35, 0.04


def begin(prompt: str, posture: str = "start") -> Lockstep:
    of = override(PROFILE, {"robot": {"posture": posture, "home_rad": SWIVELLED_RAD.tolist()}})
    world = build_world(of)
    # Activated in other joints than the home of the profile that the command node has.
    here = override(of, {"robot": {"home_rad": list(PROFILE.robot.home_rad)}})
    loop = Lockstep(here, world, Asked(), reach=ReachabilityFilter(here), steps=2)
    loop.put("rate", 10.0)
    loop.put("prompt", prompt)
    loop.run(0.3)
    activate(loop)
    return loop


@pytest.mark.parametrize(("posture", "moves"), [("start", False), ("home", True)])
def test_an_elbow_moves_by_itself_only_where_the_profile_asks_for_it(
    posture: str, moves: bool
) -> None:
    loop = begin("0 0 0", posture)
    before_rad = loop.world.joint_state().position_rad
    loop.run(0.8)
    moved_rad = np.abs(loop.world.joint_state().position_rad - before_rad).max()
    assert loop.commander.state.value == "active"
    assert (moved_rad > 0.1) == moves
    assert moves or moved_rad < STILL_RAD


def test_measured_joints_that_are_not_where_they_are_commanded_stop_the_arm() -> None:
    loop = begin("0 0 0.01")
    loop.run(0.5)
    assert speed_m_s(loop)[-1] > 0.03
    assert loop.commander.parts[0].elbow_rad < 0.05

    def astray(sent: Message) -> list[Message]:
        if sent.kind is not JointState:
            return [sent]
        told_rad = np.array(message.unpack(sent.payload)["position_rad"])
        return [with_fields(replace(sent), position_rad=told_rad + [0, 0, 0.8, 0, 0, 0, 0])]

    loop.tamper = astray
    since = mark(loop)
    loop.run(0.5)
    assert loop.commander.state.value == "inactive"
    told = next(event for event in loop.events if event.what == "elbow_rad")
    assert told.why == "braked at panda_joint3"
    assert told.value == pytest.approx(0.8, abs=0.05)
    assert told.limit == pytest.approx(0.7)
    assert stop_time_s(loop, since) < STOP_S
    assert way_m(loop, since) < STOP_M
