"""What the node ``ros2`` announces to bridges is what the bridge's list is made of, end by end."""

from __future__ import annotations

from pathlib import Path

import pytest
from camera_rig import until
from ros2_rig import write_profile
from vla_zenoh_ros2.bridge_config import endpoints
from vla_zenoh_ros2.driver import Ros2Driver

from vla_zenoh.bus.session import open_session
from vla_zenoh.profile import load_profile
from vla_zenoh.robots.node import RobotNode

SLASH = "§"
PLAIN = ""
EVERYTHING = """\
  finger_states: /fingers
  wrench: {topic: /wrench}
  gripper: {grasp: /panda_gripper/grasp}
"""
NO_PEOPLE = """\
  gripper: {topic: /width, type: std_msgs/msg/Float64, position: width}
  services: false
"""


@pytest.mark.parametrize("more", [PLAIN, EVERYTHING, NO_PEOPLE], ids=["plain", "every", "none"])
def test_the_node_announces_the_ends_that_its_profile_uses_and_no_others(
    tmp_path: Path, more: str
) -> None:
    profile = load_profile(str(write_profile(tmp_path, more=more)))
    wanted = {(end.role.value, end.name[1:], end.type) for end in endpoints(profile)}
    with (
        open_session(profile.session, mode="router"),
        open_session(profile.session) as ours,
        open_session(profile.session) as watcher,
    ):
        node = RobotNode(Ros2Driver(profile), ours)
        expression = f"@/{ours.zid()}/@ros2_lv/*/**"

        def announced() -> set[tuple[str, ...]]:
            replies = watcher.liveliness().get(expression)
            keys = [str(reply.ok.key_expr) for reply in replies if reply.ok is not None]
            return {tuple(part.replace(SLASH, "/") for part in key.split("/")[3:6]) for key in keys}

        until("every end is announced", lambda: announced() >= wanted)
        assert announced() == wanted
        node.driver.close()
        node.node.close()
