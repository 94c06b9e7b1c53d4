"""Joint actions on the simulated arm: asked against reached joints, at rest and in motion."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from arm_rig import activate
from panda_arm import ARM_JOINTS, HOME_RAD, panda, swivelled
from vla_zenoh_benchmarks.lockstep.loop import Lockstep

from vla_zenoh.control.limits import workspace_corners
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
from vla_zenoh.simulation.world import build_world
from vla_zenoh.types import FloatArray

pytestmark = pytest.mark.long

PROFILE = override(load_profile("panda_sim"), {"robot": {"command": "joint"}})
AT_REST_RAD = 1e-3
DT_S, HORIZON = 0.1, 8

Path = Callable[[float], FloatArray]


class Along:
    """A policy that follows a path of joints, a function of time since its first step."""

    def __init__(self) -> None:
        self.path: Path = lambda _: HOME_RAD
        self.begun_ns: int | None = None
        self.spec = ModelSpec(
            name="scripted",
            observation=ObservationSpec(cameras=(CameraSpec(camera="front"),), prompt=False),
            action=ActionSpec(
                horizon=HORIZON,
                dt_s=DT_S,
                kind="absolute",
                space="joint",
                joints=ARM_JOINTS,
                gripper="none",
            ),
        )

    def infer(self, observation: Observation) -> ActionSteps:
        now_ns = observation.stamp_wall_ns
        if self.begun_ns is None:
            return ActionSteps(np.tile(self.path(0.0), (HORIZON, 1)))
        times = (now_ns - self.begun_ns) / 1e9 + DT_S * np.arange(1, HORIZON + 1)
        return ActionSteps(np.array([self.path(max(time, 0.0)) for time in times]))


def eased(start_rad: FloatArray, end_rad: FloatArray, time_s: float) -> Path:
    """Minimum-jerk motion from start to end."""

    def at(time: float) -> FloatArray:
        s = min(max(time / time_s, 0.0), 1.0)
        return start_rad + s**3 * (10 - 15 * s + 6 * s * s) * (end_rad - start_rad)

    return at


class Arm:
    """The simulated Panda, active with a joint policy."""

    def __init__(self, **robot: object) -> None:
        self.policy = Along()
        profile = override(PROFILE, {"robot": robot}) if robot else PROFILE
        self.loop = Lockstep(
            profile, build_world(profile), self.policy, reach=ReachabilityFilter(profile)
        )
        self.loop.put("rate", 5.0)
        self.loop.run(1.1)
        activate(self.loop)

    def follow(self, path: Path, duration_s: float) -> FloatArray:
        """Follow `path`, then rest; the joints reached."""
        self.policy.path, self.policy.begun_ns = path, self.loop.now_ns
        self.loop.run(duration_s + 1.5)
        assert self.loop.commander.state.value == "active", self.loop.commander.why
        return self.loop.world.joint_state().position_rad

    def hits(self) -> set[str]:
        return {event.what for event in self.loop.events if event.kind == "limit"}


def test_an_elbow_swivels_with_the_tcp_at_rest() -> None:
    arm, goal_rad = Arm(), swivelled(panda(), 0.9)
    reached = arm.follow(eased(HOME_RAD, goal_rad, 4.0), 4.0)
    assert np.abs(goal_rad - HOME_RAD).max() > 0.4
    assert np.abs(reached - goal_rad).max() < AT_REST_RAD, arm.hits()


def test_joints_go_through_a_wrist_singularity() -> None:
    arm = Arm()
    start_rad = HOME_RAD + [0, 0, 0, 0, 0.5, -0.6, 0]
    goal_rad = HOME_RAD + [0, 0, 0, 0, -0.5, -0.6, 0]
    arm.follow(eased(HOME_RAD, start_rad, 2.0), 2.0)
    reached = arm.follow(eased(start_rad, goal_rad, 2.0), 2.0)
    assert np.abs(reached - goal_rad).max() < AT_REST_RAD, arm.hits()


@pytest.mark.parametrize("seed", [0, 1])
def test_random_smooth_motions_end_where_they_were_asked_to(seed: int) -> None:
    rng, arm, here_rad = np.random.default_rng(seed), Arm(), HOME_RAD
    kinematics = panda()
    low, high = workspace_corners(PROFILE.limits)
    errors: list[float] = []
    while len(errors) < 5:
        goal_rad = HOME_RAD + rng.uniform(-0.4, 0.4, 7)
        place = kinematics.forward(goal_rad).position_m
        if (place < low + [0.03, 0.03, 0.1]).any() or (place > high - 0.03).any():
            continue
        reached = arm.follow(eased(here_rad, goal_rad, 2.5), 2.5)
        errors.append(float(np.abs(reached - goal_rad).max()))
        here_rad = goal_rad
    assert max(errors) < AT_REST_RAD, (errors, arm.hits())
