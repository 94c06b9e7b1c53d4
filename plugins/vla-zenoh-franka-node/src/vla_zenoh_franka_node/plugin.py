"""The robot driver ``franka_node``: its options in a profile, and where its parts are."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import TYPE_CHECKING, Annotated

from pydantic import Field

from vla_zenoh.plugins import RobotPlugin
from vla_zenoh.profile import Profile
from vla_zenoh.profile.section import Fault, Section, Word

if TYPE_CHECKING:
    from vla_zenoh_franka_node.arm import FrankaNodeArm

Metres = Annotated[float, Field(gt=0, le=1)]
Angle = Annotated[float, Field(gt=0, le=math.pi)]
Budget = Annotated[tuple[float, float, float], Field(strict=False)]
MOST_HZ = 200.0
"""The node refuses more than 250 targets a second."""
AXES = math.sqrt(3)
"""Three axes at their limits are this much faster than one."""


class FrankaNodeOptions(Section):
    """An arm that franka-node 0.4 drives. What is its own setting has the value of its TOML file.

    Args:
        name: of the ``[[arm]]`` there.
        endpoint: of the node, or of a router that it is connected to.
        hand: the arm has a gripper there.
        budget: of its TOML: m/s, m/s^2 and m/s^3 of a pose, as a norm.
        rotation_budget: of its TOML: rad/s, rad/s^2, rad/s^3.
        max_step_m: its max_step.
        max_step_rad: its max_step_rotation.
        max_step_joint_rad: its max_step_joint.
        max_lead_m: its max_lead: how far a target may be from the measured pose.
        max_lead_rad: its max_lead_rotation.
        max_lead_joint_rad: the same of each joint, with robot.command: joint. The node has no such
            bound.
    """

    name: Word = "fr3"
    endpoint: Word = "tcp/127.0.0.1:7447"
    hand: bool = True
    budget: Budget = (0.3, 0.5, 20.0)
    rotation_budget: Budget = (0.5, 1.0, 20.0)
    max_step_m: Metres = 0.05
    max_step_rad: Angle = 0.26
    max_step_joint_rad: Angle = 0.2
    max_lead_m: Metres = 0.05
    max_lead_rad: Angle = 0.26
    max_lead_joint_rad: Angle = 0.2


def _make(profile: Profile, options: FrankaNodeOptions) -> FrankaNodeArm:
    from vla_zenoh_franka_node.arm import FrankaNodeArm

    return FrankaNodeArm(profile, options)


def _contradictions(profile: Profile, options: FrankaNodeOptions) -> Iterator[Fault]:
    if len(profile.robot.arm_joints) != 7:
        yield ("robot", "arm_joints"), "has not the seven joints of a Franka"
    if profile.timing.command_hz > MOST_HZ:
        yield (
            ("timing", "command_hz"),
            f"is {profile.timing.command_hz:g}, but franka-node refuses targets at more than "
            f"250 Hz: set at most {MOST_HZ:g}",
        )
    if profile.robot.command != "pose":
        return
    moves = profile.limits.translation
    turns = profile.limits.rotation
    for section, name, value, most in (
        ("translation", "velocity_m_s", moves.velocity_m_s, options.budget[0] / AXES),
        ("translation", "acceleration_m_s2", moves.acceleration_m_s2, options.budget[1] / AXES),
        ("translation", "jerk_m_s3", moves.jerk_m_s3, options.budget[2] / AXES),
        ("rotation", "velocity_rad_s", turns.velocity_rad_s, options.rotation_budget[0]),
        ("rotation", "acceleration_rad_s2", turns.acceleration_rad_s2, options.rotation_budget[1]),
        ("rotation", "jerk_rad_s3", turns.jerk_rad_s3, options.rotation_budget[2]),
    ):
        if value > most:
            yield (
                ("limits", section, name),
                f"is {value:g}, but the node's budget allows {most:.3g} an axis: "
                "lower it, or raise the budget there and in the profile",
            )


PLUGIN = RobotPlugin(make=_make, options=FrankaNodeOptions, contradictions=_contradictions)
