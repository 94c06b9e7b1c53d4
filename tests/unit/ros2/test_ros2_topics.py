"""What ROS 2 messages say to us, and how our commands are written."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import pytest
from vla_zenoh_ros2 import readers
from vla_zenoh_ros2.messages import Messages
from vla_zenoh_ros2.readers import GripperOutcome, RosImage, outcome
from vla_zenoh_ros2.writers import (
    DIAGNOSTICS,
    GRASP,
    GRIPPER_COMMAND,
    MOVE,
    PARALLEL_COMMAND,
    Stamp,
    Write,
    diagnostics,
    joint_writer,
    pose_writer,
    position,
    position_message,
    send_goal,
)

from vla_zenoh.errors import CodecError, ProfileError
from vla_zenoh.profile import GripperProfile
from vla_zenoh.profile.robot import Ros2Gripper
from vla_zenoh.types import GripperCommand, JointCommand, NodeStatus, PoseCommand

M = Messages(
    "jazzy",
    {
        "lab_msgs/msg/Target": "std_msgs/Header header\nuint8 mode\ngeometry_msgs/PoseStamped at\n"
        "geometry_msgs/Twist feed\nfloat64[6] stiffness\n",
        "lab_msgs/msg/Nothing": "float64 x\n",
    },
)
STAMP = Stamp(1_700_000_000_123_456_789, "panda_link0")
JPEG_TOLERANCE = 12
POSTURE_RAD = np.arange(7) / 10
NAMES = tuple(f"j{index}" for index in range(7))


def header(stamp_ns: int = 5_000_000_007, frame: str = "cam") -> Any:
    stamp = M.new("builtin_interfaces/msg/Time", sec=stamp_ns // 10**9, nanosec=stamp_ns % 10**9)
    return M.new("std_msgs/msg/Header", stamp=stamp, frame_id=frame)


def read(message: Any) -> Any:
    return readers.read(M, message.__msgtype__, M.encode(message))


def refused(message: Any) -> str:
    with pytest.raises(CodecError) as caught:
        read(message)
    return caught.value.reason


# -- pictures -------------------------------------------------------------------------------------
RGB = np.random.default_rng(3).integers(0, 255, (4, 5, 3), np.uint8)


def image(encoding: str, pixels: Any, step: int | None = None) -> Any:
    height, width = pixels.shape[:2]
    row = pixels.reshape(height, -1)
    step = step or row.shape[1]
    data = np.zeros((height, step), np.uint8)
    data[:, : row.shape[1]] = row
    return M.new(
        "sensor_msgs/msg/Image",
        header=header(),
        height=height,
        width=width,
        encoding=encoding,
        step=step,
        data=data.ravel(),
    )


@pytest.mark.parametrize("step", [None, 32])
def test_an_rgb_or_bgr_image_becomes_rgb_with_its_stamp(step: int | None) -> None:
    for message in (image("rgb8", RGB, step), image("bgr8", RGB[..., ::-1], step)):
        picture: RosImage = read(message)
        assert (picture.rgb == RGB).all()
        assert (picture.stamp_ns, picture.frame) == (5_000_000_007, "cam")


def test_a_grey_image_becomes_three_equal_channels() -> None:
    grey = RGB[..., 0]
    assert (read(image("mono8", grey)).rgb == grey[..., None]).all()


def test_padding_may_lack_behind_the_last_row() -> None:
    message = image("rgb8", RGB, 32)
    message.data = message.data[: 3 * 32 + 15]
    assert (read(message).rgb == RGB).all()


@pytest.mark.parametrize(
    ("fields", "reason"),
    [
        ({"encoding": "16UC1"}, "encoding"),
        ({"encoding": "nv24"}, "encoding"),
        ({"height": 0}, "invalid"),
        ({"width": 2**31}, "invalid"),
        ({"step": 14}, "invalid"),
        ({"height": 5}, "truncated"),
    ],
)
def test_an_image_that_cannot_be_shown_is_refused(fields: dict[str, Any], reason: str) -> None:
    message = image("rgb8", RGB)
    for name, value in fields.items():
        setattr(message, name, value)
    assert refused(message) == reason


def test_a_depth_image_is_told_apart() -> None:
    with pytest.raises(CodecError, match="it holds distances"):
        read(image("16UC1", RGB))


@pytest.mark.parametrize("suffix", [".jpg", ".png"])
def test_a_compressed_image_is_read_whatever_its_format_says(suffix: str) -> None:
    smooth = np.full((16, 16, 3), (200, 100, 50), np.uint8)
    data = cv2.imencode(suffix, smooth[..., ::-1])[1]
    for said in ("jpeg", "rgb8; jpeg compressed bgr8", ""):
        message = M.new(
            "sensor_msgs/msg/CompressedImage", header=header(), format=said, data=data.ravel()
        )
        apart = read(message).rgb.astype(int) - smooth
        assert np.abs(apart).max() <= JPEG_TOLERANCE


@pytest.mark.parametrize(
    ("said", "data", "reason"),
    [
        ("16UC1; compressedDepth png", b"\x89PNG\r\n\x1a\n", "encoding"),
        ("tiff", b"II*\0", "encoding"),
        ("png", b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR\xff\xff\xff\xff\xff\xff\xff\xff", "invalid"),
        ("png", b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR\0\0\0\x04\0\0\0\x04", "malformed"),
        ("jpeg", b"\xff\xd8\xff\xe0", "truncated"),
    ],
)
def test_a_compressed_image_that_is_none_is_refused(said: str, data: bytes, reason: str) -> None:
    payload = np.frombuffer(data, np.uint8)
    kind = "sensor_msgs/msg/CompressedImage"
    assert refused(M.new(kind, header=header(), format=said, data=payload)) == reason


# -- joints ---------------------------------------------------------------------------------------
def joints(**fields: Any) -> Any:
    given = {"name": ["a", "b"], "position": np.array([1.0, 2.0])} | fields
    return M.new("sensor_msgs/msg/JointState", header=header(), **given)


def test_joints_may_come_without_velocities_and_efforts() -> None:
    found = read(joints())
    assert found.names == ("a", "b")
    assert found.position.tolist() == [1.0, 2.0]
    assert found.velocity is None
    assert found.effort is None
    assert found.stamp_ns == 5_000_000_007


@pytest.mark.parametrize(
    "fields",
    [
        {"name": [], "position": np.zeros(0)},
        {"name": ["a", "a"]},
        {"position": np.zeros(0)},
        {"position": np.zeros(3)},
        {"velocity": np.zeros(1)},
    ],
)
def test_lists_of_joints_that_do_not_fit_are_refused(fields: dict[str, Any]) -> None:
    assert refused(joints(**fields)) == "invalid"


def test_a_stamp_that_is_no_time_is_refused() -> None:
    message = joints()
    message.header.stamp.sec = -1
    assert refused(message) == "invalid"
    message.header.stamp.sec, message.header.stamp.nanosec = 0, 10**9
    assert refused(message) == "invalid"


# -- commands -------------------------------------------------------------------------------------
POSE = PoseCommand(
    np.array([0.4, 0.1, 0.3]),
    np.array([1.0, 0.0, 0.0, 0.0]),
    np.arange(6) / 10,
    np.zeros(6),
    np.zeros(3),
    np.array([0.0, 0.0, 0.0, 1.0]),
    "active",
)
JOINTS = JointCommand(NAMES, np.arange(7) / 7, np.arange(7) / 70, np.zeros(7), "active")
WIDTH = GripperCommand(0.04, 0.1, 20.0)
ROBOTIQ = {"joint_open_rad": 0.0, "joint_shut_rad": 0.7929}


def written(kind: str, write: Write, command: Any) -> Any:
    return M.decode(kind, M.encode(write(command, STAMP)))


def pose_written(kind: str) -> Any:
    return written(kind, pose_writer(M, kind, POSTURE_RAD), POSE)


def joints_written(kind: str) -> Any:
    return written(kind, joint_writer(M, kind, 8_000_000), JOINTS)


def test_a_pose_is_written_with_stamp_and_frame() -> None:
    message = pose_written("geometry_msgs/msg/PoseStamped")
    assert message.header.frame_id == "panda_link0"
    assert (message.header.stamp.sec, message.header.stamp.nanosec) == (1_700_000_000, 123_456_789)
    at, turn = message.pose.position, message.pose.orientation
    assert (at.x, at.y, at.z) == (0.4, 0.1, 0.3)
    assert (turn.x, turn.y, turn.z, turn.w) == (1.0, 0.0, 0.0, 0.0)


def test_an_impedance_goal_carries_the_posture() -> None:
    kind = "multi_mode_control_msgs/msg/CartesianImpedanceGoal"
    message = pose_written(kind)
    assert message.pose.position.x == 0.4
    assert message.q_n.tolist() == POSTURE_RAD.tolist()


def test_a_type_of_ones_own_is_filled_by_what_its_fields_are() -> None:
    kind = "lab_msgs/msg/Target"
    message = pose_written(kind)
    assert message.header.frame_id == message.at.header.frame_id == "panda_link0"
    assert message.at.pose.position.z == 0.3
    assert message.feed.angular.z == 0.5
    assert message.stiffness.tolist() == [0.0] * 6
    assert message.mode == 0


def test_a_type_without_a_pose_is_told() -> None:
    with pytest.raises(ProfileError, match="no field of type geometry_msgs/msg/Pose"):
        pose_writer(M, "lab_msgs/msg/Nothing", POSTURE_RAD)
    with pytest.raises(ProfileError, match=r"did you mean .*Target"):
        pose_writer(M, "lab_msgs/msg/Targets", POSTURE_RAD)


def test_joints_are_written_as_a_trajectory_of_one_point_from_now_on() -> None:
    message = joints_written("trajectory_msgs/msg/JointTrajectory")
    (point,) = message.points
    assert tuple(message.joint_names) == NAMES
    assert point.positions.tolist() == JOINTS.position_rad.tolist()
    assert point.velocities.tolist() == JOINTS.velocity_rad_s.tolist()
    assert (point.time_from_start.sec, point.time_from_start.nanosec) == (0, 8_000_000)
    assert (message.header.stamp.sec, message.header.stamp.nanosec) == (0, 0)


def test_joints_are_written_as_plain_numbers() -> None:
    message = joints_written("std_msgs/msg/Float64MultiArray")
    assert message.data.tolist() == JOINTS.position_rad.tolist()


def test_openings_are_written_as_plain_numbers() -> None:
    command = GripperCommand(0.08, 0.1, 20.0)

    def sent(kind: str) -> Any:
        return position_message(M, kind, command, {"left": 0.04, "right": -0.04}, 0.04, 0.5)

    assert sent("std_msgs/msg/Float64").data == 0.04
    by_force = sent("control_msgs/msg/GripperCommand")
    assert (by_force.position, by_force.max_effort) == (0.04, 20.0)
    trajectory = sent("trajectory_msgs/msg/JointTrajectory")
    assert trajectory.joint_names == ["left", "right"]
    assert trajectory.points[0].positions.tolist() == [0.04, -0.04]
    assert trajectory.points[0].time_from_start.nanosec == 500_000_000
    assert trajectory.header.stamp.sec == 0, "from now on"
    array = sent("std_msgs/msg/Float64MultiArray")
    assert array.data.tolist() == [0.04]


# -- gripper actions ------------------------------------------------------------------------------
def goal(action: str, position: float = 0.0) -> Any:
    identity = bytes(range(16))
    request = send_goal(M, action, identity, WIDTH, position=position, max_width_m=0.08)
    request = M.decode(request.__msgtype__, M.encode(request))
    assert bytes(request.goal_id.uuid) == identity
    return request.goal


def test_a_goal_says_width_speed_and_force() -> None:
    assert (goal(MOVE).width, goal(MOVE).speed) == (0.04, 0.1)
    grasp = goal(GRASP)
    assert (grasp.width, grasp.speed, grasp.force) == (0.04, 0.1, 20.0)
    assert (grasp.epsilon.inner, grasp.epsilon.outer) == (0.08, 0.08)
    command = goal(GRIPPER_COMMAND, position=-0.3).command
    assert (command.position, command.max_effort) == (-0.3, 20.0)
    command = goal(PARALLEL_COMMAND, position=-0.3).command
    assert (command.position.tolist(), command.effort.tolist()) == ([-0.3], [20.0])
    assert not command.velocity.size


@pytest.mark.parametrize(
    ("means", "ends", "at_m", "expected"),
    [
        ("width", {}, 0.04, 0.04),
        ("finger", {}, 0.04, 0.02),
        (None, ROBOTIQ, 0.085, 0.0),
        (None, ROBOTIQ, 0.0, 0.7929),
        ("joint", ROBOTIQ, 0.0425, 0.39645),
        ("width", ROBOTIQ, 0.0425, 0.0425),
        ("finger", ROBOTIQ, 0.0425, 0.02125),
        (None, {"joint_open_m": -0.02, "joint_shut_m": 0.02}, 0.085, -0.02),
        (None, {"joint_open_m": -0.02, "joint_shut_m": 0.02}, 0.0, 0.02),
    ],
)
def test_an_opening_is_sent_as_the_driver_takes_it(
    means: Any, ends: dict[str, float], at_m: float, expected: float
) -> None:
    ros2 = Ros2Gripper(topic="/gripper", type=GRIPPER_COMMAND, position=means)
    gripper = GripperProfile(max_width_m=0.085, **ends)
    assert position(ros2, gripper, at_m) == pytest.approx(expected)


@pytest.mark.parametrize(
    ("action", "status", "fields", "expected"),
    [
        (MOVE, 4, {"success": True}, GripperOutcome(True, False, "")),
        (MOVE, 4, {"success": False, "error": "no"}, GripperOutcome(False, False, "no")),
        (MOVE, 6, {"success": True}, GripperOutcome(False, False, "")),
        (GRASP, 4, {"success": True}, GripperOutcome(True, True, "")),
        (GRASP, 5, {"success": True}, GripperOutcome(False, False, "")),
        (GRIPPER_COMMAND, 4, {"reached_goal": True}, GripperOutcome(True, False, "")),
        (GRIPPER_COMMAND, 4, {"stalled": True}, GripperOutcome(False, True, "")),
        (PARALLEL_COMMAND, 4, {"reached_goal": True}, GripperOutcome(True, False, "")),
        (PARALLEL_COMMAND, 6, {"stalled": True}, GripperOutcome(False, True, "")),
    ],
)
def test_a_result_tells_what_became_of_the_goal(
    action: str, status: int, fields: dict[str, Any], expected: GripperOutcome
) -> None:
    result = M.new(f"{action}_Result", **fields)
    response = M.new(f"{action}_GetResult_Response", status=status, result=result)
    assert outcome(action, response) == expected


# -- diagnostics ----------------------------------------------------------------------------------
@pytest.mark.parametrize(
    ("state", "alive", "level"),
    [("active", True, 0), ("stopped", True, 1), ("fault", True, 2), ("active", False, 3)],
)
def test_a_nodes_status_becomes_a_diagnostic(state: str, alive: bool, level: int) -> None:
    status = NodeStatus(
        "command",
        state,
        "pc",
        1,
        0,
        rates_hz={"loop": 250.0},
        latency_ms={"end": (1.0, 2.0)},
        counters={"refused.stale": 3, "nothing": 0},
        detail={"why": "because", "deep": {"a": 1}},
    )
    message = diagnostics(M, "panda", {"command": (status, 0.1, alive)}, STAMP)
    (entry,) = M.decode(DIAGNOSTICS, M.encode(message)).status
    assert entry.level == level
    assert entry.name == "vla-zenoh/panda: command"
    assert entry.message == f"{state}: because"
    values = {pair.key: pair.value for pair in entry.values}
    assert values["loop_hz"] == "250.0"
    assert values["refused.stale"] == "3"
    assert values["end_ms"] == "p50 1.0, p95 2.0"
    assert "nothing" not in values
    assert "deep" not in values
