"""A robot of ROS 2's own rclpy on Fast DDS behind the real bridge: does it do what the model says?

The motion is judged by the joints that another rclpy node received, or by the robot's own log.
"""

from __future__ import annotations

import re
import threading
import time
from typing import TYPE_CHECKING

import numpy as np
import pytest
import zenoh
from camera_rig import until
from chain import LONG_PATIENCE_S

from vla_zenoh.codec import records
from vla_zenoh.codec.image import decode_jpeg, decode_raw
from vla_zenoh.kinematics.kinematics import make_kinematics

pytest.importorskip("ros_messages", exc_type=ImportError)

import panda_dh
from rclpy_rig import (
    EMPTY,
    FRONT,
    ROS2_PAGE,
    Program,
    carry_out,
    heard,
    received_tcp,
    request,
)

if TYPE_CHECKING:
    from rclpy_rig import RosLab

pytestmark = pytest.mark.rclpy

ROBOT_PATIENCE_S = LONG_PATIENCE_S
STEP_M, STEP_RAD, WIDTH_STEP_M = 0.01, 0.05, 0.05
EXACT_M, EXACT_RAD = 1e-6, 1e-6
PICTURES_S, JPEG_OFF = 2.0, 20.0


def test_steps_and_turns_end_where_they_were_asked(ros_lab: RosLab) -> None:
    ros_lab.activate_at_rest()
    for prompt, count, axis, sign in (
        ("go up", 5, None, 1),
        ("go down", 8, None, -1),
        ("yaw left", 10, 2, 1),
        ("roll left", 4, 0, 1),
        ("pitch up", 4, 1, 1),
    ):
        began = received_tcp(ros_lab)
        carry_out(ros_lab, prompt, count)
        ended = received_tcp(ros_lab)
        way_m = ended[:3, 3] - began[:3, 3]
        turn_rad = panda_dh.turn_between(ended[:3, :3], began[:3, :3])
        print(f"\n{prompt} x{count}: {1e3 * way_m} mm, {turn_rad} rad")
        wanted_m, wanted_rad = np.zeros(3), np.zeros(3)
        if axis is None:
            wanted_m[2] = sign * count * STEP_M
        else:
            wanted_rad[axis] = np.sign(turn_rad[axis]) * count * STEP_RAD
        assert way_m == pytest.approx(wanted_m, abs=EXACT_M)
        assert turn_rad == pytest.approx(wanted_rad, abs=EXACT_RAD)


def test_the_pose_that_we_report_is_that_of_the_robots_joints(ros_lab: RosLab) -> None:
    ros_lab.arm.wait_still()
    joints_rad = ros_lab.arm.joints_rad()
    pose = make_kinematics(ros_lab.chain.profile).forward(joints_rad)
    tcp = panda_dh.forward(joints_rad)
    assert pose.position_m == pytest.approx(tcp[:3, 3], abs=EXACT_M)
    assert ros_lab.chain.measured().position_m == pytest.approx(tcp[:3, 3], abs=EXACT_M)


def test_pictures_arrive_as_they_were_published(ros_lab: RosLab) -> None:
    keys, arrived = ros_lab.chain.profile.keys, {"raw": [], "jpeg": []}
    lock = threading.Lock()

    def keep(kind: str, sample: zenoh.Sample) -> None:
        attachment = sample.attachment
        assert attachment is not None
        header = records.decode_header(attachment.to_bytes())
        with lock:
            arrived[kind].append((header, sample.payload.to_bytes(), str(sample.encoding)))

    subscribers = [
        ros_lab.chain.session.declare_subscriber(
            key, zenoh.handlers.Callback(lambda sample, kind=kind: keep(kind, sample))
        )
        for key, kind in ((keys.camera_raw("front"), "raw"), (keys.camera_jpeg("wrist"), "jpeg"))
    ]
    time.sleep(PICTURES_S)
    for subscriber in subscribers:
        subscriber.undeclare()
    assert len(arrived["raw"]) > 10
    assert len(arrived["jpeg"]) > 10
    known = {rgb.tobytes(): number for number, rgb in enumerate(ros_lab.pictures)}
    numbers = [
        known[decode_raw(payload, encoding.partition(";")[2]).rgb.tobytes()]
        for _, payload, encoding in arrived["raw"]
    ]
    assert set(numbers) == set(range(len(known)))
    for header, payload, _ in arrived["jpeg"]:
        rgb = decode_jpeg(payload).rgb.astype(float)
        off = [np.abs(rgb - each).mean() for each in ros_lab.pictures]
        assert min(off) < JPEG_OFF
        assert abs(header.stamp_wall_ns - time.time_ns()) < 10e9
    rates = {kind: len(found) / PICTURES_S for kind, found in arrived.items()}
    print(f"\npictures per second: {rates}")


