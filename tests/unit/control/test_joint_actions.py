"""Actions in joint space: what a policy asks of the joints is what the joints do."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from command_rig import Rig
from panda_arm import ARM_JOINTS, HOME_RAD

from vla_zenoh.control.commander import Setting
from vla_zenoh.control.joint_space import JointBounds
from vla_zenoh.control.limits import workspace_corners
from vla_zenoh.control.reachability import make_reachability_filter
from vla_zenoh.profile import Profile, load_profile, override
from vla_zenoh.types import FloatArray, JointCommand

EXACT_RAD = 1e-6
BOX_M = 1e-3


def panda(command: str = "joint") -> Profile:
    return override(load_profile("panda_sim"), {"robot": {"command": command}})


class Joints:
    """A commander whose worker acts in joints, and a perfect arm."""

    def __init__(self, command: str = "joint", names: tuple[str, ...] = ARM_JOINTS, **action: Any):
        self.profile = panda(command)
        reach = make_reachability_filter(self.profile)
        self.kinematics = reach.kinematics
        fields = {"space": "joint", "joints": names, "kind": "absolute", "gripper": "none"}
        self.rig = Rig(self.profile, reach=reach, **{**fields, **action})
        self.rig.joints_of_shadow = False
        self.names = names
        self.at(HOME_RAD)
        self.joints: list[JointCommand] = []

    def at(self, joints_rad: FloatArray) -> None:
        self.rig.stand_at(self.kinematics, np.array(joints_rad, float))

    @property
    def joints_rad(self) -> FloatArray:
        assert self.rig.joints_rad is not None
        return self.rig.joints_rad

    def tick(self, *what: Any, **more: Any) -> Any:
        out = self.rig.tick(*what, **more)
        if out.joint is not None:
            self.joints.append(out.joint)
            self.at(out.joint.position_rad)
        return out

    def run(self, duration_s: float) -> None:
        for _ in range(round(duration_s * 1e9 / self.rig.period_ns)):
            self.tick()

    def columns(self, joints_rad: FloatArray) -> list[float]:
        """Joints in chain order as the worker's columns."""
        return [float(joints_rad[ARM_JOINTS.index(name)]) for name in self.names]

    def activate(self) -> None:
        self.tick(chunks=[self.rig.chunk([self.columns(self.joints_rad)])])
        self.tick(Setting("active", True))
        assert self.rig.state == "active", self.rig.commander.why

    def follow(self, path_rad: FloatArray, dt_s: float = 0.1, horizon: int = 8) -> None:
        """Send a path (n, 7) in chunks of `horizon`, one every half of it."""
        period = horizon // 2
        for first in range(0, len(path_rad), period):
            rows = [self.columns(row) for row in path_rad[first : first + horizon]]
            self.tick(chunks=[self.rig.chunk(rows)])
            self.run(period * dt_s - self.rig.period_ns / 1e9)

    def settle(self, joints_rad: FloatArray, duration_s: float = 2.0) -> None:
        for _ in range(round(duration_s / 0.4)):
            self.tick(chunks=[self.rig.chunk([self.columns(joints_rad)] * 8)])
            self.run(0.4)

    def assert_within_limits(self) -> None:
        """Joints as finite differences, the box, and the distances of every command."""
        bounds = JointBounds(
            self.profile, self.kinematics, make_reachability_filter(self.profile).barriers
        )
        dt_s = self.rig.period_ns / 1e9
        orders = [
            np.array([command[n] for command in map(_numbers, self.joints)]) for n in range(3)
        ]
        for order, limit in zip(orders, bounds.motion, strict=True):
            rates = np.abs(np.diff(order, axis=0)) / dt_s
            assert (rates <= limit * (1 + 1e-4)).all()
        low, high = workspace_corners(self.profile.limits)
        for joints_rad in orders[0][::5]:
            place = self.kinematics.forward(joints_rad).position_m
            assert (place >= low - BOX_M).all()
            assert (place <= high + BOX_M).all()
            left_m = bounds.barriers.collisions.distances(joints_rad) - bounds.barriers.stop[1:]
            assert left_m.min() > -BOX_M


def _numbers(command: JointCommand) -> tuple[FloatArray, FloatArray, FloatArray]:
    return command.position_rad, command.velocity_rad_s, command.acceleration_rad_s2


def test_absolute_joints_are_reached_exactly() -> None:
    arm = Joints()
    arm.activate()
    goal_rad = HOME_RAD + [0.3, 0.1, -0.3, 0.1, 0.2, 0.1, -0.4]
    arm.follow(HOME_RAD + np.linspace(0, 1, 31)[1:, None] * (goal_rad - HOME_RAD))
    arm.settle(goal_rad)
    assert arm.rig.state == "active"
    assert np.abs(arm.joints_rad - goal_rad).max() < EXACT_RAD


@pytest.mark.parametrize("kind", ["absolute", "delta"])
def test_no_limit_is_broken_whatever_the_policy_asks(kind: str) -> None:
    rng, arm = np.random.default_rng(0), Joints(kind=kind)
    arm.activate()
    for _ in range(14):
        rows = (HOME_RAD + rng.uniform(-1.2, 1.2, (1, 7))) * np.ones((8, 1))
        if kind == "delta":
            rows = rng.uniform(-0.15, 0.15, (1, 7)) * np.ones((8, 1))
        arm.tick(chunks=[arm.rig.chunk(rows)])
        arm.run(float(rng.choice([0.05, 0.2, 0.5])))
    arm.tick(Setting("active", False))
    arm.run(1.2)
    assert arm.rig.commander.at_rest
    arm.assert_within_limits()


def test_columns_are_mapped_by_the_names_of_the_joints() -> None:
    arm = Joints(names=ARM_JOINTS[::-1])
    arm.activate()
    goal_rad = HOME_RAD + [0.1, 0.05, -0.1, 0.05, 0.1, 0.05, -0.1]
    arm.settle(goal_rad)
    assert np.abs(arm.joints_rad - goal_rad).max() < EXACT_RAD


def test_a_worker_with_other_joints_is_rejected_by_their_names() -> None:
    arm = Joints(names=("elbow", *ARM_JOINTS[1:]))
    arm.rig.tick(chunks=[arm.rig.chunk([HOME_RAD])])
    arm.tick(Setting("active", True))
    assert arm.rig.state == "inactive"
    assert "its joints are elbow, panda_joint2" in arm.rig.commander.why


def test_a_robot_that_takes_poses_gets_those_of_the_joints() -> None:
    arm = Joints("pose")
    arm.activate()
    goal_rad = HOME_RAD + [0.2, 0.05, -0.2, 0.05, 0.1, 0.05, -0.2]
    goal = arm.kinematics.forward(goal_rad)
    arm.settle(goal_rad)
    assert np.abs(arm.rig.position_m - goal.position_m).max() < EXACT_RAD
    arm.rig.assert_smooth()
