"""ROS types that are read and written. A new type is one file in ``topics`` and one line here."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

from vla_zenoh.errors import CodecError
from vla_zenoh.interop.ros2.messages import MAX_MESSAGE_BYTES, MAX_PICTURE_BYTES, Messages
from vla_zenoh.interop.ros2.samples import Joints, RosImage, Stamp, Transform, Wrench
from vla_zenoh.interop.ros2.topics import (
    compressed_image,
    image,
    joint_state,
    joint_trajectory,
    plain,
    pose,
    transforms,
    wrench,
)
from vla_zenoh.types import FloatArray, JointCommand, PoseCommand

Write = Callable[[Messages, str, Any, Stamp], Any]


class RosReading(NamedTuple):
    """A type we listen to.

    Args:
        type: ROS type.
        keys: which of our keys it feeds, as `vla_zenoh.keys.Keys` calls them.
        sample: what it becomes.
        read: message -> that.
        limit: bytes that are read at most.
    """

    type: str
    keys: tuple[str, ...]
    sample: Any
    read: Callable[[Any], Any]
    limit: int = MAX_MESSAGE_BYTES


class Writing(NamedTuple):
    """A type we send.

    Args:
        type: ROS type.
        key: which of our keys it carries on.
        record: what it is made of: what comes on that key, or of a gripper the number it takes.
        write: makes a message of that.
    """

    type: str
    key: str
    record: type
    write: Write


_STATE = ("state_joint", "state_pose", "state_gripper")
_CAMERA = ("camera_raw", "camera_jpeg")

READINGS = (
    RosReading(joint_state.TYPE, _STATE, Joints, joint_state.read),
    RosReading(transforms.TYPE, ("state_pose",), Transform, transforms.read),
    RosReading(wrench.TYPE, ("state_pose",), Wrench, wrench.read),
    RosReading(image.TYPE, _CAMERA, RosImage, image.read, MAX_PICTURE_BYTES),
    RosReading(compressed_image.TYPE, _CAMERA, RosImage, compressed_image.read, MAX_PICTURE_BYTES),
    RosReading(plain.TEXT, ("prompt",), str, plain.read),
)


GRIPPER_WRITINGS = (
    Writing(plain.NUMBERS, "command_gripper", float, plain.write_position),
    Writing(plain.NUMBER, "command_gripper", float, plain.write_position),
)


def writings(posture_rad: FloatArray, lead_ns: int) -> tuple[Writing, ...]:
    """Types in which commands can be sent.

    Args:
        posture_rad: (n,) what a nullspace prefers.
        lead_ns: how far ahead a trajectory's point lies.
    """
    joints = joint_trajectory.writer(lead_ns)
    poses = pose.writer(posture_rad)
    return (
        Writing(pose.STAMPED, "command_pose", PoseCommand, poses),
        Writing(
            "multi_mode_control_msgs/msg/CartesianImpedanceGoal",
            "command_pose",
            PoseCommand,
            poses,
        ),
        Writing(joint_trajectory.TYPE, "command_joint", JointCommand, joints),
        Writing(plain.NUMBERS, "command_joint", JointCommand, plain.write_joints),
        *GRIPPER_WRITINGS,
    )


_BY_TYPE = {reading.type: reading for reading in READINGS}


def read(messages: Messages, kind: str, payload: bytes) -> Any:
    """Decode CDR bytes of a type in `READINGS`.

    Raises:
        CodecError: whatever else the bytes are.
    """
    reading = _BY_TYPE[kind]
    message = messages.decode(kind, payload, reading.limit)
    try:
        return reading.read(message)
    except (ValueError, OverflowError) as error:
        if isinstance(error, CodecError):
            raise
        raise CodecError("malformed", f"{kind}: {str(error)[:200]}") from error
