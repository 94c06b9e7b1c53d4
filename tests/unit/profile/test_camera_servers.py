"""Who speaks for a camera, by the profile."""

from __future__ import annotations

from vla_zenoh.profile import load_profile, override
from vla_zenoh.security.roles import Role, identities


def test_one_host_with_cameras_has_the_node_camera() -> None:
    assert load_profile("panda_sim_lab").camera_servers() == {"front": "camera", "wrist": "camera"}


def test_each_of_several_hosts_has_a_node_of_its_own_as_its_certificate_says() -> None:
    hosts = {
        "robot": {"nodes": ["router", "sim", "command"]},
        "eyes": {"nodes": ["camera"], "cameras": ["front"]},
        "gpu": {"nodes": ["worker", "camera"], "cameras": ["wrist"]},
    }
    at = ["tls/127.0.0.1:7447"]
    session = {"security": {}, "listen": at, "connect": at}
    profile = override(load_profile("panda_sim"), {"hosts": hosts, "session": session})
    servers = profile.camera_servers()
    assert servers == {"front": "camera-eyes", "wrist": "camera-gpu"}
    certified = {
        camera: identity.node
        for identity in identities(profile)
        if identity.role is Role.CAMERA
        for camera in identity.cameras
    }
    assert servers == certified


def test_the_node_of_a_ros2_robot_serves_its_pictures() -> None:
    profile = load_profile("panda_ros2")
    of_ros2 = {name for name, one in profile.cameras.items() if one.source.startswith("ros2:")}
    assert of_ros2
    servers = profile.camera_servers()
    assert {name for name, node in servers.items() if node == "ros2"} == of_ros2


def test_a_camera_that_no_host_runs_is_of_the_node_that_a_person_starts() -> None:
    profile = override(
        load_profile("panda_sim"), {"hosts": {"here": {"nodes": ["router", "sim", "command"]}}}
    )
    assert profile.camera_servers() == {"front": "camera", "wrist": "camera"}
