"""From a demonstration to a policy: recorded, exported, trained by LeRobot, run by our worker.

The small loop of docs/how-to/demonstration-to-policy.md, on a virtual clock, so the machine's speed
does not matter. 20 steps teach a network nothing: what is shown is that the numbers mean the same
all the way round.
"""

from __future__ import annotations

import json
import re
import shlex
import sys
from collections.abc import Mapping
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("lerobot", reason="needs LeRobot's environment: make test-models")
sys.path.append(str(Path(__file__).parents[2]))  # what all tests share
import torch
import typer
from lerobot.common.control_utils import predict_action
from lerobot.configs import PreTrainedConfig
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.policies.factory import get_policy_class, make_pre_post_processors
from lockstep_rig import Stage, activate, record
from vla_zenoh_dataset.cli import export as dataset_export

from vla_zenoh.errors import WorkerError
from vla_zenoh.policy import Observation, Policy
from vla_zenoh.policy.loader import find_model, make_policy
from vla_zenoh.profile import load_profile
from vla_zenoh.types import GripperState, JointState, Task

pytestmark = [pytest.mark.models, pytest.mark.timeout(600)]

PAGE = Path(__file__).parents[3] / "docs/how-to/demonstration-to-policy.md"
PROMPTS = ("put the red brick in the box", "put the blue brick in the box")
SECONDS, FPS, WIDTH, HEIGHT = 4.0, 10, 160, 120
STEPS, CHUNK = 20, 8
SAME = 1e-5
MOVED_RAD = 0.05
PROFILE = f"""\
extends: so101_sim
cameras:
  front: {{source: "sim:front", width: {WIDTH}, height: {HEIGHT}, rate_hz: {FPS}}}
  wrist: null
workers: [scripted_pick, lerobot]
task: {{prompt: hold, rate_hz: 5, worker: WORKER}}
"""
SMALL = {
    "chunk_size": CHUNK,
    "n_action_steps": CHUNK,
    "dim_model": 32,
    "n_heads": 2,
    "dim_feedforward": 64,
    "n_encoder_layers": 1,
    "n_vae_encoder_layers": 1,
    "latent_dim": 4,
    "pretrained_backbone_weights": "null",
}
"""A tiny ACT; what LeRobot fetches from a hub otherwise, it begins at random."""


def write_profile(folder: Path, worker: str) -> str:
    path = folder / f"{worker}.yaml"
    path.write_text(PROFILE.replace("WORKER", worker))
    return str(path)


def run_lerobot(program: str, *words: str) -> None:
    """Run a command of LeRobot in this process: to import torch anew takes longer than most."""
    command = import_module(f"lerobot.scripts.{program.replace('-', '_')}")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", [program, *words])
        command.main()


def run_export(*words: str) -> None:
    """``vla-zenoh dataset export``, also where its package is on the path without its metadata."""
    app = typer.Typer()
    app.command()(dataset_export)
    app(words, standalone_mode=False)


def words_of_page(program: str, home: Path) -> list[str]:
    """The words of a command of the page, begun in `home`."""
    text = re.sub(r" *\\\n {8,}", " ", PAGE.read_text("utf-8"))
    (line,) = re.findall(rf"^ {{4}}({program} .*)$", text, re.MULTILINE)
    line = line.replace("$PWD", str(home)).replace("output_dir=act", f"output_dir={home / 'act'}")
    return shlex.split(line)