def test_the_gripper_goes_to_the_width_on_its_topic(ros_lab: RosLab) -> None:
    ros_lab.activate_at_rest()
    opened_m = ros_lab.arm.width_m()
    carry_out(ros_lab, "close gripper", 1)
    until("closed", lambda: abs(ros_lab.arm.width_m() - (opened_m - WIDTH_STEP_M)) < 1e-6)
    carry_out(ros_lab, "open gripper", 1)
    until("opened", lambda: abs(ros_lab.arm.width_m() - opened_m) < 1e-6)


# -- a ROS user, on Fast DDS ----------------------------------------------------------------------
def test_a_ros_user_sets_prompt_and_activation_and_is_answered(ros_lab: RosLab) -> None:
    began_m = ros_lab.arm.wait_still()[:3, 3]
    answer = request(ros_lab, "active", {"data": True})
    assert answer["ok"], answer
    answer = request(ros_lab, "prompt", {"data": "HARD: go up x5"})
    assert answer["ok"], answer
    ros_lab.chain.wait_done("HARD: go up x5", 5)
    ros_lab.chain.wait_arrived()
    way_m = ros_lab.arm.wait_still()[:3, 3] - began_m
    assert way_m == pytest.approx((0, 0, 5 * STEP_M), abs=EXACT_M)
    answer = request(ros_lab, "active", {"data": False})
    assert answer["ok"], answer
    ros_lab.chain.until("inactive", lambda: ros_lab.chain.state() == "inactive")


def test_a_ros_user_requests_everything_at_once(ros_lab: RosLab) -> None:
    text = '{"id": "7", "prompt": "hold", "rate_hz": 12, "active": true}'
    answer = request(ros_lab, "request", {"data": text})
    assert (answer["id"], answer["ok"]) == ("7", True), answer
    assert ros_lab.chain.client.task is not None
    assert ros_lab.chain.client.task.rate_hz == 12.0
    answer = request(ros_lab, "request", {"data": '{"speed": 3}'})
    assert not answer["ok"]
    assert "speed" in answer["reason"]


def test_a_ros_user_stops_the_moving_arm_and_resets_it(ros_lab: RosLab) -> None:
    ros_lab.move()
    before = len(ros_lab.person.told)
    answer = request(ros_lab, "stop")
    assert answer["ok"], answer
    said_ns = next(line["t"] for line in ros_lab.person.told[before:] if "said" in line)
    ros_lab.arm.wait_still()
    stood_s = ros_lab.arm.track(said_ns).time_to_stand_s(said_ns)
    print(f"\nstands {stood_s:.3f} s after the stop was published")
    assert stood_s < 1.0
    assert ros_lab.chain.state() == "stopped"
    refused = request(ros_lab, "active", {"data": True})
    assert not refused["ok"]
    assert refused["reason"]
    assert request(ros_lab, "reset")["ok"]
    ros_lab.chain.until("inactive", lambda: ros_lab.chain.state() == "inactive")


