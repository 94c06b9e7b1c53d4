"""A commander whose worker acts in joints, and a perfect arm that stands where it is commanded."""

from __future__ import annotations

from typing import Any

import numpy as np
from command_rig import LIMIT_RTOL, Rig, reach_of, shipped

from vla_zenoh.control.commander import Setting
from vla_zenoh.control.joint_space import JointBounds
from vla_zenoh.control.limits import workspace_corners
from vla_zenoh.kinematics.kinematics import pose_error
from vla_zenoh.kinematics.so3 import Pose, rotation_from_quat
from vla_zenoh.policy.meaning import wrapped
from vla_zenoh.profile import Profile, override
from vla_zenoh.types import FloatArray, JointCommand

BOX_M = 1e-3
STANDS_RAD = 1e-9


def panda(command: str = "joint", **parts: Any) -> Profile:
    return override(shipped(), {"robot": {"command": command}, **parts})


class Joints:
    """See the module.

    Args:
        of: its profile.
        names: joints of the columns; by default the arm's, in chain order.
        **action: other fields of its `ActionSpec`.
    """

    def __init__(
        self, of: Profile | None = None, names: tuple[str, ...] = (), **action: Any
    ) -> None:
        self.profile = of or panda()
        self.reach = reach_of(self.profile)
        self.kinematics = self.reach.kinematics
        self.names = names or self.kinematics.arm_joints
        fields = {"space": "joint", "joints": self.names, "kind": "absolute", "gripper": "none"}
        self.rig = Rig(self.profile, reach=self.reach, **{**fields, **action})
        self.rig.joints_of_tcp = False
        robot = self.profile.robot
        self.home_rad = self.kinematics.ordered(robot.arm_joints, robot.home_rad)
        self.at(self.home_rad)
        self.joints: list[JointCommand] = []
        self.places_m: list[FloatArray] = []
        """Of the TCP as commanded."""

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
            self.places_m.append(self.kinematics.forward(out.joint.position_rad).position_m.copy())
            if not self.rig.blocked:
                self.at(out.joint.position_rad)
        elif out.pose is not None:
            self.places_m.append(out.pose.position_m)
            if not self.rig.blocked:
                self._follow(Pose(out.pose.position_m, rotation_from_quat(out.pose.quat_xyzw)))
        return out

    def _follow(self, pose: Pose) -> None:
        """As a robot does that takes poses: its elbow follows as little as it must."""
        for _ in range(3):
            here, jacobian = self.kinematics.pose_and_jacobian(self.joints_rad)
            step = np.linalg.lstsq(jacobian, pose_error(pose, here), rcond=1e-3)[0]
            self.rig.joints_rad = self.joints_rad + step

    def run(self, duration_s: float) -> None:
        for _ in range(round(duration_s * 1e9 / self.rig.period_ns)):
            self.tick()

    def columns(self, joints_rad: FloatArray) -> list[float]:
        """Joints in chain order as the worker's columns."""
        order, endless = self.kinematics.arm_joints, self.kinematics.endless
        if self.rig.spec.action.turns == "wrapped":
            joints_rad = np.where(endless, wrapped(joints_rad), joints_rad)
        return [float(joints_rad[order.index(name)]) for name in self.names]

    def send(self, *rows: Any, **how: Any) -> None:
        self.tick(chunks=[self.rig.chunk([list(row) for row in rows], **how)])

    def activate(self) -> None:
        row = self.columns(self.joints_rad)
        absolute = self.rig.spec.action.kind == "absolute"
        self.send(row if absolute else [0.0] * len(row))
        self.tick(Setting("active", True))
        assert self.rig.state == "active", self.rig.commander.why

    def follow(self, path_rad: FloatArray, dt_s: float = 0.1, horizon: int = 8) -> None:
        """Send a path (n, 7) in chunks of `horizon`, one every half of it."""
        period = horizon // 2
        for first in range(0, len(path_rad), period):
            self.send(*(self.columns(row) for row in path_rad[first : first + horizon]))
            self.run(period * dt_s - self.rig.period_ns / 1e9)

    def go(self, goal_rad: FloatArray, duration_s: float) -> None:
        """Follow a minimum-jerk motion to `goal_rad`, then rest there."""
        start_rad = self.joints_rad
        s = np.linspace(0, 1, round(duration_s / 0.1) + 1)[1:, None]
        share = s**3 * (10 - 15 * s + 6 * s * s)
        self.follow(start_rad + share * (goal_rad - start_rad))
        self.settle(goal_rad)

    def settle(self, joints_rad: FloatArray, duration_s: float = 2.0) -> None:
        """Ask for the same until the arm stands, so long at most."""
        for _ in range(round(duration_s / 0.4)):
            before_rad = self.joints_rad.copy()
            self.send(*[self.columns(joints_rad)] * 8)
            self.run(0.4)
            if np.abs(self.joints_rad - before_rad).max() < STANDS_RAD:
                return

    def is_free(self, goal_rad: FloatArray) -> bool:
        """Whether no bound is near on the straight way there."""
        low, high = workspace_corners(self.profile.limits)
        for share in (0.25, 0.5, 0.75, 1.0):
            joints_rad = self.joints_rad + share * (goal_rad - self.joints_rad)
            place = self.kinematics.forward(joints_rad).position_m
            barriers = self.reach.barriers
            left_m = barriers.collisions.distances(joints_rad) - barriers.slow[1:]
            if left_m.min() < 0 or (place < low + 0.03).any() or (place > high - 0.03).any():
                return False
        return True

    def hits(self) -> set[str]:
        """Limits that were told."""
        return {event.what for event in self.rig.events if event.kind == "limit"}

    def assert_within_limits(self) -> None:
        """Joints as finite differences, the box, and the distances of every command."""
        bounds = JointBounds(self.profile, self.kinematics, self.reach.barriers)
        dt_s = self.rig.period_ns / 1e9
        orders = [
            np.array([command[n] for command in map(_numbers, self.joints)]) for n in range(3)
        ]
        for order, limit in zip(orders, bounds.motion, strict=True):
            rates = np.abs(np.diff(order, axis=0)) / dt_s
            assert (rates <= limit * (1 + 1e-4)).all()
        low, high = workspace_corners(self.profile.limits)
        assert (orders[0] >= self.kinematics.lower_rad).all()
        assert (orders[0] <= self.kinematics.upper_rad).all()
        for joints_rad in orders[0][::5]:
            place = self.kinematics.forward(joints_rad).position_m
            assert (place >= low - BOX_M).all()
            assert (place <= high + BOX_M).all()
            left_m = bounds.barriers.collisions.distances(joints_rad) - bounds.barriers.stop[1:]
            assert left_m.min(initial=1.0) > -BOX_M

    def assert_tcp_within(self, share: float = 1.0) -> None:
        """Velocity and acceleration of the commanded TCP as finite differences."""
        dt_s, limits = self.rig.period_ns / 1e9, self.profile.limits.translation
        speed = np.diff(np.array(self.places_m), axis=0) / dt_s
        most = share * (1 + LIMIT_RTOL)
        assert np.abs(speed).max() <= most * limits.velocity_m_s
        assert np.abs(np.diff(speed, axis=0)).max() / dt_s <= most * limits.acceleration_m_s2


def _numbers(command: JointCommand) -> tuple[FloatArray, FloatArray, FloatArray]:
    return command.position_rad, command.velocity_rad_s, command.acceleration_rad_s2
