"""What contradicts the section ``ros2`` of a profile, found whenever the profile is loaded."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

from pydantic import ValidationError

from vla_zenoh.plugins import Fault
from vla_zenoh.profile import Profile
from vla_zenoh.profile.robot import RobotProfile, Ros2Gripper, Ros2Profile
from vla_zenoh.profile.schema import TRUSTED_PROTOCOLS, is_loopback
from vla_zenoh.profile.section import Place, unlisted

JOINT_COMMANDS = ("trajectory_msgs/msg/JointTrajectory", "std_msgs/msg/Float64MultiArray")


def contradictions(profile: Profile, options: None) -> Iterator[Fault]:
    """Faults of the section itself, and of it beside cameras, parts and certificates."""
    ros2 = profile.ros2
    if ros2 is None:
        return
    if not profile.parts:
        yield from _ros2_arm((), ros2, profile.robot)
    elif profile.robot.driver == "ros2":
        yield from _ros2_parts(profile)
    yield from unlisted(("ros2", "cameras"), ros2.cameras, "cameras", profile.cameras)
    for name, camera in ros2.cameras.items():
        source = profile.cameras[name].source if name in profile.cameras else ""
        if source.startswith("ros2:") and source.removeprefix("ros2:") != camera.topic:
            yield ("ros2", "cameras", name, "topic"), f"is not that of cameras.{name}: {source!r}"
    for name, camera in profile.ros2_cameras().items():
        if (camera.depth is None) != (profile.cameras[name].depth_unit_m is None):
            why = f"goes with cameras.{name}.depth_unit_m, and either is given without the other"
            yield ("ros2", "cameras", name, "depth"), why
    yield from _way_to_ros2(profile, ros2.connect)


def _ros2_parts(profile: Profile) -> Iterator[Fault]:
    seen: dict[str, Profile] = {}
    for name in profile.parts:
        try:
            own = profile.of_part(name)
        except ValidationError:
            continue  # the profile itself says so
        assert own.ros2 is not None
        yield from _ros2_arm(("parts", name), own.ros2, own.robot)
        yield from _shared(name, own, seen)
        seen[name] = own


def _ros2_arm(place: Place, ros2: Ros2Profile, robot: RobotProfile) -> Iterator[Fault]:
    """Commands of an arm and its gripper."""
    place = (*place, "ros2")
    wanted = f"{robot.command}_command"
    if robot.driver == "ros2" and getattr(ros2, wanted) is None:
        yield place, f"lacks {wanted}: robot.command is {robot.command}"
    joints = ros2.joint_command
    if joints is not None and joints.type not in JOINT_COMMANDS:
        wanted = " or ".join(JOINT_COMMANDS)
        yield (*place, "joint_command", "type"), f"is {joints.type}: joints are sent as {wanted}"
    gripper = ros2.gripper
    if gripper is not None:
        if gripper.grasp and gripper.type != "franka_msgs/action/Move":
            yield (*place, "gripper", "grasp"), "goes with type franka_msgs/action/Move only"
        if robot.gripper is None:
            width = "gripper: {max_width_m: ...}, its largest opening"
            yield (*place, "gripper"), f"needs robot.gripper: {width}"
            return
        yield from _gripper_position(place, gripper, robot.gripper.joint_ends is not None)
        if gripper.type == JOINT_COMMANDS[0] and not robot.finger_joints:
            yield (*place, "gripper", "type"), "is a trajectory, which needs robot.finger_joints"


def _gripper_position(place: Place, gripper: Ros2Gripper, has_ends: bool) -> Iterator[Fault]:
    """A number with the wrong meaning opens the gripper where it should close."""
    place = (*place, "gripper", "position")
    says_width = gripper.type.startswith("franka_msgs/")
    ends = "joint_open_rad and joint_shut_rad (_m where it slides) in robot.gripper"
    if says_width and gripper.position is not None:
        yield place, f"is not for {gripper.type}, which takes the width"
    elif gripper.position == "joint" and not has_ends:
        yield place, f"is joint, which needs {ends}"
    elif not (says_width or gripper.position or has_ends):
        yield (
            place,
            f"is missing: does the driver take the m between the fingers (width), those of one "
            f"finger (finger), or what its joint goes by (joint, with {ends})?",
        )


def _way_to_ros2(profile: Profile, places: Sequence[str] | None) -> Iterator[Fault]:
    """A client of the bridge can move the robot without our command node."""
    secured = profile.session.security is not None
    used = any("ros2" in host.nodes for host in profile.hosts.values())
    if places is None and secured and used:
        yield (
            ("ros2", "connect"),
            "is missing: in a secured lab the bridge has a router of its own. On the computer that "
            "runs the node ros2: connect: [tcp/127.0.0.1:7450]; on another one, where it takes "
            "this lab's certificates: connect: [tls/ADDRESS:7450]",
        )
    trusted = [endpoint.partition("/")[0] in TRUSTED_PROTOCOLS for endpoint in places or ()]
    for index, endpoint in enumerate(places or ()):
        place = ("ros2", "connect", str(index))
        if trusted[index] and not secured:
            yield place, "needs certificates: make them with `vla-zenoh secure init`"
        elif secured and not trusted[index] and (any(trusted) or not is_loopback(endpoint)):
            why = "lets anyone on the network command the robot: write tls/, or tcp/127.0.0.1:7450"
            yield place, why


def _shared(name: str, own: Profile, others: Mapping[str, Profile]) -> Iterator[Fault]:
    """What would move two arms by one command, or take one arm for another."""
    assert own.ros2 is not None
    for other, profile in others.items():
        theirs = profile.ros2
        assert theirs is not None
        for what in ("joint_command", "gripper"):
            ours, same = getattr(own.ros2, what), getattr(theirs, what)
            if ours is not None and same is not None and ours.topic == same.topic:
                why = f"has the topic of part {other}, {ours.topic}: both would follow one command"
                yield ("parts", name, "ros2", what), why
        joints = set(own.robot.arm_joints) & set(profile.robot.arm_joints)
        if joints and own.ros2.joint_states == theirs.joint_states:
            why = (
                f"is {theirs.joint_states}, as that of part {other}, and both arms have joints "
                f"{', '.join(sorted(joints)[:3])}: give each its own topic, or its own joint names"
            )
            yield ("parts", name, "ros2", "joint_states"), why
