"""One robot of two arms in ROS 2: two rclpy nodes under one command node."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import pytest
from camera_rig import free_endpoint
from chain import LONG_PATIENCE_S, Chain, running_chain

pytest.importorskip("ros_messages", exc_type=ImportError)

from bridge import Bridge, generated
from rclpy_rig import CAMERA_HZ, FRONT, Arm, Program, camera_settings, pictures
from ros_node import free_domain

from vla_zenoh.resources import robot_urdf

pytestmark = pytest.mark.rclpy

DESCRIPTION = robot_urdf("example-robot-data:panda_description/urdf/panda.urdf")
SIDES = ("left", "right")
TURN_RAD, WIDTH_M = 0.2, 0.03
EXACT_RAD = 1e-6
MOVES_S = 30.0
PROFILE = """\
extends: panda_ros2
robot: {{name: pair, command: joint}}
parts:
{parts}
cameras:
  front: {{source: "ros2:{front}", width: 160, height: 120, rate_hz: {hz}, check: {{same_s: 0}}}}
  wrist: null
workers: [wave]
models: {{wave: ./wave.py}}
task: {{prompt: hold, rate_hz: 5, worker: wave}}
session: {{listen: ["{endpoint}"], connect: ["{endpoint}"], lease_ms: 4000}}
timing: {{command_timeout_s: {patience[command]}, state_timeout_s: {patience[state]}}}
ros2:
  distribution: {distribution}
  domain: {domain}
  pose_command: null
  gripper: null
  cameras: {{wrist: null, front: {{topic: {front}}}}}
"""
PART = """\
  {side}:
    base: {{position_m: [{at_m}, 0.0, 0.0]}}
    robot:
      description: ./urdf/{side}.urdf
      base_frame: {side}_panda_link0
      tcp_frame: {side}_panda_hand_tcp
      arm_joints: [{joints}]
      finger_joints: [{side}_panda_finger_joint1, {side}_panda_finger_joint2]
    ros2:
      joint_command: {{topic: /{side}/joint_command, type: std_msgs/msg/Float64MultiArray}}
      gripper: {{topic: /{side}/gripper_width, type: std_msgs/msg/Float64, position: width}}
"""
MODEL = """\
from vla_zenoh.policy import ActionSpec, ActionSteps, CameraSpec, ModelSpec, ObservationSpec

STEPS = 10


def arm(side):
    joints = tuple(f"{{side}}_panda_joint{{index}}" for index in range(1, 8))
    return ActionSpec(
        space="joint", joints=joints, kind="delta", horizon=1, dt_s=0.2, gripper="absolute_m"
    )


class Wave:
    spec = ModelSpec(
        name="wave",
        observation=ObservationSpec(
            cameras=(CameraSpec(camera="front", width=160, height=120),), prompt=True
        ),
        action=ActionSpec.of_parts({{side: arm(side) for side in ("left", "right")}}),
    )

    def reset(self):
        self.left = STEPS

    def infer(self, observation):
        waves = observation.prompt == "wave" and observation.task.active
        turn = {turn} / STEPS if waves and self.left else 0.0
        self.left -= turn > 0
        left = [turn, *[0.0] * 6, 0.08]
        right = [-turn, *[0.0] * 6, {width} if waves else 0.08]
        return ActionSteps([[*left, *right]], done=waves and not self.left)
"""


def write_pair(folder: Path, distribution: str, domain: int) -> Path:
    """Profile, model and descriptions of two Pandas whose names begin with their side."""
    (folder / "urdf").mkdir()
    (folder / "meshes").symlink_to(DESCRIPTION.parents[1] / "meshes")
    (folder / "example-robot-data").symlink_to(DESCRIPTION.parents[3])
    parts = []
    for index, side in enumerate(SIDES):
        own = re.sub(r'"panda_(?=\w)', f'"{side}_panda_', DESCRIPTION.read_text())
        (folder / "urdf" / f"{side}.urdf").write_text(own)
        joints = ", ".join(f"{side}_panda_joint{index}" for index in range(1, 8))
        parts.append(PART.format(side=side, at_m=2.0 * index, joints=joints))
    (folder / "wave.py").write_text(MODEL.format(turn=TURN_RAD, width=WIDTH_M))
    path = folder / "pair_rclpy.yaml"
    path.write_text(
        PROFILE.format(
            parts="".join(parts),
            front=FRONT,
            hz=CAMERA_HZ,
            endpoint=free_endpoint(),
            patience=LONG_PATIENCE_S,
            distribution=distribution,
            domain=domain,
        )
    )
    return path


@contextmanager
def running_pair(
    folder: Path, program: Path, distribution: str
) -> Iterator[tuple[dict[str, Arm], Chain]]:
    """Both arms, a camera, the bridge with the settings of `bridge-config`, and our nodes."""
    domain = free_domain()
    profile = write_pair(folder, distribution, domain)
    pictures(folder / "pictures", 160, 120)
    eyes = camera_settings(folder / "pictures")
    eyes["topics"] = eyes["topics"][:1]
    with ExitStack() as stack:
        bridge = Bridge(program, folder, generated(profile, beside=True), distribution).start()
        stack.callback(bridge.kill)
        arms = {
            side: Arm(
                distribution,
                domain,
                namespace=f"/{side}",
                prefix=f"{side}_",
                arguments=["--ros-args", "-r", "joint_states:=/joint_states"],
            )
            for side in SIDES
        }
        programs = [*arms.values(), Program("camera", distribution, domain, eyes)]
        for one in programs:
            one.start(wait=False)
            stack.callback(one.end)
        chain = stack.enter_context(running_chain(folder, profile_file=profile))
        for one in programs:
            one.wait_ready()
        yield arms, chain


def test_two_arms_of_one_robot_move_each_by_its_own_topics_and_stop_together(
    tmp_path: Path, built_bridge: Path, distribution: str
) -> None:
    """Their joints come on one topic, told apart by their names; each gripper has its own."""
    with running_pair(tmp_path, built_bridge, distribution) as (arms, chain):
        chain.activate_when_ready()
        before = {side: arm.joints_rad() for side, arm in arms.items()}
        chain.client.set_prompt("wave")
        chain.wait_done("wave", timeout_s=MOVES_S)
        chain.wait_arrived()
        for side, sign in zip(SIDES, (1, -1), strict=True):
            arms[side].wait_still()
            after = arms[side].joints_rad()
            wanted = before[side] + [sign * TURN_RAD, 0, 0, 0, 0, 0, 0]
            assert after == pytest.approx(wanted, abs=EXACT_RAD), chain.story()
        chain.until("its fingers", lambda: arms["right"].width_m() == pytest.approx(WIDTH_M, 1e-3))
        assert arms["left"].width_m() == pytest.approx(0.08)
        arms["left"].kill()
        chain.until("both end", lambda: chain.state() == "inactive", MOVES_S)
        assert "left" in str(chain.detail("why"))
