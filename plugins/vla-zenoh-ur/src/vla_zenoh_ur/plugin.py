"""The robot driver ``ur``: its options in a profile, and where its parts are."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

from pydantic import Field

from vla_zenoh.plugins import RobotPlugin
from vla_zenoh.profile import Profile
from vla_zenoh.profile.schema import Address
from vla_zenoh.profile.section import Angles, Point, Section

if TYPE_CHECKING:
    from vla_zenoh.lab.doctor import HostFinding
    from vla_zenoh_ur.arm import UrArm


class UrOptions(Section):
    """A UR arm over RTDE; tool, payload and watchdog are set before the first motion.

    Args:
        address: of the control box.
        lookahead_s: of ``servoj``: the robot smooths its set-points over this time.
        gain: of ``servoj``: how hard it follows them.
        tcp_m: where robot.tcp_frame is in the frame of the robot's flange.
        tcp_rotvec: its rotation there, as a rotation vector.
        payload_kg: mass that the flange carries.
        payload_centre_m: its centre of mass in the frame of the flange.
        watchdog_hz: the robot stops its program if messages from this computer come less often.
    """

    address: Address
    lookahead_s: float = Field(default=0.1, ge=0.03, le=0.2)
    gain: float = Field(default=300.0, ge=100, le=2000)
    tcp_m: Point = (0.0, 0.0, 0.0)
    tcp_rotvec: Angles = (0.0, 0.0, 0.0)
    payload_kg: float = Field(default=0.0, ge=0, le=50)
    payload_centre_m: Point = (0.0, 0.0, 0.0)
    watchdog_hz: float = Field(default=5.0, ge=1, le=50)


def _make(profile: Profile, options: UrOptions) -> UrArm:
    from vla_zenoh_ur.arm import UrArm

    return UrArm(profile, options)


def _check_robot(profile: Profile, options: UrOptions) -> Iterator[HostFinding]:
    from vla_zenoh_ur.check import ur_arm

    return ur_arm(profile, options)


PLUGIN = RobotPlugin(make=_make, options=UrOptions, commands=("joint",), check_robot=_check_robot)
