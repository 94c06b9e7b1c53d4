"""An activation that a person takes over is one episode of the model, and says who led."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest
from dataset_rig import (
    CHUNK_MS,
    DT_S,
    MIXED,
    PERSON_WIDTH_M,
    TELEOP_DT_S,
    TELEOP_STEP_M,
    spec,
    steps_of,
    write_mixed_run,
    write_run,
)
from typed import typed
from vla_zenoh_dataset.episodes import RecordedEpisode, Span, episodes_of, together
from vla_zenoh_dataset.lerobot import export
from vla_zenoh_policy_servers.state_vector import read_parts

from vla_zenoh.errors import RecordingError
from vla_zenoh.lab.recording.run import load_run
from vla_zenoh.lab.recording.verdict import FACT
from vla_zenoh.policy import ControllerSpec
from vla_zenoh.profile import load_profile

PARTS = read_parts("position+rpy+gripper_m")
EACH = 10
"""Frames of each of the three parts: a second at 10 Hz."""
LED = slice(EACH + 1, 2 * EACH - 1)
"""Frames of the person alone: those at the ends have some ms of the model, whose first chunk began
when it was published and not at a multiple of a step."""
WAY_M = TELEOP_STEP_M * DT_S / TELEOP_DT_S
ATOL = 1e-6
PERIOD_M = 0.011 * TELEOP_STEP_M / TELEOP_DT_S
"""A goal is known to a command's period."""


def mixed(folder: Path, **action: Any) -> RecordedEpisode:
    of = spec(**action) if action else None
    (episode,) = episodes_of(load_run(write_mixed_run(folder / "mixed.mcap", of=of)))
    return episode


def test_a_takeover_is_one_episode_of_the_model_and_every_frame_says_who_led(
    tmp_path: Path,
) -> None:
    episode = mixed(tmp_path)
    assert (episode.worker, episode.workers) == ("teacher", ["teacher", "teleop"])
    assert len(episode.led) == len(MIXED)
    led = [frame.intervention for frame in episode.frames]
    assert led == [False] * EACH + [True] * EACH + [False] * EACH


