"""Episodes of a benchmark recorded as those of a robot, and exported as training data."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest
from benchmark_rig import Reacher, own_benchmark, request
from vla_zenoh_benchmarks.contract import BenchmarkObservation
from vla_zenoh_benchmarks.episode import EpisodeConditions, EpisodeOutcome
from vla_zenoh_benchmarks.process import run_episode
from vla_zenoh_benchmarks.recorded import EpisodeRecorder, recording_file
from vla_zenoh_dataset.episodes import RecordedEpisode, episodes_of
from vla_zenoh_dataset.lerobot import export
from vla_zenoh_dataset.success import succeeded

from vla_zenoh.errors import RecordingError
from vla_zenoh.lab.recording.run import load_run, pictures
from vla_zenoh.profile import load_profile

CAMERA = "above"


def watched() -> Any:
    """The example's benchmark with a camera, whose picture says how far the hand came."""
    benchmark: Any = own_benchmark()
    observe = benchmark.observe

    def look(cameras: Sequence[str]) -> BenchmarkObservation:
        seen = observe(cameras)
        shade = round(255 * abs(seen.pose.position_m[1]))
        return seen._replace(images={c: np.full((48, 64, 3), shade, np.uint8) for c in cameras})

    benchmark.observe = look
    return benchmark


def recorded(folder: Path, episode: int = 0, steps: int = 3) -> tuple[EpisodeOutcome, Path]:
    """An episode of the example, and its recording."""
    benchmark, worker = watched(), Reacher(steps)
    wanted = request("far", episode)
    path = recording_file(folder, wanted.key)
    recorder = EpisodeRecorder(
        path, load_profile("panda_sim"), "reacher", worker.spec, [CAMERA], benchmark.action
    )
    outcome = run_episode(benchmark, wanted, worker, EpisodeConditions(), recorder)
    recorder.finish(success=outcome.success, steps=outcome.steps)
    return outcome, path


def the_episode(path: Path) -> RecordedEpisode:
    (episode,) = episodes_of(load_run(path))
    episode.success = succeeded(episode)
    return episode


@pytest.mark.parametrize("steps", [1, 3])
def test_every_step_is_a_frame_with_the_action_that_was_carried_out(
    tmp_path: Path, steps: int
) -> None:
    outcome, path = recorded(tmp_path, steps=steps)
    episode = the_episode(path)
    assert outcome.steps > 3
    assert len(episode.frames) == outcome.steps
    np.testing.assert_array_equal(
        [frame.action for frame in episode.frames], np.array(outcome.actions, np.float32)
    )
    assert np.ptp(np.diff([frame.stamp_ns for frame in episode.frames])) <= 1
    assert {frame.prompt for frame in episode.frames} == {request("far").task.prompt}


def test_state_and_picture_of_a_frame_are_those_before_its_step(tmp_path: Path) -> None:
    outcome, path = recorded(tmp_path)
    run = load_run(path)
    benchmark, wanted = own_benchmark(), request("far")
    benchmark.reset(wanted.suite, wanted.task.name, wanted.episode)
    for index, action in enumerate(outcome.actions):
        seen = benchmark.observe([CAMERA])
        assert seen.pose is not None
        np.testing.assert_array_equal(run.poses[index].record.position_m, seen.pose.position_m)
        benchmark.step(action)
    stamps = [picture.stamp_ns for picture in pictures(run.file, CAMERA)]
    assert stamps == [pose.header.stamp_wall_ns for pose in run.poses]


def test_its_label_is_the_verdict_of_the_benchmark(tmp_path: Path) -> None:
    outcome, path = recorded(tmp_path)
    assert outcome.success
    assert the_episode(path).label.value == "success"


def test_an_episode_that_did_not_end_leaves_no_recording(tmp_path: Path) -> None:
    path = recording_file(tmp_path, "reach/far/0")
    spec = Reacher().spec
    action = own_benchmark().action
    for _ in range(2):  # the second attempt begins anew
        recorder = EpisodeRecorder(path, load_profile("panda_sim"), "reacher", spec, [], action)
        recorder.begin("go")
        recorder.abandon()
    assert not path.exists()


def test_a_hand_that_never_turns_is_exported_without_rotations(tmp_path: Path) -> None:
    outcome, path = recorded(tmp_path / "runs")
    folder = tmp_path / "data"
    export(folder, [the_episode(path)], [CAMERA], ["position"], rotation=False)
    (file,) = (folder / "data").rglob("*.parquet")
    actions = np.array(pq.read_table(file)["action"].to_pylist(), np.float32)
    np.testing.assert_array_equal(actions, np.array(outcome.actions, np.float32)[:, :3])
    info = json.loads((folder / "meta" / "info.json").read_text())
    assert info["features"]["action"]["names"] == ["x", "y", "z"]
    options = json.loads((folder / "meta" / "vla_zenoh.json").read_text())["options"]
    assert options["rotation"] == "none"


def test_policies_that_plan_another_number_of_steps_make_one_data_set(tmp_path: Path) -> None:
    runs = [recorded(tmp_path / name, steps=count) for name, count in (("a", 1), ("b", 3))]
    folder = tmp_path / "data"
    export(folder, [the_episode(path) for _, path in runs], [CAMERA], ["position"])
    info = json.loads((folder / "meta" / "info.json").read_text())
    assert info["total_episodes"] == 2
    assert info["total_frames"] == sum(outcome.steps for outcome, _ in runs)


def test_a_number_that_never_changed_has_a_std_to_scale_with(tmp_path: Path) -> None:
    _, path = recorded(tmp_path / "runs")
    folder = tmp_path / "data"
    export(folder, [the_episode(path)], [CAMERA], ["position", "gripper_m"])
    told = json.loads((folder / "meta" / "stats.json").read_text())["observation.state"]
    x, _, z, gripper = told["std"]
    assert (z, gripper) == (1.0, 1.0)  # the hand stays at its height, the gripper open
    assert 0.0 < x < 0.5
    assert told["min"][2:] == told["max"][2:] == told["mean"][2:]


def test_a_hand_that_turns_is_not(tmp_path: Path) -> None:
    _, path = recorded(tmp_path / "runs")
    episode = the_episode(path)
    turned = episode.frames[0].action.copy()
    turned[4] = 0.1
    episode.frames[0] = replace(episode.frames[0], action=turned)
    with pytest.raises(RecordingError, match="steps that turn the hand"):
        export(tmp_path / "data", [episode], [CAMERA], ["position"], rotation=False)
