"""What a LeRobot directory declares, against what the options say it means; no LeRobot needed."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest

from vla_zenoh.errors import WorkerError
from vla_zenoh.loader import find_model, make_policy
from vla_zenoh.policy import Policy

CONFIG: dict[str, Any] = {
    "type": "act",
    "n_obs_steps": 1,
    "chunk_size": 100,
    "n_action_steps": 50,
    "input_features": {
        "observation.images.front": {"type": "VISUAL", "shape": [3, 480, 640]},
        "observation.images.gripper_cam": {"type": "VISUAL", "shape": [3, 480, 640]},
        "observation.state": {"type": "STATE", "shape": [8]},
    },
    "output_features": {"action": {"type": "ACTION", "shape": [7]}},
}
MEANING = {
    "kind": "delta",
    "rotation": "rpy",
    "gripper": "open_fraction",
    "dt_s": "0.05",
    "state": "joint+gripper_m",
    "cameras": "wrist=observation.images.gripper_cam",
}


def make(folder: Path, config: Mapping[str, Any] = CONFIG, **options: str) -> Policy:
    (folder / "config.json").write_text(json.dumps(config))
    return make_policy(find_model("lerobot"), {"checkpoint": str(folder), **MEANING, **options})


def test_the_spec_says_what_the_options_say(tmp_path: Path) -> None:
    spec = make(tmp_path, frame="tcp", open_is_high="no", scale_m="0.001").spec
    assert [camera.camera for camera in spec.observation.cameras] == ["front", "wrist"]
    assert {(c.width, c.height, c.resize) for c in spec.observation.cameras} == {(640, 480, "none")}
    assert spec.observation.state == ("joint", "gripper")
    assert not spec.observation.prompt
    assert (spec.action.horizon, spec.action.dt_s) == (50, 0.05)
    assert (spec.action.frame, spec.action.gripper_open_is_high) == ("tcp", False)
    assert spec.action.position_scale_m == 0.001


def test_a_policy_that_reads_words_asks_for_a_prompt(tmp_path: Path) -> None:
    assert make(tmp_path, {**CONFIG, "type": "smolvla"}).spec.observation.prompt


@pytest.mark.parametrize("change", [{"n_obs_steps": 2}, {"temporal_ensemble_coeff": 0.01}])
def test_a_policy_that_plans_by_itself_gives_one_step(
    tmp_path: Path, change: dict[str, Any]
) -> None:
    assert make(tmp_path, {**CONFIG, **change}).spec.action.horizon == 1


@pytest.mark.parametrize(
    ("options", "match"),
    [
        ({"kind": ""}, r"kind is '', allowed: delta, absolute, joint_delta, joint_position"),
        ({"rotation": "euler"}, r"rotation is 'euler', allowed: rpy, rotvec, quaternion"),
        ({"gripper": ""}, r"gripper is '', allowed: .* open_fraction"),
        ({"resize": "squash"}, r"resize is 'squash'"),
        ({"dt_s": ""}, r"how long is a step"),
        ({"dt_s": "fast"}, r"dt_s is 'fast'"),
        ({"state": ""}, r"state has 8 numbers, '' has 0"),
        ({"state": "joint"}, r"state has 8 numbers, 'joint' has 7"),
        ({"state": "joint+grip"}, r"called 'grip'; there are: joint \(one"),
        ({"cameras": "wrist=observation.images.hand"}, r"which the policy does not know; its"),
        ({"cameras": "front=observation.images.gripper_cam"}, r"two pictures .* 'front'"),
        ({"steps": "101"}, r"steps is 101; the policy's chunks have 100"),
        ({"steps": "many"}, r"steps is 'many'"),
        ({"rotation": "quaternion"}, r"actions have shape \(7,\); .* are \(8,\)"),
        ({"gripper": "none"}, r"actions have shape \(7,\); .* are \(6,\)"),
    ],
)
def test_an_option_that_does_not_fit_is_named(
    tmp_path: Path, options: dict[str, str], match: str
) -> None:
    with pytest.raises(WorkerError, match=match):
        make(tmp_path, **options)


@pytest.mark.parametrize("kind", ["joint_position", "joint_delta"])
def test_joint_actions_become_poses_by_the_joints_that_are_measured(
    tmp_path: Path, kind: str
) -> None:
    joints = {**CONFIG, "output_features": {"action": {"type": "ACTION", "shape": [8]}}}
    spec = make(tmp_path, joints, kind=kind, rotation="").spec
    assert (spec.action.kind, spec.action.rotation) == ("absolute", "quaternion")
    assert spec.observation.state == ("joint", "gripper")


SIX_JOINTS = """
extends: panda_sim
robot:
  arm_joints: [j1, j2, j3, j4, j5, j6]
  home_rad: [0.0, -1.2, 1.5, -1.8, -1.57, 0.0]
limits: {joint: {velocity_rad_s: 2.0, acceleration_rad_s2: 8.0, jerk_rad_s3: 400.0}}
"""


def test_an_arm_with_six_joints_has_a_state_of_six(tmp_path: Path) -> None:
    (tmp_path / "six.yaml").write_text(SIX_JOINTS)
    told = {"state": "joint+gripper_open", "profile": str(tmp_path / "six.yaml")}
    state = {"observation.state": {"type": "STATE", "shape": [7]}}
    six = {**CONFIG, "input_features": {**CONFIG["input_features"], **state}}
    assert make(tmp_path, six, **told).spec.observation.state == ("joint", "gripper")
    with pytest.raises(WorkerError, match=r"has 8 numbers, 'joint\+gripper_open' has 7"):
        make(tmp_path, CONFIG, **told)


def test_joints_of_another_arm_are_refused_with_the_reason(tmp_path: Path) -> None:
    joints = {**CONFIG, "output_features": {"action": {"type": "ACTION", "shape": [14]}}}
    with pytest.raises(WorkerError, match=r"7 joints with gripper 'open_fraction' are \(8,\)"):
        make(tmp_path, joints, kind="joint_position")
    with pytest.raises(WorkerError, match=r"position and rpy with gripper .* are \(7,\)"):
        make(tmp_path, joints)


@pytest.mark.parametrize(
    ("config", "match"),
    [
        ({"model_type": "llama"}, "has no type; it is not a LeRobot policy"),
        ({**CONFIG, "use_peft": True}, "is an adapter"),
        ({**CONFIG, "type": "groot"}, "runs code from a model hub"),
        ({**CONFIG, "input_features": ["front"]}, "not of LeRobot's form"),
        (
            {
                **CONFIG,
                "input_features": {
                    **CONFIG["input_features"],
                    "observation.environment_state": {"type": "ENV", "shape": [4]},
                },
            },
            "needs observation.environment_state, which no robot here can tell",
        ),
    ],
)
def test_a_directory_that_cannot_be_run_is_refused(
    tmp_path: Path, config: dict[str, Any], match: str
) -> None:
    with pytest.raises(WorkerError, match=match):
        make(tmp_path, config)


def test_a_directory_that_is_not_there_is_refused(tmp_path: Path) -> None:
    with pytest.raises(WorkerError, match="is not a folder"):
        make_policy(find_model("lerobot"), {"checkpoint": str(tmp_path / "nowhere")})
    with pytest.raises(WorkerError, match=r"--set checkpoint=DIRECTORY"):
        make_policy(find_model("lerobot"))
