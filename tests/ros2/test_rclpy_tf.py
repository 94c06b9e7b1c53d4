"""Frames and depth as a ROS user sees them: /tf and /tf_static both ways, depth of both cameras."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import panda_dh
import pytest
import zenoh
from camera_rig import until
from chain import LONG_PATIENCE_S

pytest.importorskip("ros_messages", exc_type=ImportError)

from rclpy_rig import (
    DEPTH_UNIT_M,
    HEIGHT,
    WIDTH,
    RosLab,
    depth_counts,
    heard,
    publish,
    running_ros_lab,
)
from vla_zenoh_ros2.messages import Messages
from vla_zenoh_ros2.transforms import TF_MESSAGE, Edge, FrameTree, read_transforms, tf_message

from vla_zenoh.codec.image import decode_depth

pytestmark = pytest.mark.rclpy

ROBOT_PATIENCE_S = LONG_PATIENCE_S
EXACT_M = 1e-6
BASE, TCP, CAMERA = "panda_link0", "panda_hand_tcp", "front_color_optical_frame"
LINKS = [f"panda_link{index}" for index in range(1, 9)]
LATE = {"transient_local": True, "depth": 1}
MOUNT = """\
    mount: {frame: front_color_optical_frame, link: panda_link0, position_m: [0.1, 0, 0],
      rpy_rad: [0, 0, 0]}
"""


@pytest.fixture(scope="module")
def tf_lab(
    tmp_path_factory: pytest.TempPathFactory, built_bridge: Path, distribution: str
) -> Iterator[RosLab]:
    """A robot that publishes its TCP and a camera, and no link, and our node with ros2.tf."""
    with running_ros_lab(
        tmp_path_factory.mktemp("tf"),
        built_bridge,
        distribution,
        more="  tf: true\n",
        mount=MOUNT,
        depth=True,
        patience_s=LONG_PATIENCE_S,
    ) as lab:
        lab.chain.activate_when_ready()
        lab.person.ask("hear", "hears", topic="/tf", type=TF_MESSAGE)
        lab.person.ask("hear", "hears", topic="/tf_static", type=TF_MESSAGE, qos_of=LATE)
        yield lab


def transforms(lab: RosLab, topic: str, wanted: Callable[[dict[str, Any]], bool]) -> dict[str, Any]:
    """The newest transform of ours that is wanted, as rclpy received it."""

    def newest() -> dict[str, Any] | None:
        for line in reversed(heard(lab.person, topic)):
            for each in line["value"]["transforms"]:
                if wanted(each):
                    return each
        return None

    return until(f"a transform on {topic}", newest, 20.0)


def test_rclpy_sees_the_links_and_the_set_point_where_the_robots_joints_are(
    tf_lab: RosLab,
) -> None:
    """tf2's rules: composed upwards from the last link they give the pose of the forward map."""
    lab, person = tf_lab, tf_lab.person
    lab.settle()
    detail = lab.chain.until("links", lambda: LINKS[0] in tf(lab)["published"] and tf(lab))
    assert {*LINKS, "panda_hand"} <= set(detail["published"])
    lab.arm.wait_still()
    transforms(lab, "/tf_static", lambda each: each["child_frame_id"] == "panda_hand")
    before = len(person.told)
    transforms(lab, "/tf", lambda each: each["child_frame_id"] == LINKS[0])
    until("all of them", lambda: len(heard(person, "/tf", before)) > 30)
    frames = received(lab, before)
    at = frames.pose("panda_hand", BASE)
    hand = panda_dh.forward(lab.arm.joints_rad())
    hand[:3, 3] -= hand[:3, 2] * panda_dh.TCP_M
    assert at == pytest.approx(hand, abs=EXACT_M)


def test_a_frame_that_the_robot_publishes_is_not_published_and_is_named(tf_lab: RosLab) -> None:
    lab = tf_lab
    refused = lab.chain.until("it is named", lambda: tf(lab)["refused"])
    assert refused == {TCP: f"another node publishes it, in {BASE}"}
    assert TCP not in tf(lab)["published"]
    assert tf(lab)["several_parents"] == {}


def test_a_camera_of_ros_is_found_in_the_robot_and_compared_with_the_profile(
    tf_lab: RosLab,
) -> None:
    """Robot and profile differ by 0.1 m, on purpose. Its transform came before our node did."""
    lab = tf_lab
    seen = lab.chain.until(
        "its place", lambda: (lab.chain.detail("tf_cameras", "ros2") or {}).get("front")
    )
    assert (seen["frame"], seen["link"]) == (CAMERA, BASE)
    assert seen["position_m"] == pytest.approx([0.0, 0.0, 0.0])
    assert "100 mm" in seen["why"]


