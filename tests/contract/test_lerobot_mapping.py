"""What a LeRobot directory declares, against what the options say it means; no LeRobot needed."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from vla_zenoh.errors import WorkerError
from vla_zenoh.policy import Policy
from vla_zenoh.policy.loader import find_model, make_policy
from vla_zenoh.profile import load_profile

ATOL = 1e-12
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
WRIST = "observation.images.gripper_cam=camera:wrist"
ACTION_OPTIONS = {
    "action": "delta",
    "anchor": "goal",
    "relative_to": "previous",
    "controller": "none",
    "rotation": "rpy",
    "gripper": "open_fraction",
    "gripper_open": "high",
    "dt_s": "0.05",
    "state": "joint+gripper_m",
    "map": WRIST,
}


def make(folder: Path, config: Mapping[str, Any] = CONFIG, /, **options: str) -> Policy:
    (folder / "config.json").write_text(json.dumps(config))
    return make_policy(
        find_model("lerobot"), {"checkpoint": str(folder), **ACTION_OPTIONS, **options}
    )


def test_the_spec_says_what_the_options_say(tmp_path: Path) -> None:
    spec = make(tmp_path, frame="tcp", gripper_open="low").spec
    assert [camera.camera for camera in spec.observation.cameras] == ["front", "wrist"]
    assert {(c.width, c.height, c.resize) for c in spec.observation.cameras} == {(640, 480, "none")}
    assert spec.observation.state == ("joint", "gripper")
    assert not spec.observation.prompt
    assert (spec.action.horizon, spec.action.dt_s) == (50, 0.05)
    assert (spec.action.frame, spec.action.gripper_open_is_high) == ("tcp", False)


def test_a_chunk_relative_to_its_observation_is_declared_so(tmp_path: Path) -> None:
    umi = {"relative_to": "start", "anchor": "measured", "controller": "", "frame": "tcp"}
    action = make(tmp_path, **umi).spec.action
    assert (action.relative_to, action.anchor, action.controller) == ("start", "measured", None)


def test_numbers_are_read_in_the_units_and_bounds_that_are_told(tmp_path: Path) -> None:
    """As LIBERO's: -1 to 1, of which one unit is 5 cm or half a radian, and 1 shuts the gripper."""
    libero = {"rotation": "rotvec", "position_scale_m": "0.05", "rotation_scale_rad": "0.5"}
    grip = {"gripper": "binary", "gripper_open": "low", "gripper_threshold": "0"}
    policy = make(tmp_path, **libero, **grip, clip="1")
    action = policy.spec.action
    assert (action.gripper, action.gripper_open_is_high, action.gripper_threshold) == (
        "binary",
        False,
        0.0,
    )
    steps = vars(policy)["_meaning"][""].steps(np.array([[1.0, -3.0, 0.5, 0.0, 0.2, 9.0, -1.0]]))
    assert action.position_scale_m == pytest.approx(0.05)
    np.testing.assert_allclose(steps, [[1, -1, 0.5, 0, 0.1, 0.5, -1]], atol=ATOL)


SMOLVLA: dict[str, Any] = {
    "type": "smolvla",
    "empty_cameras": 1,
    "input_features": {
        **{
            f"observation.images.camera{n}": {"type": "VISUAL", "shape": [3, 256, 256]}
            for n in (1, 2, 3)
        },
        "observation.images.empty_camera_0": {"type": "VISUAL", "shape": [3, 480, 640]},
        "observation.state": {"type": "STATE", "shape": [6]},
    },
    "output_features": {"action": {"type": "ACTION", "shape": [7]}},
}
"""As after fine-tuning from the published weights: pictures and state of the config are theirs."""
TWO = (
    "observation.images.camera1=camera:front, observation.images.camera2=camera:wrist, "
    "observation.images.camera3="
)


def test_a_fine_tuned_smolvla_is_given_what_its_data_had(tmp_path: Path) -> None:
    numpy_file = pytest.importorskip("safetensors.numpy", reason="comes with LeRobot")
    statistics = {"observation.state.mean": np.zeros(8), "observation.state.count": np.zeros(1)}
    numpy_file.save_file(statistics, tmp_path / "scale.safetensors")
    steps = [{"registry_name": "normalizer_processor", "state_file": "scale.safetensors"}]
    (tmp_path / "policy_preprocessor.json").write_text(json.dumps({"steps": steps}))
    spec = make(tmp_path, SMOLVLA, map=TWO).spec
    cameras = [(c.camera, c.width, c.resize) for c in spec.observation.cameras]
    assert cameras == [("front", None, "none"), ("wrist", None, "none")]
    assert spec.observation.state == ("joint", "gripper")
    sized = make(tmp_path, SMOLVLA, map=TWO, size="256x256", resize="pad").spec.observation
    assert {(c.width, c.height, c.resize) for c in sized.cameras} == {(256, 256, "pad")}
    with pytest.raises(WorkerError, match="state has 8 numbers, 'joint' has 7"):
        make(tmp_path, SMOLVLA, map=TWO, state="joint")


