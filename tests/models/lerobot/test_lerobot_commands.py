"""LeRobot's own commands, from their first word to their end: record, replay, teleoperate, rollout.

A leader whose pan swings is followed by a simulated SO-101 behind our limits.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("lerobot", reason="needs LeRobot's environment: make test-models")
sys.path.append(str(Path(__file__).parents[2]))  # what all tests share
from plugin_rig import FPS, HEIGHT, NAMES, SWING_DEG, WIDTH, Leader, install, lerobot, running_arm
from plugin_rig import write_leader as leader_of

sys.path.insert(0, str(Path(__file__).parent))
from chain import Chain
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from test_flywheel import SMALL

from vla_zenoh.bus.buffers import CallbackRing
from vla_zenoh.bus.node import Node
from vla_zenoh.bus.session import open_session
from vla_zenoh.types import JointState

pytestmark = [pytest.mark.models, pytest.mark.timeout(280)]

SECONDS, TASK, REPO = 4, "follow the leader", "local/follow"
MOVED_RAD = np.radians(5.0)


@pytest.fixture(scope="module")
def home(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("commands")


@pytest.fixture(scope="module")
def site(home: Path) -> Path:
    install(home / "site")
    return home / "site"


@pytest.fixture(scope="module")
def arm(home: Path) -> Iterator[Chain]:
    with running_arm(home) as chain:
        yield chain


@pytest.fixture(scope="module")
def leader(home: Path, arm: Chain) -> Iterator[list[str]]:
    file = leader_of(home, arm)
    with Leader(arm.profile):
        yield ["--teleop.type=vla_zenoh", f"--teleop.profile={file}"]


@pytest.fixture(scope="module")
def robot(arm: Chain) -> list[str]:
    own = ["--robot.type=vla_zenoh", f"--robot.profile={arm.profile_file}", f"--robot.fps={FPS}"]
    return [*own, "--play_sounds=false"]


@pytest.fixture(scope="module")
def recorded(site: Path, home: Path, robot: list[str], leader: list[str]) -> Path:
    """A data set of one episode that ``lerobot-record`` wrote."""
    words = [f"--dataset.repo_id={REPO}", f"--dataset.root={home / 'data'}"]
    words += [f"--dataset.fps={FPS}", f"--dataset.single_task={TASK}", "--dataset.num_episodes=1"]
    words += [f"--dataset.episode_time_s={SECONDS}", "--dataset.reset_time_s=0"]
    lerobot(site, "record", *robot, *leader, *words, "--dataset.push_to_hub=false")
    return home / "data"


class Watch:
    """How far the pan of an arm moved while a block ran."""

    def __init__(self, arm: Chain) -> None:
        self._arm = arm
        self.moved_rad = 0.0

    def __enter__(self) -> Watch:
        self._session = open_session(self._arm.profile.session)
        self._node = Node("watch", self._arm.profile, self._session)
        self._ring = self._node.subscribe(self._node.keys.state_joint, CallbackRing(100_000))
        return self

    def __exit__(self, *_: object) -> None:
        found = [self._node.decode(JointState, each) for each in self._ring.drain()]
        pan_rad = [float(each.record.position_rad[0]) for each in found if each is not None]
        self.moved_rad = float(np.ptp(pan_rad)) if pan_rad else 0.0
        self._node.close()
        self._session.close()


def test_record_writes_an_episode_of_the_arm_that_followed(recorded: Path) -> None:
    info = json.loads((recorded / "meta" / "info.json").read_text("utf-8"))
    features = info["features"]
    assert info["total_episodes"] == 1
    assert info["total_frames"] >= SECONDS * FPS - FPS
    assert features["action"]["names"] == features["observation.state"]["names"] == NAMES
    assert features["observation.images.front"]["shape"][:2] == [HEIGHT, WIDTH]
    data = LeRobotDataset(REPO, root=recorded)
    pan_deg = [float(row["observation.state"][0]) for row in data]
    assert np.ptp(pan_deg) > SWING_DEG / 2
    assert {row["task"] for row in data} == {TASK}


def test_replay_moves_the_arm_as_it_was_recorded(
    site: Path, recorded: Path, robot: list[str], arm: Chain
) -> None:
    words = [f"--dataset.repo_id={REPO}", f"--dataset.root={recorded}", "--dataset.episode=0"]
    with Watch(arm) as seen:
        lerobot(site, "replay", *robot, *words, f"--dataset.fps={FPS}")
    assert seen.moved_rad > MOVED_RAD


def test_teleoperate_follows_the_leader(
    site: Path, robot: list[str], leader: list[str], arm: Chain
) -> None:
    with Watch(arm) as seen:
        lerobot(
            *(site, "teleoperate", *robot[:-1], *leader),
            *(f"--fps={FPS}", f"--teleop_time_s={SECONDS}"),
        )
    assert seen.moved_rad > MOVED_RAD


def test_rollout_runs_a_policy_that_was_trained_on_the_recording(
    site: Path, recorded: Path, home: Path, robot: list[str], arm: Chain
) -> None:
    words = [f"--dataset.repo_id={REPO}", f"--dataset.root={recorded}", "--policy.type=act"]
    words += [f"--policy.{name}={value}" for name, value in SMALL.items()]
    words += ["--policy.device=cpu", "--policy.push_to_hub=false", f"--output_dir={home / 'act'}"]
    words += ["--steps=2", "--batch_size=2", "--num_workers=0", "--env_eval_freq=0"]
    lerobot(site, "train", *words)
    policy = home / "act" / "checkpoints" / "last" / "pretrained_model"
    with Watch(arm) as seen:
        lerobot(
            *(site, "rollout", *robot, f"--policy.path={policy}", "--device=cpu"),
            *(f"--task={TASK}", f"--fps={FPS}", f"--duration={SECONDS}"),
        )
    assert seen.moved_rad > 0.0
