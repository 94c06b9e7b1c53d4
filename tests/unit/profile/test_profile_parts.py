"""A robot of parts: a profile for each, with keys of its own, and what all have in common."""

from __future__ import annotations

import re
from typing import Any

import pytest
from vla_zenoh_ros2.bridge_config import endpoints

from vla_zenoh.errors import ProfileError
from vla_zenoh.keys import Keys
from vla_zenoh.profile import Profile, load_profile, override, read_profile, to_yaml

PAIR = load_profile("two_pandas_sim")


def test_a_robot_of_one_part_has_its_keys_as_ever_and_one_part_without_a_name() -> None:
    one = load_profile("panda_sim")
    assert one.part_names == ("",)
    assert one.of_part("") is one
    assert one.keys.state_pose == "vla/panda/state/pose"
    assert "parts" not in to_yaml(one) or one.parts == {}


def test_states_and_commands_are_keys_of_a_part_and_everything_else_is_of_the_robot() -> None:
    left = PAIR.of_part("left").keys
    assert left.state_joint == "vla/pair/left/state/joint"
    assert left.command_gripper == "vla/pair/left/command/gripper"
    for name in ("task", "prompt", "stop", "active", "sim_objects"):
        assert getattr(left, name) == getattr(PAIR.keys, name)
    assert left.delta("x") == "vla/pair/delta/x"
    assert PAIR.keys.of_part("*").state_pose == "vla/pair/*/state/pose"


def test_a_part_has_what_the_profile_says_where_its_own_sections_say_nothing() -> None:
    changed = override(
        PAIR,
        {
            "limits": {"step_m": 0.03},
            "parts": {"left": {"limits": {"workspace": {"x_m": [0.3, 0.6]}}}},
        },
    )
    left, right = changed.of_part("left"), changed.of_part("right")
    assert left.limits.workspace.x_m == (0.3, 0.6)
    assert right.limits.workspace == PAIR.limits.workspace
    assert left.limits.step_m == right.limits.step_m == 0.03
    assert (left.part, left.parts) == ("left", {})
    assert read_profile(to_yaml(changed), "text").of_part("left").limits == left.limits


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"parts": {"state": {}}}, "parts.state: is taken by keys"),
        ({"parts": {"left": {"robot": {"name": "x"}}}}, "parts.left.robot.name: is that of the"),
        ({"parts": {"left": {"robot": {"home_rad": [0.0]}}}}, "home_rad has 1 angles for 7"),
        ({"parts": {"left": {"limits": {"stepm": 1}}}}, "parts.left.limits.stepm"),
        ({"robot": {"command": "pose"}}, "robot.command: must be joint: the robot has parts"),
        ({"limits": {"reach": {"part_stop_m": 0.5}}}, "must not be above part_slow_m"),
    ],
)
def test_what_cannot_be_a_part_is_told_by_its_place(change: dict[str, Any], said: str) -> None:
    with pytest.raises(ProfileError, match=re.escape(said)):
        override(PAIR, change)


NUMBERS = "std_msgs/msg/Float64MultiArray"


def ros2_pair(left: dict[str, Any], right: dict[str, Any]) -> Profile:
    """Two arms of one ROS 2 robot: what the sections ros2 of its parts say."""
    own = {"left": {"ros2": left}, "right": {"ros2": right, "base": {"position_m": [1.0, 0, 0]}}}
    robot = {"name": "pair", "command": "joint"}
    changes = {
        "robot": robot,
        "parts": own,
        "ros2": {"joint_command": {"topic": "/both", "type": NUMBERS}},
    }
    return override(load_profile("panda_ros2"), changes)


def topics_of(space: str) -> dict[str, Any]:
    """Topics of an arm below its namespace."""
    return {
        "joint_states": f"{space}/joint_states",
        "joint_command": {"topic": f"{space}/commands"},
        "gripper": {"topic": f"{space}/width", "type": "std_msgs/msg/Float64", "position": "width"},
    }


def test_the_parts_of_a_ros_2_robot_have_topics_of_their_own() -> None:
    pair = ros2_pair(topics_of("/left"), topics_of("/right"))
    for name in ("left", "right"):
        ros2 = pair.of_part(name).ros2
        assert ros2 is not None
        assert ros2.joint_command is not None
        assert (ros2.joint_states, ros2.joint_command.topic, ros2.joint_command.type) == (
            f"/{name}/joint_states",
            f"/{name}/commands",
            NUMBERS,
        )
    names = {(end.role.value, end.name) for end in endpoints(pair)}
    assert {("MS", "/left/joint_states"), ("MP", "/right/commands"), ("MP", "/left/width")} < names
    assert ("MP", "/both") not in names


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"joint_command": {"topic": "/left/commands"}}, "both would follow one command"),
        ({"gripper": {"topic": "/left/width"}}, "both would follow one command"),
        ({"joint_states": "/left/joint_states"}, "both arms have joints panda_joint1"),
        ({"domain": 3}, "parts.right.ros2.domain: is that of the whole robot"),
        ({"joint_command": None}, "parts.right.ros2: lacks joint_command"),
        ({"joint_states": "no topic"}, "is not a ROS topic"),
    ],
)
def test_two_arms_of_ros_2_that_share_what_moves_them_are_rejected(
    change: dict[str, Any], said: str
) -> None:
    right = topics_of("/right")
    for field, value in change.items():
        right[field] = {**right[field], **value} if isinstance(value, dict) else value
    with pytest.raises(ProfileError, match=re.escape(said)):
        ros2_pair(topics_of("/left"), right)


def test_one_part_alone_is_no_robot_of_parts() -> None:
    data = PAIR.model_dump()
    del data["parts"]["right"]
    with pytest.raises(ProfileError, match="names one part"):
        override(load_profile("panda_sim"), {"robot": {"command": "joint"}, "parts": data["parts"]})


def test_a_part_may_not_be_named_so_that_it_is_no_key() -> None:
    with pytest.raises(ProfileError, match="part name 'a/b'"):
        Keys("pair", part="a/b")
