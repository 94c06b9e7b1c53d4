"""What the real bridge carries between DDS and our messages, without any node of ours."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
import zenoh
from camera_rig import free_endpoint, until
from vla_zenoh_ros2 import readers, writers
from vla_zenoh_ros2.keys import SENSOR, Endpoint, EntityRole, Ros2Dds
from vla_zenoh_ros2.messages import Messages

from vla_zenoh.bus.session import open_session
from vla_zenoh.profile import SessionProfile
from vla_zenoh.types import PoseCommand

if TYPE_CHECKING:
    from ros_node import RosNode

ros = pytest.importorskip("ros_messages", exc_type=ImportError)

pytestmark = pytest.mark.ros2

PATIENCE_S = 10.0
PROFILE = """\
extends: panda_ros2
session: {{listen: ["{endpoint}"], connect: ["{endpoint}"]}}
ros2: {{domain: {domain}}}
"""
STAMP_NS = 1_700_000_000_123_456_789
CAMERA = "/camera/realsense2_camera/color/image_raw"
PICTURES = 60
"""More than all buffers on their way take: 55 MB."""
HEADER = ros.Header(ros.Time.of(STAMP_NS), "")


@dataclass
class Border:
    """A DDS node on one side of the bridge, a Zenoh session on the other."""

    node: RosNode
    session: zenoh.Session
    messages: Messages
    wire: Ros2Dds

    def announce(self, endpoint: Endpoint) -> list[Any]:
        """Tokens of one of our endpoints; it is announced while they are kept."""
        liveliness = self.session.liveliness()
        keys = [self.wire.node_token(), self.wire.token(endpoint, 1)]
        return [liveliness.declare_token(key) for key in keys]

    def hear(self, endpoint: Endpoint) -> tuple[list[bytes], Any]:
        """Payloads on the key of `endpoint` from now on, and their subscriber."""
        heard: list[bytes] = []
        handler = zenoh.handlers.Callback(
            lambda sample: heard.append(sample.payload.to_bytes()), indirect=False
        )
        return heard, self.session.declare_subscriber(self.wire.key(endpoint), handler)


@pytest.fixture(scope="module")
def border(tmp_path_factory: pytest.TempPathFactory, bridge_program: Path) -> Iterator[Border]:
    from bridge import Bridge, generated
    from ros_node import RosNode, free_domain

    domain, endpoint = free_domain(), free_endpoint()
    profile = SessionProfile(listen=(endpoint,), connect=(endpoint,))
    folder = tmp_path_factory.mktemp("bridge")
    with open_session(profile, mode="router"), open_session(profile) as session:
        file = folder / "lab.yaml"
        file.write_text(PROFILE.format(endpoint=endpoint, domain=domain))
        settings = generated(file, beside=True, all_names=True)
        bridge = Bridge(bridge_program, folder, settings).start()
        node = RosNode("peer", domain)
        messages = Messages("jazzy")
        yield Border(node, session, messages, Ros2Dds(str(session.zid()), messages.hash))
        node.close()
        bridge.kill()


def test_pictures_of_a_dds_camera_are_read_to_the_pixel(border: Border) -> None:
    rgb = np.random.default_rng(0).integers(0, 256, (480, 640, 3), np.uint8)
    # The bridge reads DDS as the first subscriber that is announced wants it: a reliable one would
    # get nothing from a camera that is not.
    kind = "sensor_msgs/msg/Image"
    endpoint = Endpoint(EntityRole.SUBSCRIBER, "/camera/color/image_raw", kind, SENSOR)
    heard, subscriber = border.hear(endpoint)
    tokens = border.announce(endpoint)
    writer = border.node.publisher(endpoint.name, ros.Image, reliable=False, depth=1)
    header = ros.Header(ros.Time.of(STAMP_NS), "camera_color_optical_frame")
    picture = ros.Image(header, 480, 640, "rgb8", 0, 1920, rgb.tobytes())
    until("a picture", lambda: writer.write(picture) or heard, PATIENCE_S)
    read = readers.read(border.messages, endpoint.type, heard[0])
    assert (read.stamp_ns, read.frame) == (STAMP_NS, "camera_color_optical_frame")
    assert np.array_equal(read.rgb, rgb)
    subscriber.undeclare()
    del tokens


def test_joint_states_of_a_dds_robot_are_read_to_the_bit(border: Border) -> None:
    endpoint = Endpoint(EntityRole.SUBSCRIBER, "/joint_states", "sensor_msgs/msg/JointState")
    heard, subscriber = border.hear(endpoint)
    writer = border.node.publisher(endpoint.name, ros.JointState)
    position = [0.1 * k for k in range(7)]
    names = [f"panda_joint{k + 1}" for k in range(7)]
    state = ros.JointState(ros.Header(ros.Time.of(STAMP_NS), ""), names, position, [], position)
    until("a state", lambda: writer.write(state) or heard, PATIENCE_S)
    read = readers.read(border.messages, endpoint.type, heard[0])
    assert (read.stamp_ns, read.names) == (STAMP_NS, tuple(names))
    assert read.position.tolist() == position
    assert read.velocity is None
    assert read.effort.tolist() == position
    subscriber.undeclare()


@pytest.mark.parametrize(
    ("topic", "kind", "message"),
    [
        ("/vla/stop", "std_msgs/msg/Empty", ros.Empty()),
        ("/joint_states", "sensor_msgs/msg/JointState", ros.JointState(HEADER, [], [], [], [])),
    ],
)
def test_what_is_sent_once_gets_past_pictures_that_nobody_takes_in_time(
    border: Border, topic: str, kind: str, message: Any
) -> None:
    """What the bridge's queue has no place for is dropped."""
    camera = Endpoint(EntityRole.SUBSCRIBER, CAMERA, "sensor_msgs/msg/Image", SENSOR)
    endpoint, taken, go_on = Endpoint(EntityRole.SUBSCRIBER, topic, kind), [], threading.Event()
    heard, subscriber = border.hear(endpoint)
    slow = border.session.declare_subscriber(
        border.wire.key(camera),
        zenoh.handlers.Callback(lambda _: taken.append(go_on.wait()), indirect=False),
    )
    tokens = border.announce(camera) + border.announce(endpoint)
    writer = border.node.publisher(topic, type(message))
    pictures = border.node.publisher(CAMERA, ros.Image, reliable=False, depth=1)
    until("the first", lambda: writer.write(message) or time.sleep(0.02) or heard, PATIENCE_S)
    time.sleep(0.2)  # those that are on their way
    before = len(heard)
    picture = ros.Image(HEADER, 480, 640, "rgb8", 0, 1920, bytes(480 * 640 * 3))
    try:
        for _ in range(PICTURES):
            pictures.write(picture)
            time.sleep(0.02)
        writer.write(message)
        time.sleep(0.2)
    finally:
        go_on.set()
    until("what was sent once", lambda: len(heard) > before, PATIENCE_S)
    assert len(taken) < PICTURES
    slow.undeclare()
    subscriber.undeclare()
    del tokens


