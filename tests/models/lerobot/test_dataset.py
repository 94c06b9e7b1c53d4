"""LeRobot itself opens what ``vla-zenoh dataset export`` wrote."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("lerobot", reason="needs LeRobot's environment: make test-models")
sys.path.append(str(Path(__file__).parents[2]))  # what all tests share
import torch
from dataset_rig import (
    CHUNK_MS,
    CHUNKS,
    DT_S,
    HEIGHT,
    LATENCY_MS,
    MIXED,
    PROMPTS,
    STATE_MS,
    WIDTH,
    depth_counts,
    steps_of,
    write_mixed_run,
    write_run,
)
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from pair_recording_rig import WIDTH_M, write_pair_run
from vla_zenoh_dataset.episodes import episodes_of
from vla_zenoh_dataset.lerobot import export
from vla_zenoh_policy_servers.presets import LEROBOT_STATE
from vla_zenoh_policy_servers.state_vector import read_parts

from vla_zenoh.lab.recording.run import load_run

pytestmark = pytest.mark.models

USED = 2
FRAMES = USED * CHUNKS
BRIGHTNESS = 3 / 255
MAX_WIDTH_M = 0.08


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    home = tmp_path_factory.mktemp("lerobot")
    episodes = episodes_of(load_run(write_run(home / "teach.mcap")))
    episodes[0].success = True
    export(home / "bricks", episodes, ["front"], read_parts("position+rpy+gripper_m"))
    return home / "bricks"


def opened(folder: Path, **more: Any) -> LeRobotDataset:
    return LeRobotDataset("local/bricks", root=folder, video_backend="pyav", **more)


def test_actions_come_back_to_the_bit(folder: Path) -> None:
    dataset = opened(folder)
    assert (len(dataset), dataset.num_episodes, dataset.fps) == (2 * FRAMES, 2, 10)
    found = np.stack([dataset[index]["action"].numpy() for index in range(len(dataset))])
    wanted = [steps_of(number, chunk)[:USED] for number in range(2) for chunk in range(CHUNKS)]
    assert found.dtype == np.float32
    np.testing.assert_array_equal(found, np.concatenate(wanted))


def test_pictures_states_and_words_belong_together(folder: Path) -> None:
    dataset = opened(folder)
    for index in (0, 1, FRAMES - 1, FRAMES, 2 * FRAMES - 1):
        item = dataset[index]
        episode, frame = divmod(index, FRAMES)
        at_ms = 505 + episode * (CHUNK_MS * CHUNKS + 500) + frame * 100
        picture = item["observation.images.front"]
        assert picture.shape == (3, HEIGHT, WIDTH)
        assert abs(float(picture.mean()) - 2 * (at_ms // 50) / 255) < BRIGHTNESS
        seen_ms = at_ms + (LATENCY_MS if frame < USED else 0)
        nearest_ms = STATE_MS * round(seen_ms / STATE_MS)
        assert float(item["observation.state"][2]) == pytest.approx(nearest_ms / 1e4, abs=1e-6)
        assert item["task"] == PROMPTS[episode]
        assert float(item["timestamp"]) == pytest.approx(frame * DT_S)


@pytest.mark.parametrize("unit_m", [0.001, 0.0001])
def test_depth_is_read_in_millimetres(tmp_path: Path, unit_m: float) -> None:
    run = write_run(tmp_path / "deep.mcap", depth_unit_m=unit_m)
    parts = read_parts("position+rpy+gripper_m")
    export(tmp_path / "deep", episodes_of(load_run(run)), ["front"], parts, depth=["front"])
    dataset, name = opened(tmp_path / "deep"), "observation.images.front_depth"
    assert dataset.meta.depth_keys == [name]
    for index in (0, FRAMES, 2 * FRAMES - 1):
        episode, frame = divmod(index, FRAMES)
        at_ms = 505 + episode * (CHUNK_MS * CHUNKS + 500) + frame * 100
        found = dataset[index][name].numpy()
        assert found.shape == (1, HEIGHT, WIDTH)
        np.testing.assert_allclose(found[0], depth_counts(at_ms // 50) * unit_m * 1e3, rtol=1e-5)
    most = float(np.reshape(dataset.meta.stats[name]["max"], 1)[0])
    assert most == pytest.approx(float(found.max()), rel=0.1)
    batch = next(iter(torch.utils.data.DataLoader(dataset, batch_size=4)))
    assert batch[name].shape == (4, 1, HEIGHT, WIDTH)


def test_an_action_chunk_of_the_future_stays_within_its_episode(folder: Path) -> None:
    dataset = opened(folder, delta_timestamps={"action": [0.0, DT_S, 2 * DT_S]})
    item = dataset[FRAMES - 2]
    np.testing.assert_array_equal(item["action"][1].numpy(), steps_of(0, CHUNKS - 1)[1])
    assert item["action_is_pad"].tolist() == [False, False, True]


def test_statistics_and_success_are_read(folder: Path) -> None:
    dataset = opened(folder)
    actions = torch.stack([dataset[index]["action"] for index in range(len(dataset))]).double()
    np.testing.assert_allclose(dataset.meta.stats["action"]["mean"], actions.mean(0), rtol=1e-9)
    assert dataset.meta.stats["observation.images.front"]["mean"].shape == (3, 1, 1)
    assert [episode["success"] for episode in dataset.meta.episodes] == [True, None]


def test_who_led_is_a_column_of_every_frame(tmp_path: Path) -> None:
    """Under the name and type that LeRobot's own rollouts with corrections have."""
    episodes = episodes_of(load_run(write_mixed_run(tmp_path / "mixed.mcap")))
    export(tmp_path / "mixed", episodes, ["front"], read_parts("position+rpy+gripper_m"))
    dataset = opened(tmp_path / "mixed")
    assert dataset.meta.features["intervention"]["dtype"] == "bool"
    assert dataset.num_episodes == 1
    each = len(dataset) // len(MIXED)
    led = [bool(dataset[index]["intervention"]) for index in range(len(dataset))]
    assert led == [False] * each + [True] * each + [False] * each
    batch = next(iter(torch.utils.data.DataLoader(dataset, batch_size=len(dataset))))
    assert batch["intervention"].sum() == each
    assert list(dataset.meta.episodes[0]["tasks"]) == [PROMPTS[0]]


