"""The LeRobot worker gives what LeRobot itself gives, and names what does not fit."""

from __future__ import annotations

import json
import shutil
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("lerobot", reason="needs LeRobot's environment: make test-models")
import tiny_act
import torch
from lerobot.common.control_utils import predict_action
from lerobot.configs import PreTrainedConfig
from lerobot.policies.act.configuration_act import ACTConfig
from lerobot.policies.act.modeling_act import ACTPolicy
from lerobot.policies.factory import make_pre_post_processors
from lerobot.policies.rtc.modeling_rtc import RTCProcessor
from safetensors.torch import load_file, save_file

from vla_zenoh.errors import WorkerError
from vla_zenoh.kinematics.so3 import exp3, quat_from_rotation
from vla_zenoh.lab.check.examination import Examination
from vla_zenoh.lab.check.examples import example_observation
from vla_zenoh.lab.check.model_runner import ModelRunner
from vla_zenoh.policy import check_steps
from vla_zenoh.policy.inference import Committed
from vla_zenoh.policy.loader import find_model, make_policy
from vla_zenoh.profile import load_profile
from vla_zenoh.types import GripperState, PoseState

pytestmark = pytest.mark.models

ATOL = 1e-6
"""Metres and radians, of float32."""
ACTION_OPTIONS = {
    "action": "delta",
    "anchor": "goal",
    "relative_to": "previous",
    "controller": "none",
    "rotation": "rpy",
    "gripper": "open_fraction",
    "gripper_open": "high",
    "dt_s": "0.1",
    "state": "position+rotvec+gripper_m",
}
STATE = [0.4, 0.1, 0.3, 3.0, 0.2, -0.1, 0.05]
"""Its tool points down, as at home: of another the rotation vector nearest to that is told."""


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("lerobot") / "act"
    tiny_act.write(folder)
    return folder


@pytest.fixture
def folder(whole: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(whole, tmp_path / "act"))


def make(folder: Path, **options: str) -> Any:
    given = {"checkpoint": str(folder), "device": "cpu", **ACTION_OPTIONS, **options}
    return make_policy(find_model("lerobot"), given)


def loaded(folder: Path, **options: str) -> Any:
    policy = make(folder, **options)
    policy.load()
    return policy


def looking(policy: Any, seed: int) -> Any:
    shape = (tiny_act.HEIGHT, tiny_act.WIDTH, 3)
    picture = np.random.default_rng(seed).integers(0, 256, shape, dtype=np.uint8)
    picture.setflags(write=False)  # as pictures from the bus are
    quat_xyzw = quat_from_rotation(exp3(np.array(STATE[3:6])))
    return replace(
        example_observation(policy.spec),
        images={"front": picture},
        pose=PoseState(np.array(STATE[:3]), quat_xyzw, np.zeros(6)),
        gripper=GripperState(width_m=STATE[6], moving=False, holding=False),
    )


def lerobots_own(folder: Path, seen: Any, count: int) -> np.ndarray:
    """(count, D) actions by LeRobot's own loading, `predict_action` and queue."""
    config = PreTrainedConfig.from_pretrained(folder)
    assert isinstance(config, ACTConfig)
    config.pretrained_backbone_weights = None
    policy = ACTPolicy.from_pretrained(folder, config=config)
    before, after = make_pre_post_processors(policy.config, pretrained_path=str(folder))
    given = {
        "observation.images.front": seen.images["front"].copy(),
        "observation.state": np.array(STATE, np.float32),
    }
    steps = [
        predict_action(given, policy, torch.device("cpu"), before, after, use_amp=False)
        for _ in range(count)
    ]
    return torch.cat(steps).numpy()


@pytest.fixture(autouse=True)
def no_download(monkeypatch: pytest.MonkeyPatch) -> None:
    """LeRobot by itself would fetch weights that those of the directory then replace."""

    def refuse(*_: Any, **__: Any) -> None:
        raise AssertionError("a download")

    monkeypatch.setattr("torchvision.models._api.load_state_dict_from_url", refuse)


