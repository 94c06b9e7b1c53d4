"""Type hashes of ROS 2's own packages, which are part of names on the wire, against ours."""

from __future__ import annotations

import json

import pytest
from vla_zenoh_ros2.messages import Messages

pytest.importorskip("ros_messages", exc_type=ImportError)

from rclpy_rig import ros_python

pytestmark = pytest.mark.rclpy

AT_LEAST = 120
USED = (
    "sensor_msgs/msg/JointState",
    "sensor_msgs/msg/Image",
    "sensor_msgs/msg/CompressedImage",
    "geometry_msgs/msg/PoseStamped",
    "geometry_msgs/msg/WrenchStamped",
    "trajectory_msgs/msg/JointTrajectory",
    "multi_mode_control_msgs/msg/CartesianImpedanceGoal",
    "diagnostic_msgs/msg/DiagnosticArray",
    "rcl_interfaces/msg/Log",
    "std_msgs/msg/Float64",
    "std_msgs/msg/String",
    "std_srvs/srv/SetBool",
    "std_srvs/srv/Trigger",
)


def test_type_hashes_are_those_of_the_packages_of_ros(distribution: str) -> None:
    messages, compared = Messages(distribution), set()
    for path in (ros_python(distribution).parents[1] / "share").glob("*/*/*.json"):
        kind = "/".join(path.with_suffix("").parts[-3:])
        described = json.loads(path.read_text())
        if path.parent.name not in ("msg", "srv") or "type_hashes" not in described:
            continue
        theirs = {one["type_name"]: one["hash_string"] for one in described["type_hashes"]}
        try:
            ours = messages.hash(kind)
        except KeyError:  # a package that we have no use for
            assert kind not in USED
            continue
        assert ours == theirs[kind], kind
        compared.add(kind)
    assert compared >= set(USED)
    assert len(compared) >= AT_LEAST
