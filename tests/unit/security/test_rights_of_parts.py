"""Rights of a robot of several parts: states and commands of every part, and no other keys."""

from __future__ import annotations

import pytest

from vla_zenoh.bus.session import covers
from vla_zenoh.keys import Keys
from vla_zenoh.profile import load_profile
from vla_zenoh.security.roles import Act, Identity, identities, rights

PAIR = load_profile("two_pandas_sim")


def of(node: str) -> Identity:
    return next(one for one in identities(PAIR) if one.node == node)


def may(identity: Identity, act: Act, key: str) -> bool:
    return any(
        right.act is act and covers(right.key, key)
        for right in rights(PAIR.keys_of_all_parts, identity)
    )


@pytest.mark.parametrize("part", PAIR.part_names)
def test_the_command_node_commands_every_part_and_the_robot_tells_its_states(part: str) -> None:
    keys = PAIR.keys.of_part(part)
    command, robot = of("command"), of("sim")
    assert may(command, Act.PUT, keys.command_joint)
    assert may(command, Act.SUBSCRIBE, keys.state_pose)
    assert may(robot, Act.PUT, keys.state_pose)
    assert may(robot, Act.SUBSCRIBE, keys.command_joint)
    assert not may(robot, Act.PUT, keys.command_joint)
    assert not may(command, Act.PUT, keys.state_pose)


def test_another_robot_is_none_of_theirs() -> None:
    assert not may(of("command"), Act.PUT, Keys("panda").command_joint)
