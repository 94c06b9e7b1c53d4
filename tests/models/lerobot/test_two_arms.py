"""A policy of two arms by LeRobot: 14 numbers as in ALOHA's data, each of the joint it is for."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("lerobot", reason="needs LeRobot's environment: make test-models")
import tiny_act
import torch
from lerobot.common.control_utils import predict_action
from lerobot.policies.act.modeling_act import ACTPolicy
from lerobot.policies.factory import make_pre_post_processors

from vla_zenoh.errors import WorkerError
from vla_zenoh.lab.check.examples import example_observation
from vla_zenoh.policy import check_steps
from vla_zenoh.policy.loader import find_model, make_policy
from vla_zenoh.types import GripperState, JointState

pytestmark = pytest.mark.models

ATOL = 1e-6
"""Radians and opening, of float32."""
JOINTS = tuple(f"{name}_joint" for name in ("shoulder_pan", "shoulder_lift", "elbow")) + tuple(
    f"wrist_{number}_joint" for number in (1, 2, 3)
)
COLUMNS = 14
URDF = Path(__file__).parents[3] / "profiles" / "ur5e.urdf"
PROFILE = f"""
extends: two_pandas_sim
robot:
  description: {URDF}
  base_frame: base
  tcp_frame: tool0
  arm_joints: [{", ".join(JOINTS)}]
  home_rad: [0.0, -1.5708, 1.5708, -1.5708, -1.5708, 0.0]
limits:
  joint: {{velocity_rad_s: 0.5, acceleration_rad_s2: 2.0, jerk_rad_s3: 40.0}}
"""
MEAN = np.array([*np.linspace(-0.6, 0.4, 6), 0.5, *np.linspace(0.5, -0.5, 6), 0.4], np.float32)
OPTIONS = {
    "device": "cpu",
    "state": "joint+gripper_open",
    "action": "joint_position",
    "joint_scale_rad": "1",
    "gripper": "open_fraction",
    "gripper_open": "high",
    "dt_s": "0.02",
}
POSITION_RAD = {"left": np.linspace(0.1, 0.6, 6), "right": np.linspace(-0.7, -0.2, 6)}
WIDTH_M = {"left": 0.02, "right": 0.06}
OPEN_M = 0.08


@pytest.fixture(scope="module")
def act(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("aloha") / "act"
    action = {"mean": torch.from_numpy(MEAN), "std": torch.linspace(0.01, 0.1, COLUMNS)}
    state = {"mean": torch.linspace(-0.2, 0.2, COLUMNS), "std": torch.linspace(0.5, 1.5, COLUMNS)}
    tiny_act.write(folder, action, state)
    return folder


@pytest.fixture(scope="module")
def pair(tmp_path_factory: pytest.TempPathFactory) -> Path:
    file = tmp_path_factory.mktemp("profile") / "pair.yaml"
    file.write_text(PROFILE)
    return file


def loaded(act: Path, pair: Path, **options: str) -> Any:
    given = {"checkpoint": str(act), "profile": str(pair), **OPTIONS, **options}
    policy = make_policy(find_model("lerobot"), given)
    policy.load()
    return policy


def looking(policy: Any, seed: int) -> Any:
    shape = (tiny_act.HEIGHT, tiny_act.WIDTH, 3)
    image = np.random.default_rng(seed).integers(0, 256, shape, dtype=np.uint8)
    seen = example_observation(policy.spec)
    still = np.zeros(6)
    parts = {
        part: replace(
            own,
            joint=JointState(JOINTS, POSITION_RAD[part], still, still),
            gripper=GripperState(width_m=WIDTH_M[part], moving=False, holding=False),
        )
        for part, own in seen.parts.items()
    }
    return replace(seen, images={"front": image}, parts=parts)


def own_state(*order: str) -> np.ndarray:
    each = [[*POSITION_RAD[part], WIDTH_M[part] / OPEN_M] for part in order]
    return np.concatenate(each).astype(np.float32)


def lerobots_own(folder: Path, seen: Any, state: np.ndarray) -> np.ndarray:
    """(STEPS, 14) actions by LeRobot's own loading, `predict_action` and queue."""
    config = ACTPolicy.config_class.from_pretrained(folder)
    config.pretrained_backbone_weights = None
    policy = ACTPolicy.from_pretrained(folder, config=config)
    before, after = make_pre_post_processors(policy.config, pretrained_path=str(folder))
    given = {"observation.images.front": seen.images["front"], "observation.state": state}
    steps = [
        predict_action(given, policy, torch.device("cpu"), before, after, use_amp=False)
        for _ in range(tiny_act.STEPS)
    ]
    return torch.cat(steps).numpy()


@pytest.mark.parametrize("seed", range(3))
def test_a_chunk_of_both_arms_is_what_lerobots_own_queue_gives(
    act: Path, pair: Path, seed: int
) -> None:
    policy = loaded(act, pair)
    seen = looking(policy, seed)
    steps = check_steps(policy.spec.action, policy.infer(seen).steps)
    assert steps.shape == (tiny_act.STEPS, COLUMNS)
    own = lerobots_own(act, seen, own_state("left", "right"))
    np.testing.assert_allclose(steps, own, atol=ATOL)


def test_columns_are_of_the_joints_and_the_gripper_of_each_arm_in_turn(
    act: Path, pair: Path
) -> None:
    action = loaded(act, pair).spec.action
    assert [each.part for each in action.parts] == ["left", "right"]
    assert (action.columns("left"), action.columns("right")) == (slice(0, 7), slice(7, 14))
    for part in ("left", "right"):
        assert action.of(part).joints == JOINTS
        assert action.of(part).gripper == "open_fraction"


def test_arms_may_have_been_trained_in_the_other_order(act: Path, pair: Path) -> None:
    policy = loaded(act, pair, parts="right,left")
    seen = looking(policy, 0)
    steps = check_steps(policy.spec.action, policy.infer(seen).steps)
    assert policy.spec.action.columns("right") == slice(0, 7)
    own = lerobots_own(act, seen, own_state("right", "left"))
    np.testing.assert_allclose(steps, own, atol=ATOL)


def test_the_state_of_either_arm_matters(act: Path, pair: Path) -> None:
    policy = loaded(act, pair)
    seen = looking(policy, 0)
    whole = np.asarray(policy.infer(seen).steps)
    for part, own in seen.parts.items():
        shut = replace(own, gripper=GripperState(width_m=0.0, moving=False, holding=False))
        other = policy.infer(replace(seen, parts={**seen.parts, part: shut}))
        assert np.abs(np.asarray(other.steps) - whole).max() > 1e-6


def test_parts_that_the_robot_lacks_are_named(act: Path, pair: Path) -> None:
    with pytest.raises(WorkerError, match=r"parts is 'left,middle'; the robot's are: left, right"):
        loaded(act, pair, parts="left,middle")


def test_numbers_of_two_arms_are_refused_by_a_robot_of_one(act: Path) -> None:
    with pytest.raises(WorkerError, match=r"the model's state has 14 numbers, .* has 8"):
        loaded(act, Path("panda_sim"))


def test_numbers_for_other_arms_are_refused(act: Path) -> None:
    with pytest.raises(WorkerError, match=r"left joints 7 \+ left gripper 1 \+ right joints 7"):
        loaded(act, Path("two_pandas_sim"), state="zero*7")
