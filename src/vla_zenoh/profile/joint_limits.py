"""Bounds of motion per joint, for a robot that is commanded by joint positions.

Franka publishes for the Panda, joint 1 to 7 ("Robot and interface specifications" of the Franka
Control Interface documentation):

    velocity      2.175  2.175  2.175  2.175  2.61   2.61   2.61   rad/s
    acceleration  15     7.5    10     12.5   15     20     20     rad/s^2
    jerk          7500   3750   5000   6250   7500   10000  10000  rad/s^3

No value may exceed the largest of its row. The defaults are half the velocity, 30 % of the
acceleration and 5 % of the jerk of the row's smallest, for every joint; the Panda's own profile
gives the same shares joint by joint.
"""

from __future__ import annotations

from typing import Annotated, Any

from pydantic import AfterValidator, BeforeValidator, Field

from vla_zenoh.profile.section import Section


def _one_for_all(value: Any) -> Any:
    if isinstance(value, (int, float)) and not isinstance(value, bool):
        return (value,)
    return value


def _not_empty(values: tuple[float, ...]) -> tuple[float, ...]:
    if not values:
        raise ValueError("is empty: give one number for all joints, or one each")
    return values


_PerJoint = (
    Field(strict=False, max_length=64),
    BeforeValidator(_one_for_all),
    AfterValidator(_not_empty),
)
Velocity = Annotated[float, Field(gt=0, le=2.61)]
Acceleration = Annotated[float, Field(gt=0, le=20)]
Jerk = Annotated[float, Field(gt=0, le=10_000)]


class JointLimits(Section):
    """One number for all joints, or one for each in the order of ``robot.arm_joints``.

    Args:
        velocity_rad_s: of the commanded motion.
        acceleration_rad_s2: likewise.
        jerk_rad_s3: likewise, and of the robot's own stop.
    """

    velocity_rad_s: Annotated[tuple[Velocity, ...], *_PerJoint] = (1.0875,)
    acceleration_rad_s2: Annotated[tuple[Acceleration, ...], *_PerJoint] = (2.25,)
    jerk_rad_s3: Annotated[tuple[Jerk, ...], *_PerJoint] = (187.5,)

    def of(self, name: str, joints: int) -> tuple[float, ...]:
        """The limit called `name`, one number for each of so many joints."""
        values: tuple[float, ...] = getattr(self, name)
        return values * joints if len(values) == 1 else values
