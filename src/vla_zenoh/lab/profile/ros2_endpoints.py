"""Topics, services and actions of a ROS graph that a profile uses."""

from __future__ import annotations

from collections.abc import Iterator

from vla_zenoh.profile import Profile
from vla_zenoh.profile.ros2 import GRIPPER_ACTIONS, Ros2Gripper, Ros2Profile
from vla_zenoh.ros2 import diagnostics
from vla_zenoh.ros2.gripper_actions import GRASP
from vla_zenoh.ros2.keys import Endpoint, EntityRole
from vla_zenoh.ros2.names import PROMPT_TOPIC, SERVICES, STATUS_TOPIC
from vla_zenoh.ros2.readers import JOINT_STATE, TEXT, WRENCH


def endpoints(profile: Profile) -> tuple[Endpoint, ...]:
    """Our ends in the ROS graph, each once; none where the profile has no section ros2.

    Quality of service is left at its default: it is the node's.
    """
    ros2 = profile.ros2
    if ros2 is None:
        return ()
    found = [
        Endpoint(EntityRole.SUBSCRIBER, c.topic, c.type) for c in profile.ros2_cameras().values()
    ]
    if profile.robot.driver == "ros2":
        found += _arm(ros2, profile.robot.command)
        found += [] if ros2.gripper is None else _gripper(ros2.gripper)
    if ros2.services is not None:
        found += _services(ros2.services)
    return tuple(dict.fromkeys(found))


def _arm(ros2: Ros2Profile, command: str) -> Iterator[Endpoint]:
    for topic in (ros2.joint_states, ros2.finger_states or ros2.joint_states):
        yield Endpoint(EntityRole.SUBSCRIBER, topic, JOINT_STATE)
    if ros2.wrench is not None:
        yield Endpoint(EntityRole.SUBSCRIBER, ros2.wrench.topic, WRENCH)
    output = ros2.joint_command if command == "joint" else ros2.pose_command
    if output is not None:
        yield Endpoint(EntityRole.PUBLISHER, output.topic, output.type)


def _gripper(gripper: Ros2Gripper) -> Iterator[Endpoint]:
    if gripper.type not in GRIPPER_ACTIONS:
        yield Endpoint(EntityRole.PUBLISHER, gripper.topic, gripper.type)
        return
    yield Endpoint(EntityRole.ACTION_CLIENT, gripper.topic, gripper.type)
    if gripper.grasp is not None:
        yield Endpoint(EntityRole.ACTION_CLIENT, gripper.grasp, GRASP)


def _services(prefix: str) -> Iterator[Endpoint]:
    for service in SERVICES:
        yield Endpoint(EntityRole.SERVER, f"{prefix}/{service.name}", service.type)
    yield Endpoint(EntityRole.SUBSCRIBER, f"{prefix}/{PROMPT_TOPIC}", TEXT)
    yield Endpoint(EntityRole.PUBLISHER, f"{prefix}/{STATUS_TOPIC}", diagnostics.TYPE)
