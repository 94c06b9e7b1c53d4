"""The robot driver ``franka``: its options in a profile, and where its parts are."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, Annotated, Literal

from pydantic import Field

from vla_zenoh.plugins import RobotPlugin
from vla_zenoh.profile import Profile
from vla_zenoh.profile.schema import Address
from vla_zenoh.profile.section import Point, Section

if TYPE_CHECKING:
    from vla_zenoh.lab.doctor import HostFinding
    from vla_zenoh_franka.arm import FrankaArm

Stiffness = Annotated[float, Field(gt=0, le=3000)]
Threshold = Annotated[float, Field(gt=0, le=100)]
Inertia = Annotated[float, Field(ge=-1, le=1)]
"""7 kg at 0.3 m have 0.6 kg m^2: more is in other units."""
_SEVEN = Field(strict=False, min_length=7, max_length=7)
Stiffnesses = Annotated[tuple[Stiffness, ...], _SEVEN]
Thresholds = Annotated[tuple[Threshold, ...], _SEVEN]


class FrankaLoad(Section):
    """What the flange carries beyond the end effector that is set in Desk.

    Args:
        mass_kg: its mass.
        centre_m: its centre of mass in the flange's frame.
        inertia_kg_m2: about that centre, in the flange's axes: xx, yy, zz, xy, xz, yz.
    """

    mass_kg: float = Field(default=0.0, ge=0, le=7)
    centre_m: Point = (0.0, 0.0, 0.0)
    inertia_kg_m2: tuple[Inertia, Inertia, Inertia, Inertia, Inertia, Inertia] = Field(
        default=(0.0, 0.0, 0.0, 0.0, 0.0, 0.0), strict=False
    )


class FrankaOptions(Section):
    """A Franka arm; all of it is set before the first motion.

    The arm is a spring around its set-point, with critical damping about the commanded velocity.

    Args:
        address: of the robot's control box.
        fci: version of the interface: 10 for an FR3, 5 for a Panda.
        realtime: ``enforce``: its 1 kHz loop needs a real-time kernel; ``ignore``: for a simulator.
        stiffness_n_m: of the TCP, with robot.command: pose.
        stiffness_nm_rad: of its rotation.
        joint_stiffness_nm_rad: of joint 1 to 7, with robot.command: joint.
        posture_stiffness_nm_rad: with which the elbow keeps its place, with robot.command: pose.
        collision_force_n: external force at the TCP that makes the robot end a motion (reflex);
            above limits.contact.force_stop_n, at which the arm retreats instead.
        collision_torque_nm: external torque about the TCP that does the same.
        collision_joint_nm: external torque of joint 1 to 7 that does the same.
        load: beyond the end effector of Desk.
        hand: the robot has a Franka Hand.
    """

    address: Address
    fci: Literal[5, 10] = 10
    realtime: Literal["enforce", "ignore"] = "enforce"
    stiffness_n_m: Stiffness = 2000.0
    stiffness_nm_rad: float = Field(default=150.0, gt=0, le=300)
    joint_stiffness_nm_rad: Stiffnesses = (600.0, 600.0, 600.0, 600.0, 250.0, 150.0, 50.0)
    posture_stiffness_nm_rad: float = Field(default=10.0, ge=0, le=100)
    collision_force_n: Threshold = 60.0
    collision_torque_nm: Threshold = 30.0
    collision_joint_nm: Thresholds = (40.0, 40.0, 36.0, 36.0, 32.0, 28.0, 24.0)
    load: FrankaLoad = FrankaLoad()
    hand: bool = True


def _make(profile: Profile, options: FrankaOptions) -> FrankaArm:
    from vla_zenoh_franka.arm import FrankaArm

    return FrankaArm(profile, options)


def _check_host(profile: Profile, options: FrankaOptions) -> Iterator[HostFinding]:
    from vla_zenoh_franka.check import fci_host

    return fci_host(options)


def _check_robot(profile: Profile, options: FrankaOptions) -> Iterator[HostFinding]:
    from vla_zenoh_franka.check import fci_arm

    return fci_arm(profile, options)


PLUGIN = RobotPlugin(
    make=_make, options=FrankaOptions, check_host=_check_host, check_robot=_check_robot
)
