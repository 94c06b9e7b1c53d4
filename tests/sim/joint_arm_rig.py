"""The closed loop of `arm_rig.py` for a policy of joints, with joints commanded."""

from __future__ import annotations

from functools import cache
from itertools import pairwise

import numpy as np
from arm_rig import RATE_HZ, SPEED_M_S, STEP_M, TICK_S, activate, path_m, speed_m_s
from panda_arm import ARM_JOINTS, panda
from vla_zenoh_benchmarks.lockstep.loop import Lockstep

from vla_zenoh.control.joint_space import JointBounds
from vla_zenoh.control.reachability import ReachabilityFilter
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

PROFILE = override(load_profile("panda_sim"), {"robot": {"command": "joint"}})
LIMIT_RTOL, JERK_RTOL = 1e-6, 1e-3


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
