"""The part of a profile that says which robot it is, and how it is commanded."""

from __future__ import annotations

import math
from typing import Literal

from pydantic import Field, model_validator

from vla_zenoh.profile.section import Name, Section, Word, Words, refuse


class GripperProfile(Section):
    """The gripper. A command is sent when the width differs by more than the dead band."""

    max_width_m: float = Field(default=0.08, gt=0, le=1)
    speed_m_s: float = Field(default=0.1, ge=1e-4, le=1)
    force_n: float = Field(default=25.0, ge=0, le=500)
    dead_band_m: float = Field(default=0.001, gt=0, le=0.05)
    command_timeout_s: float = Field(default=2.0, gt=0, le=30)


class RobotProfile(Section):
    """The robot and its description (URDF), which serves the simulator and the kinematics.

    Args:
        name: part of every key.
        driver: who moves it: the simulator, a ROS 2 robot's controllers, or a Python file.
        command: what it is commanded by: ``pose`` of the TCP, for a Cartesian impedance
            controller, or ``joint`` positions, for an arm without one.
        description: path of the URDF, or ``example-robot-data:`` and a path in that package.
        base_frame: link all poses are given in.
        tcp_frame: link whose pose is meant.
        arm_joints: in the order in which every list of joint values in the profile is.
        finger_joints: of the gripper.
        home_rad: where a reset puts the simulated arm, and the posture a redundant arm keeps.
        gripper: its own section.
    """

    name: Name
    driver: Literal["sim", "ros2", "arm"] = "sim"
    command: Literal["pose", "joint"] = "pose"
    description: Word
    base_frame: Word
    tcp_frame: Word
    arm_joints: Words = Field(min_length=1)
    finger_joints: Words = ()
    home_rad: tuple[float, ...] = Field(strict=False)
    gripper: GripperProfile = GripperProfile()

    @model_validator(mode="after")
    def _joints_fit(self) -> RobotProfile:
        faults = []
        if len(self.home_rad) != len(self.arm_joints):
            why = f"has {len(self.home_rad)} angles for {len(self.arm_joints)} arm_joints"
            faults.append((("home_rad",), why))
        faults += [
            (("home_rad", str(index)), f"is {angle:g}: more than a turn; give radians")
            for index, angle in enumerate(self.home_rad)
            if abs(angle) > 2 * math.pi
        ]
        shared = sorted(set(self.arm_joints) & set(self.finger_joints))
        if shared:
            faults.append((("finger_joints",), f"repeats arm_joints: {', '.join(shared)}"))
        if self.gripper.dead_band_m >= self.gripper.max_width_m:
            why = (
                f"must be less than max_width_m ({self.gripper.max_width_m:g}): nothing would move"
            )
            faults.append((("gripper", "dead_band_m"), why))
        refuse(faults)
        return self