@pytest.mark.parametrize("seed", range(3))
def test_a_chunk_is_what_lerobots_own_queue_gives(whole: Path, seed: int) -> None:
    policy = loaded(whole)
    seen = looking(policy, seed)
    steps = check_steps(policy.spec.action, policy.infer(seen).steps)
    assert steps.shape == (tiny_act.STEPS, tiny_act.ACTION_SIZE)
    np.testing.assert_allclose(steps, lerobots_own(whole, seen, tiny_act.STEPS), atol=ATOL)


def test_the_whole_chunk_can_be_had(whole: Path) -> None:
    policy = loaded(whole, horizon=str(tiny_act.CHUNK))
    seen = looking(policy, 0)
    steps = np.asarray(policy.infer(seen).steps)
    assert policy.spec.action.horizon == tiny_act.CHUNK
    first = lerobots_own(whole, seen, tiny_act.STEPS)
    np.testing.assert_allclose(steps[: tiny_act.STEPS], first, atol=ATOL)


def test_actions_are_in_the_units_of_the_data(whole: Path) -> None:
    policy = loaded(whole)
    answer = policy.infer(looking(policy, 0))
    scale = tiny_act.STATISTICS["action"]
    raw = np.asarray(answer.raw["normalised"])
    wanted = raw * scale["std"].numpy() + scale["mean"].numpy()
    np.testing.assert_allclose(np.asarray(answer.steps), wanted, atol=1e-5)


def test_joints_are_given_on_as_the_policy_says_them(tmp_path: Path) -> None:
    home_rad = load_profile("panda_sim").robot.home_rad
    mean = torch.tensor([*home_rad, 0.5])
    tiny_act.write(tmp_path / "act", {"mean": mean, "std": torch.full((8,), 0.05)})
    policy = loaded(tmp_path / "act", action="joint_position", joint_scale_rad="1", rotation="")
    seen = looking(policy, 0)
    steps = check_steps(policy.spec.action, policy.infer(seen).steps)
    own = lerobots_own(tmp_path / "act", seen, tiny_act.STEPS)
    np.testing.assert_allclose(steps, own, atol=ATOL)


def test_picture_and_state_both_matter(whole: Path) -> None:
    policy = loaded(whole)
    seen = looking(policy, 0)
    other = replace(seen, gripper=GripperState(width_m=0.0, moving=False, holding=False))
    first, second, third = (
        np.asarray(policy.infer(each).steps) for each in (seen, looking(policy, 1), other)
    )
    assert np.abs(first - second).max() > 1e-5
    assert np.abs(first - third).max() > 1e-5


def test_a_policy_that_averages_chunks_is_asked_step_by_step(tmp_path: Path) -> None:
    tiny_act.write(tmp_path / "act", temporal_ensemble_coeff=0.01, n_action_steps=1)
    policy = loaded(tmp_path / "act")
    assert policy.spec.action.horizon == 1
    seen = looking(policy, 4)
    steps = np.concatenate([np.asarray(policy.infer(seen).steps) for _ in range(5)])
    np.testing.assert_allclose(steps, lerobots_own(tmp_path / "act", seen, 5), atol=ATOL)
    policy.reset()
    np.testing.assert_allclose(np.asarray(policy.infer(seen).steps), steps[:1], atol=ATOL)


def test_missing_weights_are_not_made_up(folder: Path) -> None:
    content = load_file(folder / "model.safetensors")
    del content["model.action_head.bias"]
    save_file(content, folder / "model.safetensors")
    with pytest.raises(WorkerError, match=r"(?s)LeRobot cannot load .*model.action_head.bias"):
        loaded(folder)


