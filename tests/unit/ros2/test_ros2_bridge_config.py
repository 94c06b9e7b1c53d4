"""The bridge's configuration: what a profile uses is let through, all else is not."""

from __future__ import annotations

import datetime as dt
import json
import re
from pathlib import Path

import pytest
import yaml
import zenoh
from access_check import Passage, allows, passages
from typer.testing import CliRunner
from vla_zenoh_ros2.bridge_config import (
    bridge_command,
    bridge_config,
    bridge_locks,
    bridge_text,
)
from vla_zenoh_ros2.keys import Ros2Dds
from vla_zenoh_secure.lab_certificates import LabCertificates

from vla_zenoh.errors import ProfileError
from vla_zenoh.profile import Profile, load_profile
from vla_zenoh.program.main import app
from vla_zenoh.security import certificates
from vla_zenoh.security.bridge import bridges
from vla_zenoh.security.names import Names
from vla_zenoh.security.roles import Act, Role

RUNNER = CliRunner()
HOSTS = """\
hosts:
  robot: {nodes: [router, ros2, command]}
  gpu: {nodes: [worker], connect: [tcp/10.0.0.2:7447]}
"""


def lab(folder: Path, more: str) -> Profile:
    """The shipped ROS 2 profile, and `more` of YAML."""
    path = folder / "lab.yaml"
    path.write_text(f"extends: panda_ros2\n{more}")
    return load_profile(str(path))


def allowed(profile: Profile) -> dict[str, list[str]]:
    """Kind -> names without the marks that make expressions of them."""
    found = bridge_config(profile)["plugins"]["ros2dds"]["allow"]
    out: dict[str, list[str]] = {}
    for kind, expressions in found.items():
        assert all(text.startswith("^/") and text.endswith("$") for text in expressions)
        out[kind] = [text.removeprefix("^").removesuffix("$") for text in expressions]
    return out


def secured(folder: Path, more: str) -> Path:
    """The file of a secured lab, made by the command that people use."""
    (folder / "plain.yaml").write_text(f"extends: panda_ros2\n{more}")
    file = folder / "secured.yaml"
    words = ["--profile", str(folder / "plain.yaml"), "--output", str(file)]
    words += ["--folder", str(folder / "certificates"), "--at", "robot=10.0.0.2"]
    done = RUNNER.invoke(app, ["secure", "init", *words])
    assert done.exit_code == 0, done.output
    return file


# -- what is let through --------------------------------------------------------------------------
def test_the_shipped_profile_lets_through_what_it_names_and_nothing_else() -> None:
    assert allowed(load_profile("panda_ros2")) == {
        "publishers": [
            "/camera/realsense2_camera/color/image_raw",
            "/camera/wrist_camera/color/image_raw",
            "/joint_states",
            "/vla/active",
            "/vla/prompt",
            "/vla/request",
            "/vla/reset",
            "/vla/stop",
        ],
        "subscribers": [
            "/panda/panda_cartesian_impedance_controller/desired_pose",
            "/rosout",
            "/vla/answer",
            "/vla/status",
        ],
        "service_servers": [],
        "service_clients": [],
        "action_servers": ["/panda_gripper/move"],
        "action_clients": [],
    }


def test_every_part_of_the_section_is_let_through_and_only_where_it_is_used(
    tmp_path: Path,
) -> None:
    profile = lab(
        tmp_path,
        """\
ros2:
  finger_states: /fingers
  wrench: {topic: /wrench}
  joint_command: {topic: /joints, type: trajectory_msgs/msg/JointTrajectory}
  gripper: {grasp: /panda_gripper/grasp}
  prefix: null
  tf: true
""",
    )
    found = allowed(profile)
    for way in ("publishers", "subscribers"):
        assert {"/tf", "/tf_static"} <= set(found[way])
    assert {"/fingers", "/wrench"} <= set(found["publishers"])
    assert found["action_servers"] == ["/panda_gripper/grasp", "/panda_gripper/move"]
    assert found["service_clients"] == []
    assert not any("/vla/" in name for names in found.values() for name in names)
    assert "/joints" not in found["subscribers"]  # poses are sent, not joints


def test_a_robot_by_joints_whose_gripper_takes_widths_has_no_action(tmp_path: Path) -> None:
    profile = lab(
        tmp_path,
        """\
robot: {command: joint}
ros2:
  joint_command: {topic: /joints, type: trajectory_msgs/msg/JointTrajectory}
  gripper: {topic: /width, type: std_msgs/msg/Float64, position: width}
""",
    )
    found = allowed(profile)
    assert found["subscribers"] == ["/joints", "/rosout", "/vla/answer", "/vla/status", "/width"]
    assert found["action_servers"] == []


def test_cameras_alone_let_through_no_command(tmp_path: Path) -> None:
    profile = lab(
        tmp_path,
        "robot: {driver: sim}\ncameras: {wrist: {source: 'sim:wrist'}}\nros2: {prefix: null}\n"
        "hosts: {here: {nodes: [router, sim, ros2, command, worker]}}\n",
    )
    found = allowed(profile)
    assert found.pop("publishers") == ["/camera/realsense2_camera/color/image_raw"]
    assert not any(found.values())
    assert list(profile.ros2_cameras()) == ["front"]