def test_the_models_frames_are_its_steps_to_the_bit(tmp_path: Path) -> None:
    episode = mixed(tmp_path)
    for part, (since_ms, until_ms, _) in ((0, MIXED[0]), (2, MIXED[2])):
        chunks = range(since_ms // CHUNK_MS, until_ms // CHUNK_MS)
        wanted = np.concatenate([steps_of(part, seq)[:2] for seq in chunks])
        frames = episode.frames[part * EACH : (part + 1) * EACH]
        np.testing.assert_array_equal([frame.action for frame in frames], wanted)


def test_the_persons_frames_are_what_the_arm_was_asked_for_in_the_models_numbers(
    tmp_path: Path,
) -> None:
    actions = np.array([frame.action for frame in mixed(tmp_path).frames])[LED]
    np.testing.assert_allclose(actions[:, 1], WAY_M, atol=PERIOD_M)
    np.testing.assert_allclose(actions[:, [0, 2, 3, 4, 5]], 0.0, atol=ATOL)
    shares = actions[:, 6]
    most_m = load_profile("panda_sim").robot.gripper.max_width_m
    assert shares[0] == pytest.approx(0.05 / most_m), "nothing was commanded: the measured width"
    assert shares[-1] == pytest.approx(PERSON_WIDTH_M / most_m)


@pytest.mark.parametrize(
    ("action", "columns", "wanted"),
    [
        ({"frame": "tcp"}, [0, 1, 2], [0.0, -WAY_M, 0.0]),
        ({"position_scale_m": 0.1}, [1], [10 * WAY_M]),
        ({"rotation": "quaternion"}, [1, 3, 4, 5, 6], [WAY_M, 0, 0, 0, 1]),
        ({"gripper": "delta_m"}, [1], [WAY_M]),
        ({"gripper": "open_fraction", "gripper_open_is_high": False}, [1], [WAY_M]),
        ({"kind": "velocity", "rotation": "rotvec"}, [1], [WAY_M / DT_S]),
    ],
)
def test_they_are_told_in_the_words_of_every_spec(
    action: dict[str, Any], columns: list[int], wanted: list[float], tmp_path: Path
) -> None:
    actions = np.array([frame.action for frame in mixed(tmp_path, **action).frames])[LED]
    scale = 1 / action.get("position_scale_m", DT_S if action.get("kind") == "velocity" else 1.0)
    for column, value in zip(columns, wanted, strict=True):
        np.testing.assert_allclose(actions[:, column], value, atol=ATOL + scale * PERIOD_M)


def test_absolute_poses_are_the_goals_themselves(tmp_path: Path) -> None:
    episode = mixed(tmp_path, kind="absolute", rotation="quaternion")
    person = [frame for frame in episode.frames if frame.intervention]
    since_ns, until_ns, _ = episode.led[1]
    assert len(person) == EACH
    for frame in person:
        led_s = (min(frame.stamp_ns + round(DT_S * 1e9), until_ns) - since_ns) / 1e9
        y_m = TELEOP_STEP_M * led_s / TELEOP_DT_S
        np.testing.assert_allclose(frame.action[:3], [0.4, y_m, 0.3], atol=2 * PERIOD_M)
        np.testing.assert_allclose(frame.action[3:7], [1, 0, 0, 0], atol=ATOL)


def test_a_controller_that_covers_a_part_of_each_step_is_no_words_for_a_person(
    tmp_path: Path,
) -> None:
    action = {"controller": ControllerSpec(kp=150.0), "rotation": "rotvec"}
    with pytest.raises(RecordingError, match=r"covers only a part.*--worker"):
        mixed(tmp_path, **action)


def test_what_the_person_led_can_be_exported_alone(tmp_path: Path) -> None:
    run = load_run(write_mixed_run(tmp_path / "mixed.mcap"))
    (episode,) = episodes_of(run, "teleop")
    assert episode.spec.name == "teleop"
    assert all(frame.intervention for frame in episode.frames)
    assert [each.worker for each in episodes_of(run, "teacher")] == ["teacher"]
    assert episodes_of(run, "somebody") == []


def test_an_episode_without_a_person_has_no_intervention(tmp_path: Path) -> None:
    for episode in episodes_of(load_run(write_run(tmp_path / "run.mcap"))):
        assert not any(frame.intervention for frame in episode.frames)


def test_the_column_has_the_name_and_type_of_lerobots_own(tmp_path: Path) -> None:
    export(tmp_path / "out", [mixed(tmp_path)], ["front"], PARTS)
    info = json.loads((tmp_path / "out/meta/info.json").read_text())
    assert info["features"]["intervention"] == {"dtype": "bool", "shape": [1], "names": None}
    table = pq.read_table(tmp_path / "out/data/chunk-000/file-000.parquet")
    led = [False] * EACH + [True] * EACH + [False] * EACH
    assert table["intervention"].to_pylist() == led
    stats = json.loads((tmp_path / "out/meta/stats.json").read_text())
    assert stats["intervention"]["mean"] == pytest.approx([1 / 3])
    (ours,) = json.loads((tmp_path / "out/meta/vla_zenoh.json").read_text())["episodes"]
    assert [each["worker"] for each in ours["led"]] == ["teacher", "teleop", "teacher"]


def test_episodes_are_chosen_by_their_label_and_discarded_ones_only_where_they_are_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    runs = tmp_path / "runs"
    for verdict in ("success", "failure", "void"):
        fact = {FACT: {"worker": "teleop", "verdict": verdict, "note": ""}}
        write_mixed_run(runs / f"{verdict}.mcap", ended=fact, commander=f"command#{verdict}")

    def exported(*words: str) -> list[str]:
        out = tmp_path / f"out{len(list(tmp_path.iterdir()))}"
        command = ("export", str(runs), "--output", str(out), *words, "--json")
        done = typed(capsys, "dataset", *command)
        assert done.code == 0, done.said
        said = json.loads(done.stdout)
        assert said["interventions"] == EACH * said["episodes"]
        table = pq.read_table(out / "meta/episodes/chunk-000/file-000.parquet")
        assert sorted(said["labels"]) == sorted(set(table["label"].to_pylist()))
        return sorted(table["label"].to_pylist())

    assert exported() == ["failure", "success"]
    assert exported("--label", "success") == ["success"]
    assert exported("--label", "discarded", "--label", "failure") == ["discarded", "failure"]
    words = ("export", str(runs), "-o", str(tmp_path / "none"), "--label", "unknown")
    done = typed(capsys, "dataset", *words)
    assert done.code == 1
    assert "no episode has the label unknown; there are: 1 failure, 1 success" in done.said


def test_a_person_who_begins_gives_the_arm_to_a_model_in_the_same_episode(tmp_path: Path) -> None:
    spans: list[Span] = [(0, 1, "teleop"), (1, 2, "a"), (2, 3, "teleop"), (3, 4, "b"), (5, 6, "b")]
    found = [[worker for _, _, worker in led] for led in together(spans, {"teleop"})]
    assert found == [["teleop", "a", "teleop"], ["b"], ["b"]]
