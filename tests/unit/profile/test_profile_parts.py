"""A robot of parts: a profile for each, with keys of its own, and what all have in common."""

from __future__ import annotations

import re
from typing import Any

import pytest

from vla_zenoh.errors import ProfileError
from vla_zenoh.keys import Keys
from vla_zenoh.profile import load_profile, override, read_profile, to_yaml

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


def test_one_part_alone_is_no_robot_of_parts() -> None:
    data = PAIR.model_dump()
    del data["parts"]["right"]
    with pytest.raises(ProfileError, match="names one part"):
        override(load_profile("panda_sim"), {"robot": {"command": "joint"}, "parts": data["parts"]})


def test_a_part_may_not_be_named_so_that_it_is_no_key() -> None:
    with pytest.raises(ProfileError, match="part name 'a/b'"):
        Keys("pair", part="a/b")
