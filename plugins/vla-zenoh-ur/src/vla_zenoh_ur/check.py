"""Checks of a UR arm over RTDE: connects and reads, uploads and moves nothing."""

from __future__ import annotations

from collections.abc import Iterator

from vla_zenoh.errors import MissingExtraError, NodeError
from vla_zenoh.kinematics.kinematics import make_kinematics
from vla_zenoh.kinematics.so3 import Pose, exp3, pose_distance
from vla_zenoh.lab.doctor.needs import HostFinding, judged
from vla_zenoh.profile import Profile
from vla_zenoh_ur.arm import WELL, UrArm
from vla_zenoh_ur.plugin import UrOptions

APART_M, APART_RAD = 0.01, 0.03
"""An arm's own calibration differs from that of its type by some millimetres."""


def ur_arm(profile: Profile, options: UrOptions) -> Iterator[HostFinding]:
    """Connect to the arm, read it and compare it with the profile."""
    try:
        arm = UrArm(profile, options)
        arm.open()
    except (NodeError, MissingExtraError) as error:
        yield HostFinding("connection", "fail", str(error), "see docs/how-to/ur-rtde.md")
        return
    try:
        yield HostFinding("connection", "ok", arm.address)
        status = arm.status()
        found = f"robot mode {status['robot_mode']}, safety mode {status['safety_mode']}"
        well = status["robot_mode"] == "RUNNING" and status["safety_mode"] in WELL
        advice = "power it on and release its brakes at the pendant"
        yield judged("state", well, found, advice)
        slider = status["speed_slider"]
        advice = "set it to 100 %: the arm takes no commands below that"
        yield judged("speed slider", slider == 1, f"{100 * slider:.0f} %", advice)
        joints_rad, position_m, rotvec = arm.measured()
        own = Pose(position_m, exp3(rotvec))
        kinematics = make_kinematics(profile)
        ordered_rad = kinematics.ordered(profile.robot.arm_joints, joints_rad)
        apart_m, apart_rad = pose_distance(own, kinematics.forward(ordered_rad))
        found = f"its TCP is {1e3 * apart_m:.1f} mm and {1e3 * apart_rad:.1f} mrad from ours"
        near = apart_m <= APART_M and apart_rad <= APART_RAD
        advice = "same TCP in its installation as robot.tcp_frame? same type of arm?"
        yield judged("kinematics", near, found, advice, "fail")
    finally:
        arm.close()
