"""The robot driver ``trossen``: its options in a profile, and where its parts are."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, Annotated, Literal

from pydantic import Field

from vla_zenoh.plugins import RobotPlugin
from vla_zenoh.profile import Profile
from vla_zenoh.profile.schema import Address
from vla_zenoh.profile.section import Fault, Section

if TYPE_CHECKING:
    from vla_zenoh_trossen.arm import TrossenArm

ARM_JOINTS = 6
STROKE_M = 0.044
"""Each finger of the maker's gripper slides so far."""


class TrossenOptions(Section):
    """A WidowX AI by Trossen's library ``trossen_arm``, whose brakes open as the node starts.

    Args:
        address: of its controller.
        end_effector: name in ``trossen_arm.StandardEndEffector``: its masses and its tool frame.
        clear_error: an error that the controller has as the node starts is cleared; otherwise
            the node ends with it.
        follow_rad: a joint that is further from its target for a fifth of a second is a fault:
            something blocks it, or another program commands it.
    """

    address: Address = "192.168.1.2"
    end_effector: Literal["wxai_v0_follower", "wxai_v0_leader", "wxai_v0_base", "no_gripper"] = (
        "wxai_v0_follower"
    )
    clear_error: bool = False
    follow_rad: Annotated[float, Field(gt=0, le=1)] = 0.15


def _make(profile: Profile, options: TrossenOptions) -> TrossenArm:
    from vla_zenoh_trossen.arm import TrossenArm

    return TrossenArm(profile, options)


def _contradictions(profile: Profile, options: TrossenOptions) -> Iterator[Fault]:
    if len(profile.robot.arm_joints) != ARM_JOINTS:
        yield ("robot", "arm_joints"), "has not the six joints of a WidowX AI"
    width_m = profile.robot.max_width_m
    if options.end_effector != "no_gripper" and profile.robot.gripper is None:
        wants = "gripper: {max_width_m: ...}, or trossen: {end_effector: no_gripper}"
        yield ("robot",), f"declares no gripper, and trossen.end_effector has one: give {wants}"
    if options.end_effector != "no_gripper" and width_m > 2 * STROKE_M:
        yield (
            ("robot", "gripper", "max_width_m"),
            f"is {width_m:g}, but the fingers of a WidowX AI open to {2 * STROKE_M:g}",
        )


PLUGIN = RobotPlugin(
    make=_make, options=TrossenOptions, commands=("joint",), contradictions=_contradictions
)