def test_the_set_point_is_shown_while_the_arm_is_commanded(tf_lab: RosLab) -> None:
    lab = tf_lab
    lab.settle()
    lab.activate_at_rest()
    lab.chain.until("the set-point", lambda: "panda_setpoint" in tf(lab)["published"])
    wanted = transforms(lab, "/tf", lambda each: each["child_frame_id"] == "panda_setpoint")
    place = wanted["transform"]["translation"]
    shown = [place[name] for name in "xyz"]
    assert shown == pytest.approx(lab.arm.wait_still()[:3, 3], abs=EXACT_M)


@pytest.mark.parametrize("camera", ["front", "wrist"])
def test_depth_comes_in_the_unit_of_the_profile_and_what_was_not_measured_is_zero(
    tf_lab: RosLab, camera: str
) -> None:
    """Metres with NaN and infinities, and compressedDepth: both are millimetres of 16 bits."""
    lab, found = tf_lab, []

    def keep(sample: zenoh.Sample) -> None:
        schema = str(sample.encoding).partition(";")[2]
        found.append(decode_depth(sample.payload.to_bytes(), schema))

    handler = zenoh.handlers.Callback(keep, indirect=False)
    key = lab.chain.profile.keys.camera_depth(camera)
    subscriber = lab.chain.session.declare_subscriber(key, handler)
    lab.chain.until("depth", lambda: found)
    subscriber.undeclare()
    assert found[-1].unit_m == DEPTH_UNIT_M
    assert (found[-1].counts == depth_counts(WIDTH, HEIGHT)).all()


def test_a_frame_that_another_node_begins_to_publish_is_left_to_it_and_nonsense_is_named(
    tf_lab: RosLab,
) -> None:
    lab, messages = tf_lab, Messages("jazzy")
    lab.chain.until("links", lambda: "panda_link5" in tf(lab)["published"])
    theirs = [Edge("world", "panda_link5", np.eye(4), fixed=False)]
    message = tf_message(messages, theirs, time.time_ns())

    def say() -> None:
        text = messages.encode(message).hex()
        publish(lab.chain.session, lab.person, "/tf", TF_MESSAGE, bytes=text)

    say()
    why = lab.chain.until("it is left", lambda: tf(lab)["refused"].get("panda_link5"))
    assert why == "another node publishes it, in world"
    assert "panda_link5" not in tf(lab)["published"]
    message.transforms[0].transform.rotation.w = float("nan")
    say()
    lab.chain.until("it is named", lambda: lab.chain.refused().get("ros2.invalid"))
    assert lab.chain.state("ros2") == "running"


def tf(lab: RosLab) -> dict[str, Any]:
    """The node's status about frames."""
    found = {"published": [], "refused": {}, "several_parents": {}}
    return lab.chain.detail("tf", "ros2") or found


def received(lab: RosLab, before: int) -> FrameTree:
    """The tree of what rclpy received: fixed transforms ever, the others since a line."""
    messages, frames = Messages("jazzy"), FrameTree()
    for topic, since in (("/tf_static", 0), ("/tf", before)):
        for line in heard(lab.person, topic, since):
            given = filled(messages, TF_MESSAGE, line["value"])
            edges, faults = read_transforms(given, fixed=topic == "/tf_static")
            assert not faults
            for edge in edges:
                if edge.child not in frames.edges or edge.stamp_ns:
                    frames.edges[edge.child] = edge
    assert np.isfinite([edge.pose for edge in frames.edges.values()]).all()
    return frames


def filled(messages: Messages, kind: str, value: dict[str, Any]) -> Any:
    """A TFMessage of what rclpy told as JSON."""
    made = []
    for each in value["transforms"]:
        stamp = messages.new("builtin_interfaces/msg/Time", **each["header"]["stamp"])
        head = messages.new("std_msgs/msg/Header", stamp=stamp, frame_id=each["header"]["frame_id"])
        at = messages.new("geometry_msgs/msg/Vector3", **each["transform"]["translation"])
        turn = messages.new("geometry_msgs/msg/Quaternion", **each["transform"]["rotation"])
        made.append(
            messages.new(
                "geometry_msgs/msg/TransformStamped",
                header=head,
                child_frame_id=each["child_frame_id"],
                transform=messages.new(
                    "geometry_msgs/msg/Transform", translation=at, rotation=turn
                ),
            )
        )
    return messages.new(kind, transforms=made)