def test_a_picture_that_lerobot_makes_up_is_asked_of_no_camera(tmp_path: Path) -> None:
    spec = make(tmp_path, SMOLVLA, map="", state="x+y+z+rpy").spec
    assert [c.camera for c in spec.observation.cameras] == ["camera1", "camera2", "camera3"]


@pytest.mark.parametrize("kind", ["pi0", "pi05", "smolvla"])
def test_a_flow_policy_takes_the_steps_in_execution_where_it_is_told_to(
    tmp_path: Path, kind: str
) -> None:
    config = {**CONFIG, "type": kind}
    without: Any = make(tmp_path, config)
    told: Any = make(tmp_path, config, rtc="on")
    assert (without.takes_committed, told.takes_committed) == (False, True)


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
        ({"action": ""}, r"--set action=\(delta or absolute or velocity or joint_delta"),
        ({"relative_to": ""}, r"--set relative_to=\(previous or start: is a delta added"),
        ({"anchor": "tcp"}, "anchor is 'tcp', allowed: goal, measured"),
        ({"action": "velocity"}, "set rotation: rotvec"),
        ({"kind": "delta"}, r"no option 'kind'; known: action, frame"),
        ({"rotation": "euler"}, r"rotation is 'euler', allowed: rpy, rotvec, quat_xyzw, quat_wxyz"),
        ({"gripper": ""}, r"--set gripper=\(none or .* open_fraction"),
        ({"gripper_open": ""}, r"--set gripper_open=\(high or low"),
        ({"resize": "squash"}, r"resize is 'squash'"),
        ({"size": "large"}, r"size is 'large', wanted WIDTHxHEIGHT"),
        ({"dt_s": ""}, r"--set dt_s=\(seconds of a step, 1 / fps"),
        ({"dt_s": "fast"}, r"dt_s is 'fast'"),
        ({"state": ""}, r"state has 8 numbers, '' has 0"),
        ({"state": "joint"}, r"state has 8 numbers, 'joint' has 7"),
        ({"state": "joint+grip"}, r"called 'grip'; there are: joint \(one"),
        ({"map": "observation.images.hand=camera:wrist"}, r"not an image of the policy; its"),
        ({"map": "observation.images.gripper_cam=camera:front"}, r"two images .* 'front'"),
        ({"map": f"{WRIST},observation.images.front="}, r"a policy 'act' needs it"),
        ({"map": "observation.images.front=joint"}, r"front is a picture, so .*=camera:NAME"),
        ({"horizon": "101"}, r"horizon is 101; the policy's chunks have 100"),
        ({"horizon": "many"}, r"horizon is 'many'"),
        ({"rtc": "maybe"}, r"rtc is 'maybe'"),
        ({"rtc": "on"}, r"real-time chunking for pi0, pi05, smolvla, .* this is a 'act'"),
        ({"rotation": "quat_xyzw"}, r"actions have shape \(7,\); .* are \(8,\)"),
        ({"gripper": "none"}, r"actions have shape \(7,\); .* are \(6,\)"),
    ],
)
def test_an_option_that_does_not_fit_is_named(
    tmp_path: Path, options: dict[str, str], match: str
) -> None:
    with pytest.raises(WorkerError, match=match):
        make(tmp_path, **options)


@pytest.mark.parametrize(
    ("action", "kind"),
    [("joint_position", "absolute"), ("joint_delta", "delta"), ("joint_velocity", "velocity")],
)
def test_joint_actions_are_those_of_the_profile_s_arm(
    tmp_path: Path, action: str, kind: str
) -> None:
    joints = {**CONFIG, "output_features": {"action": {"type": "ACTION", "shape": [8]}}}
    made = make(tmp_path, joints, action=action, rotation="", joint_scale_rad="1")
    spec = made.spec.action
    assert (spec.space, spec.kind) == ("joint", kind)
    assert spec.joints == load_profile("panda_sim").robot.arm_joints


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
    with pytest.raises(WorkerError, match=r"joints 7 \+ gripper 1 are \(8,\)"):
        make(tmp_path, joints, action="joint_position", joint_scale_rad="1")
    with pytest.raises(WorkerError, match=r"position 3 \+ rpy 3 \+ gripper 1 are \(7,\)"):
        make(tmp_path, joints)


@pytest.mark.parametrize(
    ("config", "match"),
    [
        ({"model_type": "llama"}, "has no type; it is not a LeRobot policy"),
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
    with pytest.raises(WorkerError, match="is not there, wanted a folder"):
        make_policy(find_model("lerobot"), {"checkpoint": str(tmp_path / "nowhere")})
    with pytest.raises(WorkerError, match="give checkpoint=VALUE, with --set"):
        make_policy(find_model("lerobot"))