def test_a_name_is_meant_as_a_whole_and_to_the_letter(tmp_path: Path) -> None:
    profile = lab(tmp_path, "ros2: {joint_states: '/a/joint_states{x}'}\n")
    expressions = bridge_config(profile)["plugins"]["ros2dds"]["allow"]["publishers"]
    passes = [text for text in expressions if re.search(text, "/a/joint_states{x}")]
    assert len(passes) == 1
    assert not any(re.search(text, "/a/joint_states{x}/raw") for text in expressions)
    assert not any(re.search(text, "/b/a/joint_states{x}") for text in expressions)


def test_requests_go_before_states_and_these_before_images(tmp_path: Path) -> None:
    profile = lab(tmp_path, "ros2: {finger_states: /fingers, wrench: {topic: /wrench}}\n")
    section = bridge_config(profile)["plugins"]["ros2dds"]
    ranks = dict(text.rsplit("=", 1) for text in section["pub_priorities"])
    assert set(ranks) == set(section["allow"]["publishers"])
    assert ranks["^/vla/stop$"] == ranks["^/vla/active$"] == "1:express"
    assert ranks["^/joint_states$"] == ranks["^/fingers$"] == ranks["^/wrench$"] == "2"
    assert ranks["^/camera/wrist_camera/color/image_raw$"] == "6"


# -- where it is ----------------------------------------------------------------------------------
def test_zenoh_reads_the_file_and_the_domain_is_the_profiles(tmp_path: Path) -> None:
    profile = lab(tmp_path, "ros2: {domain: 42, distribution: humble}\n")
    file = tmp_path / "bridge.json5"
    file.write_text(bridge_text(profile, bridge_config(profile)))
    config = zenoh.Config.from_file(str(file))
    assert json.loads(config.get_json("plugins/ros2dds"))["domain"] == 42
    assert json.loads(config.get_json("listen/endpoints")) == ["tcp/127.0.0.1:7447"]
    assert bridge_command(profile, "a.json5") == (
        "ROS_DISTRO=humble zenoh-bridge-ros2dds -c a.json5"
    )


def test_a_bridge_beside_our_router_is_a_client_of_it_and_listens_nowhere() -> None:
    config = bridge_config(load_profile("panda_ros2"), beside=True)
    assert config["mode"] == "client"
    assert config["connect"]["endpoints"] == ["tcp/127.0.0.1:7447"]
    assert config["listen"]["endpoints"] == []


def test_a_bridge_that_everybody_could_use_is_refused_unless_the_profile_says_so(
    tmp_path: Path,
) -> None:
    places = "ros2: {connect: [tcp/robot.lan:7447]}\n"
    with pytest.raises(ProfileError, match=r"at tcp/robot\.lan:7447 lets anyone on that"):
        bridge_config(lab(tmp_path, places))
    profile = lab(tmp_path, f"{places}session: {{insecure: true}}\n")
    # A name often leads to 127.0.1.1 on the computer that bears it.
    assert bridge_config(profile)["listen"]["endpoints"] == ["tcp/[::]:7447"]


def test_who_needs_no_bridge_is_told(tmp_path: Path) -> None:
    with pytest.raises(ProfileError, match="has no section ros2"):
        bridge_config(load_profile("panda_sim"))
    with pytest.raises(ProfileError, match=r"ros2\.bridge is rmw_zenoh"):
        bridge_config(lab(tmp_path, "ros2: {bridge: rmw_zenoh}\n"))
    elsewhere = (
        "session: {listen: [tls/10.0.0.2:7447], connect: [tls/10.0.0.2:7447], security: {}}\n"
        "hosts: {gpu: {nodes: [worker]}}\n"
    )
    with pytest.raises(ProfileError, match=r"ros2\.connect is missing: in a secured lab"):
        bridge_config(lab(tmp_path, elsewhere))
    with pytest.raises(ProfileError, match="leave that out where it is beside our router"):
        bridge_config(lab(tmp_path, "ros2: {connect: [tcp/127.0.0.1:7450]}\n"), beside=True)


# -- with certificates ----------------------------------------------------------------------------
@pytest.mark.parametrize(
    ("places", "told"),
    [
        ("null", "ros2.connect: is missing: in a secured lab the bridge has a router of its own"),
        ("[tcp/10.0.0.5:7450]", "ros2.connect.0: lets anyone on the network command the robot"),
        (
            "[tls/10.0.0.5:7450, tcp/127.0.0.1:7450]",
            "ros2.connect.1: lets anyone on the network command the robot",
        ),
    ],
)
def test_a_secured_lab_has_no_open_way_to_the_robot(tmp_path: Path, places: str, told: str) -> None:
    session = "{listen: [tls/127.0.0.1:7447], connect: [tls/127.0.0.1:7447], security: {}}"
    with pytest.raises(ProfileError, match=re.escape(told)):
        lab(tmp_path, f"session: {session}\nros2: {{connect: {places}}}\n")