@pytest.mark.parametrize("kind", ["CartesianImpedanceGoal", "PoseStamped"])
def test_a_pose_command_arrives_in_dds_to_the_bit(border: Border, kind: str) -> None:
    package = "multi_mode_control_msgs" if kind == "CartesianImpedanceGoal" else "geometry_msgs"
    endpoint = Endpoint(EntityRole.PUBLISHER, f"/desired/{kind.lower()}", f"{package}/msg/{kind}")
    tokens = border.announce(endpoint)
    reader = border.node.subscription(endpoint.name, getattr(ros, kind))
    position, quat = np.array([0.4, -0.1, 1 / 3]), np.array([1.0, 0.0, 0.0, 0.0])
    zero = np.zeros(6)
    command = PoseCommand(position, quat, zero, zero, position, quat, "active")
    posture = np.linspace(0.0, 1.0, 7)
    write = writers.pose_writer(border.messages, endpoint.type, posture)
    payload = border.messages.encode(write(command, writers.Stamp(STAMP_NS, "panda_link0")))
    arrived: list[Any] = []

    def try_once() -> list[Any]:
        border.session.put(border.wire.key(endpoint), payload)
        time.sleep(0.02)
        arrived.extend(reader.take(10))
        return arrived

    until("the command in DDS", try_once, PATIENCE_S)
    p, q = arrived[0].pose.position, arrived[0].pose.orientation
    if kind == "PoseStamped":
        header = arrived[0].header
        assert (header.stamp.ns, header.frame_id) == (STAMP_NS, "panda_link0")
    else:
        assert arrived[0].q_n == posture.tolist()
    assert [p.x, p.y, p.z] == position.tolist()
    assert [q.x, q.y, q.z, q.w] == quat.tolist()
    del tokens


def test_a_dds_client_finds_and_calls_a_service_that_we_announce(border: Border) -> None:
    endpoint = Endpoint(EntityRole.SERVER, "/vla_test/set_active", "std_srvs/srv/SetBool")
    asked: list[bool] = []

    def answer(query: zenoh.Query) -> None:
        payload = query.payload
        assert payload is not None
        request = border.messages.decode("std_srvs/srv/SetBool_Request", payload.to_bytes())
        asked.append(request.data)
        response = border.messages.new(
            "std_srvs/srv/SetBool_Response", success=request.data, message=f"{request.data}"
        )
        with query:
            query.reply(border.wire.key(endpoint), border.messages.encode(response))

    queryable = border.session.declare_queryable(border.wire.key(endpoint), answer, complete=True)
    tokens = border.announce(endpoint)
    client = border.node.client(endpoint.name, ros.SetBoolRequest, ros.SetBoolResponse)
    said = [client.call(data, timeout_s=PATIENCE_S) for data in (True, False)]
    assert [(reply.success, reply.message) for reply in said] == [(True, "True"), (False, "False")]
    assert asked == [True, False]
    del tokens
    queryable.undeclare()
