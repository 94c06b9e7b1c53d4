"""What `profile new --ros2` makes of the names in a ROS domain."""

from __future__ import annotations

import json
from dataclasses import replace

import pytest
from vla_zenoh_ros2.proposal import (
    DescribedArm,
    HeardImages,
    HeardJoints,
    Topic,
    arm_commands,
    camera_topics,
    command_guess,
    controller_states,
    gripper_commands,
    proposal,
)
from vla_zenoh_ros2.ros_names import RosDomain, domains_of_bridges, domains_of_rmw

FAST, CYCLONE = "010f78", "0110aa"
TRAJECTORY, NUMBERS = "trajectory_msgs/msg/JointTrajectory", "std_msgs/msg/Float64MultiArray"
POSE, NUMBER = "geometry_msgs/msg/PoseStamped", "std_msgs/msg/Float64"
IMAGE, COMPRESSED = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"
GRIPPER_COMMAND = "control_msgs/action/GripperCommand"
HASH = list(b"typehash=RIHS01_ab;")
ARM = DescribedArm(("j1", "j2"), ("finger",), {"max_width_m": 0.08})
HEARD = {"/joint_states": HeardJoints(100.0, {"j1": 0.1, "j2": -0.2, "finger": 0.0}, 0.0)}
JOINTS_TO = Topic("/arm/joint_trajectory", TRAJECTORY)


def entity(vendor: str, side: str, topic: str, kind: str) -> tuple[str, bytes]:
    said = {"type_name": kind, "qos": {"user_data": HASH}}
    return f"@/b/ros2/dds/{vendor}/{side}/1/{topic}", json.dumps(said).encode()


def test_names_are_those_of_a_bridges_writers_and_readers() -> None:
    (domain,) = domains_of_bridges(
        [
            ("@/b/ros2/config", b'{"domain": 7}'),
            entity(FAST, "writer", "rt/left/joint_states", "sensor_msgs::msg::dds_::JointState_"),
            entity(FAST, "reader", "rt/commands", "std_msgs::msg::dds_::Float64MultiArray_"),
            entity(
                FAST,
                "reader",
                "rq/hand/_action/send_goalRequest",
                "control_msgs::action::dds_::GripperCommand_SendGoal_Request_",
            ),
            entity(
                CYCLONE,
                "reader",
                "rq/rsp/get_parametersRequest",
                "rcl_interfaces::srv::dds_::GetParameters_Request_",
            ),
            entity(FAST, "reader", "ros_discovery_info", "rmw_dds_common::msg::dds_::Info_"),
            ("@/b/ros2/dds/010f/writer/1/rt/broken", b"no JSON"),
            ("@/b/ros2/dds/010f/writer/1/rt/other", b'{"type_name": "made::up"}'),
        ]
    )
    assert (domain.bridge, domain.number, domain.distribution) == ("ros2dds", 7, "jazzy")
    assert domain.published == {"/left/joint_states": "sensor_msgs/msg/JointState"}
    assert domain.subscribed == {"/commands": NUMBERS}
    assert domain.actions == {"/hand": GRIPPER_COMMAND}
    assert domain.services == {"/rsp/get_parameters": "rcl_interfaces/srv/GetParameters"}
    assert domain.unreached == {"/hand": "Fast DDS"}


def test_names_are_those_of_the_tokens_of_rmw_zenoh_without_our_own() -> None:
    def token(node: str, role: str, name: str, kind: str) -> str:
        return f"@ros2_lv/3/ab/0/1/{role}/%/%/{node}/{name}/{kind}/TypeHashNotSupported/::,1:,:,:,,"

    (domain,) = domains_of_rmw(
        [
            token("arm", "MP", "%joint_states", "sensor_msgs::msg::dds_::JointState_"),
            token("arm", "MS", "%go%commands", "std_msgs::msg::dds_::Float64MultiArray_"),
            token("vla_panda", "MP", "%go%commands", "std_msgs::msg::dds_::Float64MultiArray_"),
            "@ros2_lv/3/ab/0/0/NN/%/%/arm",
            "@ros2_lv/x/ab/0/1/MP/%/%/arm/%a/std_msgs::msg::dds_::String_/h/q",
        ]
    )
    assert (domain.bridge, domain.number, domain.distribution) == ("rmw_zenoh", 3, "humble")
    assert domain.published == {"/joint_states": "sensor_msgs/msg/JointState"}
    assert domain.subscribed == {"/go/commands": NUMBERS}


def test_a_trajectory_comes_before_plain_numbers_and_a_gripper_is_no_arm() -> None:
    domain = RosDomain("ros2dds", 0)
    domain.subscribed |= {
        "/forward_position_controller/commands": NUMBERS,
        "/forward_velocity_controller/commands": NUMBERS,
        "/arm_controller/joint_trajectory": TRAJECTORY,
        "/gripper_controller/joint_trajectory": TRAJECTORY,
        "/goal_pose": POSE,
        "/target_frame": POSE,
    }
    assert [each.name for each in arm_commands(domain, "")] == [
        "/arm_controller/joint_trajectory",
        "/forward_position_controller/commands",
        "/target_frame",
    ]
    assert [each.name for each in gripper_commands(domain, "")] == [
        "/gripper_controller/joint_trajectory"
    ]


