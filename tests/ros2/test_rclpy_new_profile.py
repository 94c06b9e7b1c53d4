"""`profile new --ros2`: from a running rclpy robot behind the real bridge to an arm that moves."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import NamedTuple

import pytest
from camera_rig import free_endpoint
from chain import LONG_PATIENCE_S, running_chain
from typer.testing import CliRunner

pytest.importorskip("ros_messages", exc_type=ImportError)

import panda_dh
from bridge import Bridge
from rclpy_rig import FRONT, HEIGHT, WIDTH, WRIST, Arm, Program, camera_settings, pictures
from ros_node import free_domain

from vla_zenoh.profile import load_profile
from vla_zenoh.program.main import app
from vla_zenoh.resources import robot_urdf

pytestmark = pytest.mark.rclpy

DESCRIPTION = robot_urdf("example-robot-data:panda_description/urdf/panda.urdf")
COMMAND = "/joint_trajectory_controller/joint_trajectory"
STEPS, WAY_M, EXACT_M = 5, 0.05, 5e-4
MOVES_S = 30.0
LAB = """\
extends: ./panda.yaml
unconfirmed: []
cameras:
  front: {{check: {{same_s: 0}}}}
  wrist: {{check: {{same_s: 0}}}}
task: {{prompt: hold, rate_hz: 10, worker: scripted}}
session: {{listen: ["{endpoint}"], connect: ["{endpoint}"], lease_ms: 4000}}
timing: {{command_timeout_s: {patience[command]}, state_timeout_s: {patience[state]}}}
"""


class Robot(NamedTuple):
    """An rclpy robot with two cameras, and where its bridge listens."""

    arm: Arm
    endpoint: str
    domain: int


@contextmanager
def running_robot(folder: Path, program: Path, distribution: str) -> Iterator[Robot]:
    """The robot and a bridge as a person starts it, without a file of ours."""
    domain, endpoint = free_domain(), free_endpoint()
    settings = {
        "mode": "router",
        "listen": {"endpoints": [endpoint]},
        "scouting": {"multicast": {"enabled": False}},
        "plugins": {"ros2dds": {"domain": domain}},
    }
    pictures(folder / "pictures", WIDTH, HEIGHT)
    with ExitStack() as stack:
        bridge = Bridge(program, folder, json.dumps(settings), distribution).start()
        stack.callback(bridge.kill)
        arm = Arm(
            distribution, domain, trajectory=COMMAND, description=str(DESCRIPTION), state_hz=100
        )
        eyes = Program("camera", distribution, domain, camera_settings(folder / "pictures"))
        for one in (arm, eyes):
            one.start(wait=False)
            stack.callback(one.end)
        for one in (arm, eyes):
            one.wait_ready()
        yield Robot(arm, endpoint, domain)


def test_a_running_robot_becomes_a_profile_that_moves_it(
    tmp_path: Path, built_bridge: Path, distribution: str
) -> None:
    file = tmp_path / "panda.yaml"
    with running_robot(tmp_path, built_bridge, distribution) as robot:
        words = ["--connect", robot.endpoint, "--output", str(file), "--table", "none", "--json"]
        done = CliRunner().invoke(app, ["profile", "new", "--ros2", *words])
        assert done.exit_code == 0, done.output
        told = json.loads(done.stdout)
        made = load_profile(str(file))
        ros2 = made.ros2
        assert ros2 is not None
        assert ros2.joint_command is not None
        assert ros2.gripper is not None
        assert (ros2.domain, ros2.connect) == (robot.domain, (robot.endpoint,))
        assert ros2.joint_command.topic == COMMAND
        assert ros2.gripper.topic == "/gripper_width"
        assert made.robot.arm_joints == panda_dh.JOINTS
        assert {name: each.topic for name, each in ros2.cameras.items()} == {
            "front": FRONT,
            "wrist": WRIST,
        }
        assert (made.cameras["front"].width, made.cameras["front"].height) == (WIDTH, HEIGHT)
        assert {"ros2.joint_command", "ros2.gripper", "robot.description"} <= {*told["guesses"]}
        assert {*made.unconfirmed} == {*told["guesses"]}
        assert any("example-robot-data" in note for note in told["notes"])
        home = ",".join(f"{each:.3f}" for each in panda_dh.HOME_RAD)
        assert f"home where it stands now: --home={home}" in told["notes"]

        lab = tmp_path / "lab.yaml"
        lab.write_text(LAB.format(endpoint=free_endpoint(), patience=LONG_PATIENCE_S))
        with running_chain(tmp_path, profile_file=lab) as chain:
            chain.activate_when_ready()
            before_m = robot.arm.wait_still()[:3, 3]
            chain.client.set_prompt(f"HARD: go up x{STEPS}")
            chain.wait_done(f"HARD: go up x{STEPS}", STEPS, MOVES_S)
            chain.wait_arrived()
            way_m = robot.arm.wait_still()[:3, 3] - before_m
        assert way_m == pytest.approx((0.0, 0.0, WAY_M), abs=EXACT_M)