def test_weights_that_are_not_numbers_are_named(folder: Path) -> None:
    content = load_file(folder / "model.safetensors")
    content["model.action_head.bias"][0] = float("inf")
    save_file(content, folder / "model.safetensors")
    with pytest.raises(WorkerError, match=r"model.action_head.bias .* holds NaN or infinity"):
        loaded(folder)


def test_a_file_that_was_cut_off_is_an_error(folder: Path) -> None:
    content = (folder / "model.safetensors").read_bytes()
    (folder / "model.safetensors").write_bytes(content[:1000])
    with pytest.raises(WorkerError, match=r"LeRobot cannot load .*Safetensor"):
        loaded(folder)


def test_pickled_weights_are_not_read(folder: Path) -> None:
    (folder / "model.safetensors").rename(folder / "pytorch_model.bin")
    with pytest.raises(WorkerError, match=r"has no model.safetensors, but .*pickles are not"):
        loaded(folder)


def test_a_device_that_is_not_there_is_an_error(whole: Path) -> None:
    with pytest.raises(WorkerError, match="LeRobot cannot load"):
        loaded(whole, device="cuda:99")


def test_a_pipeline_that_names_code_is_refused(folder: Path) -> None:
    file = folder / "policy_preprocessor.json"
    content = json.loads(file.read_text())
    content["steps"].append({"class": "os.system", "config": {}})
    file.write_text(json.dumps(content))
    with pytest.raises(WorkerError, match=r"'os.system' is not one of LeRobot's own"):
        loaded(folder)


def test_a_policy_without_pipelines_says_how_to_get_them(folder: Path) -> None:
    (folder / "policy_postprocessor.json").unlink()
    with pytest.raises(WorkerError, match=r"has no policy_postprocessor.json: .*migrate_policy"):
        loaded(folder)


STATISTICS_FILES = {
    "policy_preprocessor.json": ["observation.state", "observation.images.front"],
    "policy_postprocessor.json": ["action"],
}


def change(folder: Path, pipeline: str, edit: Callable[[dict[str, Any]], None]) -> None:
    """Edit the statistics that a pipeline of a directory scales with."""
    steps = json.loads((folder / pipeline).read_text())["steps"]
    (name,) = [step["state_file"] for step in steps if "state_file" in step]
    content = load_file(folder / name)
    edit(content)
    save_file(content, folder / name)


@pytest.mark.parametrize(
    ("pipeline", "feature"), [(p, f) for p, features in STATISTICS_FILES.items() for f in features]
)
@pytest.mark.parametrize(
    ("how", "why"),
    [
        ("missing", "there are no statistics of it; there are those of"),
        ("prefix", r"there are those of: .*so101\.{}"),
        ("no std", "std of it are missing; there are: .*mean"),
        ("nan", "its mean holds NaN or infinity"),
        ("zero", "std of its number 0 is 0: the number never changed"),
        ("shape", "its std has the shape"),
    ],
)
def test_a_policy_without_what_its_numbers_are_scaled_with_is_refused(
    folder: Path, pipeline: str, feature: str, how: str, why: str
) -> None:
    """LeRobot itself passes such a feature on as it is (huggingface/lerobot#4415)."""

    def edit(content: dict[str, Any]) -> None:
        own = {key: content.pop(key) for key in [*content] if key.rpartition(".")[0] == feature}
        mean, std = f"{feature}.mean", f"{feature}.std"
        if how == "prefix":
            own = {f"so101.{key}": value for key, value in own.items()}
        elif how == "no std":
            del own[std]
        elif how == "nan":
            own[mean].view(-1)[0] = float("nan")
        elif how == "zero":
            own[std].view(-1)[0] = 0.0
        elif how == "shape":
            own[std] = torch.ones(2)
        if how != "missing":
            content.update(own)

    change(folder, pipeline, edit)
    with pytest.raises(WorkerError, match=why.format(feature)) as refused:
        loaded(folder)
    assert feature in str(refused.value)
    assert pipeline in str(refused.value)