def test_an_active_controller_of_the_arms_joints_comes_first_and_is_no_guess() -> None:
    domain = RosDomain("ros2dds", 0)
    names = ("/arm_a", "/arm_bb", "/arm_ccc", "/arm_dddd")
    domain.subscribed |= {f"{name}/joint_trajectory": TRAJECTORY for name in names}
    domain.published |= {
        f"{name}/controller_state": "control_msgs/msg/JointTrajectoryControllerState"
        for name in names[:3]
    }
    states = controller_states(domain, "")
    assert [*states.values()] == [f"{name}/controller_state" for name in names[:3]]
    controllers = dict(zip(states, [(), ("other",), ("j2", "j1")], strict=True))
    found = arm_commands(domain, "", ARM.joints, controllers)
    assert [each.name.split("/")[1] for each in found] == ["arm_ccc", "arm_dddd", "arm_a", "arm_bb"]
    said = [command_guess(each, (), ARM, controllers.get(each.name))[1] for each in found]
    assert said[0] == ""
    assert "is not known" in said[1]
    assert "is not active" in said[2]
    assert "its controller moves other" in said[3]


def test_a_namespace_leaves_out_another_robot() -> None:
    domain = RosDomain("ros2dds", 0)
    domain.subscribed |= {"/left/commands": NUMBERS, "/right/commands": NUMBERS}
    assert [each.name for each in arm_commands(domain, "/left")] == ["/left/commands"]


def test_cameras_are_colours_raw_where_there_are_both_and_named_by_their_topics() -> None:
    domain = RosDomain("ros2dds", 0)
    domain.published |= {
        "/camera/front/color/image_raw": IMAGE,
        "/camera/front/color/image_raw/compressed": COMPRESSED,
        "/camera/front/depth/image_rect_raw": IMAGE,
        "/image": IMAGE,
        "/other/front/image": IMAGE,
        "/wrist/image_raw/compressed": COMPRESSED,
    }
    assert {name: topic.name for name, topic in camera_topics(domain, "").items()} == {
        "front": "/camera/front/color/image_raw",
        "camera": "/image",
        "front_2": "/other/front/image",
        "wrist": "/wrist/image_raw/compressed",
    }


@pytest.mark.parametrize(
    ("name", "kind", "gripper", "position"),
    [
        ("/gripper/width", NUMBER, {"max_width_m": 0.08}, "width"),
        ("/gripper_controller/commands", NUMBERS, {"max_width_m": 0.08}, "finger"),
        ("/gripper/cmd", NUMBER, {"max_width_m": 0.1, "joint_open_rad": 0.0}, None),
    ],
)
def test_what_a_grippers_number_means_is_a_guess(
    name: str, kind: str, gripper: dict[str, float], position: str | None
) -> None:
    domain = RosDomain("ros2dds", 0)
    domain.subscribed[name] = kind
    arm = ARM._replace(gripper=gripper)
    made = proposal(domain, "", arm, JOINTS_TO, HEARD, {})
    assert made.section["gripper"].get("position") == position
    assert [place for place, _ in made.guesses] == ["ros2.gripper"]


def test_an_action_that_the_bridge_carries_no_goal_to_is_named_and_not_used() -> None:
    domain = RosDomain("ros2dds", 0)
    domain.actions["/gripper_controller/gripper_cmd"] = GRIPPER_COMMAND
    reached = proposal(domain, "", ARM, JOINTS_TO, HEARD, {})
    assert reached.section["gripper"]["topic"] == "/gripper_controller/gripper_cmd"
    deaf = replace(domain, unreached={"/gripper_controller/gripper_cmd": "Fast DDS"})
    made = proposal(deaf, "", ARM, JOINTS_TO, HEARD, {})
    assert "gripper" not in made.section
    assert "no goal to /gripper_controller/gripper_cmd (Fast DDS)" in " ".join(made.notes)


def test_joints_are_read_where_they_are_published_and_missing_ones_are_unconfirmed() -> None:
    domain = RosDomain("ros2dds", 0)
    apart = {
        "/joint_states": HeardJoints(10.0, {"finger": 0.0}, 0.0),
        "/arm/joint_states": HeardJoints(10.0, {"j1": 0.1, "other": 1.0}, 1e9),
    }
    made = proposal(domain, "/arm", ARM, JOINTS_TO, apart, {})
    assert made.section["joint_states"] == "/arm/joint_states"
    assert made.section["finger_states"] == "/joint_states"
    assert made.section["use_sim_time"] is True
    assert made.section["prefix"] == "/arm/vla"
    guesses = dict(made.guesses)
    assert {*guesses} == {"ros2.joint_states", "ros2.use_sim_time"}
    assert "nothing was heard of j2, but of other" in guesses["ros2.joint_states"]
    assert "timing.state_timeout_s to 0.30" in " ".join(made.notes)
    whole = proposal(domain, "", ARM, JOINTS_TO, HEARD, {})
    assert "/joint_states, 100 Hz: j1 0.100, j2 -0.200, finger 0.000" in whole.notes


def test_a_camera_has_the_size_of_its_images_or_is_unconfirmed() -> None:
    domain = RosDomain("ros2dds", 0)
    domain.published |= {"/front/image_raw": IMAGE, "/wrist/image_raw": IMAGE}
    heard = {"/front/image_raw": HeardImages(320, 240, 29.0)}
    made = proposal(domain, "", ARM, JOINTS_TO, HEARD, heard)
    assert made.cameras["front"] == {"source": "ros2:/front/image_raw", "width": 320, "height": 240}
    assert made.cameras["wrist"] == {"source": "ros2:/wrist/image_raw"}
    assert [place for place, _ in made.guesses] == ["cameras.wrist"]