def test_tls_without_a_secured_lab_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ProfileError, match=r"ros2.connect.0: needs certificates"):
        lab(tmp_path, "ros2: {connect: [tls/10.0.0.5:7450]}\n")


def test_a_bridge_on_the_host_of_the_node_needs_no_certificate(tmp_path: Path) -> None:
    file = secured(tmp_path, f"ros2: {{connect: [tcp/127.0.0.1:7450]}}\n{HOSTS}")
    config = bridge_config(load_profile(str(file)))
    assert config["listen"]["endpoints"] == ["tcp/127.0.0.1:7450"]
    assert not {"transport", "access_control"} & config.keys()
    assert not (tmp_path / "certificates" / "robot" / "bridge.pem").exists()


def test_a_bridge_on_another_computer_gets_a_certificate_and_serves_the_node_alone(
    tmp_path: Path,
) -> None:
    file = secured(tmp_path, f"ros2: {{connect: [tcp/10.0.0.5:7450]}}\n{HOSTS}")
    written = yaml.safe_load(file.read_text())
    assert written["ros2"] == {"connect": ["tls/10.0.0.5:7450"]}
    folder = tmp_path / "certificates" / "robot"
    made = certificates.read((folder / "bridge.pem").read_bytes())
    assert (made.common_name, made.addresses) == ("bridge@robot", ("10.0.0.5",))

    done = RUNNER.invoke(app, ["profile", "bridge-config", "--profile", str(file)])
    assert done.exit_code == 0, done.output
    config_file = tmp_path / "bridge.json5"
    config_file.write_text(done.stdout)
    config = zenoh.Config.from_file(str(config_file))
    assert json.loads(config.get_json("listen/endpoints")) == ["tls/10.0.0.5:7450"]
    tls = json.loads(config.get_json("transport/link/tls"))
    assert tls["enable_mtls"] is True
    assert tls["listen_private_key"] == str(folder / "bridge.key")
    assert f"scp -p {folder}/ca.pem {folder}/bridge.pem {folder}/bridge.key ROBOT:" in done.stderr
    rules = json.loads(config.get_json("access_control"))
    may = {
        name: all(allows(rules, name, p) for p in passages(Act.PUT, "panda/desired_pose"))
        for name in ("ros2@robot", "command@robot", "worker-scripted@gpu", "operator@robot")
    }
    assert may == {
        "ros2@robot": True,
        "command@robot": False,
        "worker-scripted@gpu": False,
        "operator@robot": False,
    }


def test_the_node_may_announce_itself_to_the_bridge(tmp_path: Path) -> None:
    profile = load_profile("panda_ros2")
    rules = bridge_locks(profile, tmp_path, Names())["access_control"]
    token = Ros2Dds("abc", None).node_token()
    for passage in passages(Act.ANNOUNCE, token):
        assert allows(rules, "ros2@here", passage), passage
    assert not allows(rules, "ros2@there", Passage("ingress", "put", "joint_states"))


def test_a_renewed_host_has_a_new_certificate_for_its_bridge(tmp_path: Path) -> None:
    file = secured(tmp_path, f"ros2: {{connect: [tcp/10.0.0.5:7450]}}\n{HOSTS}")
    pem = tmp_path / "certificates" / "robot" / "bridge.pem"
    before = pem.read_bytes()
    done = RUNNER.invoke(app, ["secure", "add", "robot", "--profile", str(file), "--renew"])
    assert done.exit_code == 0, done.output
    assert pem.read_bytes() != before
    entries = LabCertificates(tmp_path / "certificates").entries(dt.datetime.now(dt.UTC), "robot")
    assert "bridge" in {entry.node for entry in entries if not entry.faults}
    (bridge,) = bridges(load_profile(str(file)))
    assert (bridge.role, bridge.common_name) == (Role.BRIDGE, "bridge@robot")


# -- the command ----------------------------------------------------------------------------------
def test_the_command_prints_the_file_alone_and_says_beside_it_how_to_start_the_bridge() -> None:
    done = RUNNER.invoke(app, ["profile", "bridge-config", "--profile", "panda_ros2"])
    profile = load_profile("panda_ros2")
    assert done.stdout == bridge_text(profile, bridge_config(profile))
    assert "ROS_DISTRO=jazzy zenoh-bridge-ros2dds -c bridge.json5" in done.stderr


@pytest.mark.parametrize(
    "words",
    [
        ["--profile", "panda_sim", "bridge-config"],
        ["bridge-config", "--profile", "panda_ros2", "--certificates", "/tmp"],
    ],
)
def test_options_that_would_be_overlooked_are_refused(words: list[str]) -> None:
    done = RUNNER.invoke(app, ["profile", *words])
    assert done.exit_code == 2
    assert done.stdout == ""