def test_a_policy_saved_without_statistics_is_refused(tmp_path: Path) -> None:
    tiny_act.write(tmp_path / "act", statistics={})
    with pytest.raises(WorkerError, match=r"images.front is scaled by MEAN_STD, and"):
        loaded(tmp_path / "act")


def test_check_names_the_feature_that_has_no_statistics(folder: Path) -> None:
    change(folder, "policy_postprocessor.json", lambda content: content.clear())
    report = Examination(make(folder), "act", ModelRunner(60.0), runs=1).run()
    (finding,) = (each for each in report.findings if each.level == "error")
    assert finding.name == "load_failed"
    assert "action is scaled by MEAN_STD" in finding.why
    assert "there are no statistics of it" in finding.why


def test_a_pipeline_that_does_not_scale_is_refused(folder: Path) -> None:
    file = folder / "policy_postprocessor.json"
    content = json.loads(file.read_text())
    content["steps"] = [s for s in content["steps"] if "normal" not in s["registry_name"]]
    file.write_text(json.dumps(content))
    with pytest.raises(WorkerError, match=r"no step that scales, .* action are scaled by MEAN_STD"):
        loaded(folder)


def test_a_pipeline_that_scales_otherwise_than_its_policy_was_trained_is_refused(
    folder: Path,
) -> None:
    file = folder / "policy_postprocessor.json"
    content = json.loads(file.read_text())
    for step in content["steps"]:
        if "normal" in step["registry_name"]:
            step["config"]["norm_map"]["ACTION"] = "IDENTITY"
    file.write_text(json.dumps(content))
    with pytest.raises(WorkerError, match=r"ACTION is scaled by IDENTITY, .* config says MEAN_STD"):
        loaded(folder)


class Flow:
    """A flow towards one chunk, conditioned by LeRobot's own real-time chunking."""

    def __init__(self, config: Any, rtc: Any, horizon: int, columns: int) -> None:
        self.config, self._rtc = config, RTCProcessor(rtc)
        self._shape = (1, horizon, columns)

    def predict_action_chunk(
        self,
        batch: dict[str, Any],
        prev_chunk_left_over: Any = None,
        inference_delay: int = 0,
        execution_horizon: int | None = None,
    ) -> torch.Tensor:
        assert batch.get("action") is None
        x, count = torch.zeros(self._shape) + 2.0, 10  # as pi0, pi0.5 and SmolVLA
        for index in range(count):
            time = 1.0 - index / count
            x = (
                x
                - self._rtc.denoise_step(
                    x_t=x,
                    prev_chunk_left_over=prev_chunk_left_over,
                    inference_delay=inference_delay,
                    time=time,
                    original_denoise_step_partial=lambda noisy, time=time: noisy / time,
                    execution_horizon=execution_horizon,
                ).detach()
                / count
            )
        return x


def test_the_steps_in_execution_come_back_from_lerobots_real_time_chunking(whole: Path) -> None:
    policy = loaded(whole)
    free = policy.infer(looking(policy, 1)).steps
    horizon, columns = free.shape
    policy.takes_committed = True
    policy.policy = Flow(
        policy.policy.config, model_module(policy)._rtc_config(horizon), horizon, columns
    )
    planned = policy.infer(looking(policy, 1)).steps
    wanted = (planned + 0.1).astype(np.float32)[: horizon - 1]
    frozen = 2
    found = policy.infer(looking(policy, 1), committed=Committed(wanted, frozen)).steps
    # The flow itself is sure of its own chunk, 0.1 away. The guidance of the last of ten steps has
    # the weight 9.11, a tenth of which is added, so 91 % of the way are gone.
    np.testing.assert_allclose(found[:frozen], planned[:frozen] + 0.0911, atol=1e-3)
    np.testing.assert_allclose(found[-1], planned[-1], atol=1e-4)  # nothing is committed there


def model_module(policy: Any) -> Any:
    return sys.modules[type(policy).__module__]
