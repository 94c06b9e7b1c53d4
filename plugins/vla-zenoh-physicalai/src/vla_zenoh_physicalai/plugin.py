"""The robot driver ``physicalai`` and the model ``physicalai_client``: their declarations."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from pydantic import Field

from vla_zenoh.plugins import FilePlugin, RobotPlugin
from vla_zenoh.profile import Profile
from vla_zenoh.profile.section import Fault, Section, Text, Word, Words, unlisted

if TYPE_CHECKING:
    from vla_zenoh_physicalai.arm import PhysicalAiArm

CLIENT = FilePlugin(file=Path(__file__).with_name("client_model.py"))


class PhysicalAiOptions(Section):
    """A robot that an owner process of Intel's physicalai 0.3 drives (``physicalai robot serve``).

    Args:
        name: of the robot there.
        endpoint: of its owner, as ``tcp/10.0.0.5:24310``; empty: on this computer.
        units: of its joints; empty: as its class implies (SO101 normalised, WidowXAI degrees).
            ``normalised``: -100 to 100 from one end of robot.joint_range_rad (else of the
            description) to the other.
        joints: theirs, of each of robot.arm_joints; empty: they have the same names.
        reversed: arm_joints that turn against the description.
        zero: their number at which each joint of the description is 0; empty: 0 for each.
        gripper: its joint there; empty: there is none.
        gripper_shut: its number when the gripper is shut; null: 0 where joints are normalised.
        gripper_open: its number when the gripper is open; null: 100 where joints are normalised.
    """

    name: Word
    endpoint: Text = ""
    units: Literal["", "degrees", "radians", "normalised"] = ""
    joints: Words = ()
    reversed: Words = ()
    zero: tuple[float, ...] = Field(default=(), strict=False)
    gripper: Text = "gripper"
    gripper_shut: float | None = None
    gripper_open: float | None = None


def _make(profile: Profile, options: PhysicalAiOptions) -> PhysicalAiArm:
    from vla_zenoh_physicalai.arm import PhysicalAiArm

    return PhysicalAiArm(profile, options)


def _contradictions(profile: Profile, options: PhysicalAiOptions) -> Iterator[Fault]:
    joints = profile.robot.arm_joints
    for name in ("joints", "zero"):
        given = getattr(options, name)
        if given and len(given) != len(joints):
            yield ("physicalai", name), f"has {len(given)} entries for {len(joints)} arm_joints"
    yield from unlisted(("physicalai", "reversed"), options.reversed, "robot.arm_joints", joints)
    if options.gripper_shut is not None and options.gripper_shut == options.gripper_open:
        yield ("physicalai", "gripper_open"), "is the same as gripper_shut"


PLUGIN = RobotPlugin(
    make=_make,
    options=PhysicalAiOptions,
    commands=("joint",),
    contradictions=_contradictions,
)