@pytest.fixture(scope="module")
def home(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("flywheel")


@pytest.fixture(scope="module")
def dataset(home: Path) -> Path:
    """Two scripted episodes in the simulator, exported by the command."""
    profile = write_profile(home, "scripted_pick")
    demonstrator = make_policy(find_model("scripted_pick"), {"profile": profile})
    stage = Stage(load_profile(profile))
    record(stage, demonstrator, home / "runs" / "demo.mcap", PROMPTS, SECONDS)
    run_export(str(home / "runs"), "-o", str(home / "bricks"))
    return home / "bricks"


@pytest.fixture(scope="module")
def trained(dataset: Path, home: Path) -> Path:
    """What ``lerobot-train`` leaves after a few steps."""
    program, *words = words_of_page("lerobot-train", home)
    small = [f"--policy.{name}={value}" for name, value in SMALL.items()]
    run_lerobot(program, *words, *small, f"--steps={STEPS}", "--batch_size=2", "--num_workers=0")
    return home / "act"


@pytest.fixture(scope="module")
def worker(trained: Path, home: Path) -> Policy:
    """Our worker, told nothing but where the checkpoint is."""
    profile = write_profile(home, "lerobot")
    policy = make_policy(
        find_model("lerobot"), {"checkpoint": str(trained), "device": "cpu"}, profile=profile
    )
    policy.load()  # pyright: ignore[reportAttributeAccessIssue]
    return policy


def observation_of(item: Mapping[str, Any], max_width_m: float) -> Observation:
    """A frame of the data set as the worker is given it, converted here and nowhere else."""
    state = item["observation.state"].double().numpy()
    names = load_profile("so101_sim").robot.arm_joints
    picture = (item["observation.images.front"] * 255).round().to(torch.uint8)
    return Observation(
        *(0, 0, Task(0, False, item["task"], "lerobot", 5.0)),
        images={"front": picture.permute(1, 2, 0).numpy()},
        joint=JointState(names, np.radians(state[:5]), np.zeros(5), None),
        gripper=GripperState(state[5] / 100 * max_width_m, moving=False, holding=False),
    )


def test_the_data_set_says_what_its_policy_will_mean(dataset: Path) -> None:
    opened = LeRobotDataset("local/bricks", root=dataset, video_backend="pyav")
    assert (opened.num_episodes, opened.fps) == (2, FPS)
    options = json.loads((dataset / "meta" / "vla_zenoh.json").read_text())["options"]
    assert options["action"] == "joint_position"
    assert options["gripper_range"] == "0:100"
    assert (options["state"], options["dt_s"]) == ("joint+gripper_open", "0.1")


def test_the_worker_knows_everything_from_the_data_set(worker: Policy) -> None:
    spec = worker.spec
    (camera,) = spec.observation.cameras
    assert (camera.camera, camera.width, camera.height) == ("front", WIDTH, HEIGHT)
    assert spec.observation.state == ("joint", "gripper")
    assert (spec.action.space, spec.action.kind) == ("joint", "absolute")
    assert spec.action.dt_s == pytest.approx(1 / FPS)
    assert spec.action.horizon == CHUNK
    assert spec.action.gripper == "open_fraction"


@pytest.mark.parametrize("index", [0, 50])
def test_its_chunk_is_what_lerobots_own_predict_action_gives(
    worker: Policy, trained: Path, dataset: Path, index: int
) -> None:
    folder = trained / "checkpoints" / "last" / "pretrained_model"
    config = PreTrainedConfig.from_pretrained(folder)
    config.device = "cpu"
    theirs = get_policy_class(config.type).from_pretrained(folder, config=config)
    before, after = make_pre_post_processors(config, pretrained_path=str(folder))
    item = LeRobotDataset("local/bricks", root=dataset, video_backend="pyav")[index]
    seen = observation_of(item, 0.1)
    raw = {
        "observation.images.front": np.array(seen.images["front"]),
        "observation.state": item["observation.state"].numpy(),
    }
    theirs.reset()
    wanted = [
        predict_action(raw, theirs, torch.device("cpu"), before, after, use_amp=False)
        for _ in range(CHUNK)  # from the queue of one chunk
    ]
    rows = np.concatenate([each.double().numpy().reshape(1, -1) for each in wanted])
    found = np.asarray(worker.infer(seen).steps)
    np.testing.assert_allclose(np.degrees(found[:, :5]), rows[:, :5], atol=SAME * 100)
    np.testing.assert_allclose(found[:, :5], np.radians(rows[:, :5]), atol=SAME)
    np.testing.assert_allclose(found[:, 5], rows[:, 5] / 100, atol=SAME)


def test_it_drives_the_simulated_arm(worker: Policy, home: Path) -> None:
    stage = Stage(load_profile(write_profile(home, "lerobot")))
    loop = stage.loop(worker, seed=1)
    activate(loop, PROMPTS[0])
    loop.run(3.0)
    assert loop.commander.task.active, loop.commander.why
    assert not loop.refused
    joints = [each.position_rad for each in loop.trace.joints if each is not None]
    assert np.abs(np.ptp(joints, axis=0)).max() > MOVED_RAD


def test_what_the_data_set_says_is_overridden_and_another_one_rejected(
    worker: Policy, trained: Path, dataset: Path, tmp_path: Path
) -> None:
    given = {"checkpoint": str(trained), "device": "cpu"}
    slower = make_policy(find_model("lerobot"), {**given, "dt_s": "0.2"}, profile="so101_sim")
    assert slower.spec.action.dt_s == pytest.approx(0.2)
    named = make_policy(
        find_model("lerobot"), {**given, "dataset": str(dataset)}, profile="so101_sim"
    )
    assert named.spec == worker.spec
    with pytest.raises(WorkerError, match=re.escape(f"{tmp_path} is no data set of")):
        make_policy(find_model("lerobot"), {**given, "dataset": str(tmp_path)})
    moved = dataset.rename(dataset.with_name("elsewhere"))
    try:
        with pytest.raises(WorkerError, match="the meaning of the numbers is missing"):
            make_policy(find_model("lerobot"), {**given, "state": "joint+gripper_open"})
    finally:
        moved.rename(dataset)