def test_a_stop_of_a_new_program_arrives_if_it_is_published_as_the_page_says(
    ros_lab: RosLab,
) -> None:
    """It publishes as soon as it has a subscriber: the first message may be lost."""
    said = re.search(r"pub -r (\d+) -t (\d+) --qos-depth (\d+) /vla/stop", ROS2_PAGE.read_text())
    assert said is not None
    rate_hz, count, depth = map(int, said.groups())
    how = {"count": count, "rate_hz": rate_hz, "qos_of": {"depth": depth}}
    user = Program("person", ros_lab.distribution, ros_lab.domain).start()
    try:
        ros_lab.move()
        user.ask("say", "said", topic="/vla/stop", type=EMPTY, **how)
        ros_lab.chain.until("stopped", lambda: ros_lab.chain.state() == "stopped")
    finally:
        user.end()  # when it has published them all
    assert request(ros_lab, "reset")["ok"]


def test_what_is_received_once_more_does_not_activate(ros_lab: RosLab) -> None:
    late = {"transient_local": True, "depth": 1}
    answer = request(ros_lab, "active", {"data": True}, qos_of=late)
    assert not answer["ok"]
    assert "transient_local" in answer["reason"]
    assert ros_lab.chain.state() == "inactive"
    ros_lab.person.do("unsay")


def test_serialised_bytes_of_a_bag_are_read(ros_lab: RosLab) -> None:
    """As `ros2 bag play` publishes them: with zeros behind, as rclpy serialises."""
    text = b"hold\0"
    body = len(text).to_bytes(4, "little") + text
    payload = (b"\0\1\0\0" + body + bytes(3)).hex()
    answer = request(ros_lab, "prompt", bytes=payload)
    assert answer["ok"], answer


def test_a_ros_user_finds_no_service_of_ours(ros_lab: RosLab) -> None:
    said = ros_lab.person.ask(
        "call", "called", service="/vla/stop", type="std_srvs/srv/Trigger", patience_s=2.0
    )
    assert not said["found"]


def test_ros_tools_show_the_status_and_what_works(ros_lab: RosLab) -> None:
    person = ros_lab.person
    status = "/vla/status"
    person.ask("hear", "hears", topic=status, type="diagnostic_msgs/msg/DiagnosticArray")
    until("a status", lambda: heard(person, status))
    names = {each["name"] for each in heard(person, status)[-1]["value"]["status"]}
    assert any("command" in name for name in names), names
    late = {"transient_local": True}
    person.ask("hear", "hears", topic="/rosout", type="rcl_interfaces/msg/Log", qos_of=late)

    def sentences() -> list[str]:
        return [line["value"]["msg"] for line in heard(person, "/rosout")]

    said = until(
        "a line of ours in the ROS log", lambda: [s for s in sentences() if "/vla/stop" in s]
    )
    assert "/vla/answer" in said[-1]


def test_rclpy_is_told_of_a_subscription_that_asks_for_more_than_we_offer(ros_lab: RosLab) -> None:
    """Setpoints are reliable and volatile: nobody who comes late is to move by an old one."""
    person, topic = ros_lab.person, "/desired_pose"
    kind = "geometry_msgs/msg/PoseStamped"
    person.ask("hear", "hears", topic=topic, type=kind, qos_of={"transient_local": True})
    mismatch = until(
        "rclpy tells of it",
        lambda: [line for line in person.told if line.get("mismatch") == topic],
    )
    assert mismatch[-1]["side"] == "subscription"
    assert "DURABILITY" in mismatch[-1]["policy"]
    # The robot itself goes on.
    ros_lab.activate_at_rest()
    began_m = ros_lab.arm.tcp()[2, 3]
    ended_m = carry_out(ros_lab, "go up", 2)[2, 3]
    assert ended_m - began_m == pytest.approx(2 * STEP_M, abs=EXACT_M)


def test_pictures_reach_ros_nodes_as_before(ros_lab: RosLab) -> None:
    """The bridge that reads a best-effort camera does not take it from a ROS subscriber."""
    person = ros_lab.person
    person.ask(
        "hear", "hears", topic=FRONT, type="sensor_msgs/msg/Image", qos_of={"reliable": False}
    )
    until("pictures in rclpy", lambda: len(heard(person, FRONT)) > 5)
