"""The kinematics of a profile's robot, ready for the command node."""

from __future__ import annotations

from vla_zenoh import resources
from vla_zenoh.control.reachability import ReachabilityFilter
from vla_zenoh.kinematics.kinematics import Kinematics
from vla_zenoh.profile import Profile


def make_kinematics(profile: Profile) -> Kinematics:
    """Kinematics of the profile's robot.

    Raises:
        ResourceError: its description is not there.
        ProfileError: frames or joints that the description does not have.
    """
    robot = profile.robot
    return Kinematics(
        resources.robot_urdf(robot.description),
        robot.tcp_frame,
        robot.arm_joints,
        robot.finger_joints,
        base_frame=robot.base_frame,
        finger_ends=robot.gripper.joint_ends,
    )


def make_shadow(profile: Profile, kinematics: Kinematics | None = None) -> ReachabilityFilter:
    """The kinematic shadow that bounds goals, standing at home.

    Raises:
        ResourceError: description or collision shapes are not there.
        ProfileError: frames or joints that the description does not have.
    """
    kinematics = kinematics or make_kinematics(profile)
    names = profile.robot.arm_joints
    home_rad = kinematics.ordered(names, profile.robot.home_rad)
    # Its joints are ours to command, and to hold back, only where the profile says so.
    commanded = profile.robot.command == "joint"
    most_rad_s = profile.limits.joint.of("velocity_rad_s", len(names))
    return ReachabilityFilter(
        kinematics,
        home_rad,
        profile.limits,
        free_elbow=commanded,
        posture_rad=home_rad if profile.robot.posture == "home" else None,
        known_good_rad=[home_rad],
        velocity_rad_s=kinematics.ordered(names, most_rad_s) if commanded else None,
    )
