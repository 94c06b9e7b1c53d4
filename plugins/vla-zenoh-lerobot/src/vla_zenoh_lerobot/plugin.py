"""The robot driver ``lerobot``: its options in a profile, and where its parts are."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from pydantic import Field

from vla_zenoh.plugins import RobotPlugin
from vla_zenoh.profile import Profile
from vla_zenoh.profile.section import Fault, Name, Section, Text, Word, Words, unlisted

if TYPE_CHECKING:
    from vla_zenoh_lerobot.arm import LeRobotArm

SCRIPT = Path(__file__).with_name("arm.py")


class LeRobotOptions(Section):
    """A robot class of LeRobot, calibrated by LeRobot's own program.

    Args:
        robot: LeRobot's name of it: ``so101_follower``, ``so100_follower``, ``koch_follower``.
        port: serial port of its motors.
        id: under which it was calibrated.
        calibration_dir: folder of the calibration; empty: LeRobot's own.
        units: of its joints: ``degrees``, or ``normalised``: -100 to 100 from one end of
            robot.joint_range_rad (else of the description) to the other.
        motors: of each of robot.arm_joints; empty: they have the same names.
        zero_deg: angle by LeRobot at which each joint of the description is 0; empty: 0 for each.
        reversed: arm_joints that turn against the description.
        gripper: its motor, 0 to 100; empty: there is none.
        limp_at_end: the motors are released when the node ends, and the arm falls.
    """

    robot: Name = "so101_follower"
    port: Word
    id: Name
    calibration_dir: Text = ""
    units: Literal["degrees", "normalised"] = "degrees"
    motors: Words = ()
    zero_deg: tuple[float, ...] = Field(default=(), strict=False)
    reversed: Words = ()
    gripper: Text = "gripper"
    limp_at_end: bool = False


def _make(profile: Profile, options: LeRobotOptions) -> LeRobotArm:
    from vla_zenoh_lerobot.arm import LeRobotArm

    return LeRobotArm(profile, options)


def _script(options: LeRobotOptions) -> Path:
    return SCRIPT


def _contradictions(profile: Profile, options: LeRobotOptions) -> Iterator[Fault]:
    joints = profile.robot.arm_joints
    for name in ("motors", "zero_deg"):
        given = getattr(options, name)
        if given and len(given) != len(joints):
            yield ("lerobot", name), f"has {len(given)} entries for {len(joints)} arm_joints"
    yield from unlisted(("lerobot", "reversed"), options.reversed, "robot.arm_joints", joints)


PLUGIN = RobotPlugin(
    make=_make,
    options=LeRobotOptions,
    commands=("joint",),
    script=_script,
    contradictions=_contradictions,
)
