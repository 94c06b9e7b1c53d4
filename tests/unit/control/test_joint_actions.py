"""Actions in joint space: what a policy asks of the joints is what the joints do."""

from __future__ import annotations

from typing import Any

import numpy as np
from command_rig import Rig
from panda_arm import ARM_JOINTS, HOME_RAD

from vla_zenoh.control.reachability import make_reachability_filter
from vla_zenoh.profile import Profile, load_profile, override
from vla_zenoh.types import FloatArray, JointCommand

EXACT_RAD = 1e-6
LIMIT_RTOL = 1e-6


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
        from vla_zenoh.control.commander import Setting

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


def test_absolute_joints_are_reached_exactly() -> None:
    arm = Joints()
    arm.activate()
    goal_rad = HOME_RAD + [0.3, 0.1, -0.3, 0.1, 0.2, 0.1, -0.4]
    arm.follow(HOME_RAD + np.linspace(0, 1, 31)[1:, None] * (goal_rad - HOME_RAD))
    arm.settle(goal_rad)
    assert arm.rig.state == "active"
    assert np.abs(arm.joints_rad - goal_rad).max() < EXACT_RAD