def test_batches_are_made_and_one_episode_can_be_chosen(folder: Path) -> None:
    loader = torch.utils.data.DataLoader(opened(folder), batch_size=8, shuffle=True)
    batch = next(iter(loader))
    assert batch["action"].shape == (8, 7)
    assert batch["observation.images.front"].shape == (8, 3, HEIGHT, WIDTH)
    second = opened(folder, episodes=[1])
    assert len(second) == FRAMES
    np.testing.assert_array_equal(second[0]["action"].numpy(), steps_of(1, 0)[0])


def test_a_run_of_two_arms_has_the_columns_of_a_robot_with_two_arms(tmp_path: Path) -> None:
    run = write_pair_run(tmp_path / "pair.mcap")
    export(tmp_path / "pair", episodes_of(load_run(run)), ["front"], read_parts(LEROBOT_STATE))
    dataset = opened(tmp_path / "pair")
    for name in ("action", "observation.state"):
        names = dataset.features[name]["names"]
        assert names[:3] == ["left_joint1.pos", "left_joint2.pos", "left_gripper.pos"]
        assert names[3:] == [each.replace("left", "right") for each in names[:3]]
    found = np.stack([dataset[index]["action"].numpy() for index in range(len(dataset))])
    wanted = [steps_of(0, chunk, 6)[:USED] for chunk in range(CHUNKS)]
    unit = np.array([np.pi / 180, np.pi / 180, MAX_WIDTH_M / 100] * 2)
    np.testing.assert_allclose(found * unit, np.concatenate(wanted), rtol=1e-6)
    opening = 100 * WIDTH_M["right"] / MAX_WIDTH_M
    assert float(dataset[0]["observation.state"][5]) == pytest.approx(opening)
