"""Recorded runs to a LeRobot dataset: nothing of an action is lost or invented."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np
import pyarrow.parquet as pq
import pytest
from dataset_rig import (
    CHUNK_MS,
    CHUNKS,
    DT_S,
    HEIGHT,
    HORIZON,
    KEYS,
    LATENCY_MS,
    PROFILE,
    PROMPTS,
    STATE_MS,
    WIDTH,
    ZERO_NS,
    depth_counts,
    put,
    spec,
    steps_of,
)
from dataset_rig import write_run as make_run
from made_arm import made_arm
from typed import typed
from vla_zenoh_dataset.episodes import RecordedEpisode, episodes_of, fps_of
from vla_zenoh_dataset.features import (
    Histogram,
    action_names,
    numbers_of,
    of_numbers,
    semantics_of,
    states_of,
    usual_state,
)
from vla_zenoh_dataset.lerobot import export
from vla_zenoh_dataset.openvla import openvla_statistics
from vla_zenoh_dataset.videos import chosen
from vla_zenoh_policy_servers.state_vector import read_parts

from vla_zenoh.errors import RecordingError, SpecError
from vla_zenoh.lab.evaluation.evaluate import evaluate
from vla_zenoh.lab.recording.run import Run, load_run, pictures
from vla_zenoh.lab.recording.writer import CLOCK_SET, RecordingWriter
from vla_zenoh.policy import ActionSpec, standing_step
from vla_zenoh.profile import load_profile, override
from vla_zenoh.profile.load import to_yaml
from vla_zenoh.types import Event, GripperState, JointState, NodeStatus

FPS, USED = 10, 2
"""Steps of a chunk until the next one takes over."""
PARTS = read_parts("position+rpy+gripper_m")
BRIGHTNESS = 3
"""Levels by which JPEG and H.264 together may change an evenly coloured picture."""
STATE_ATOL = 1e-6


@pytest.fixture(scope="module")
def run_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_run(tmp_path_factory.mktemp("runs") / "teach.mcap")


@pytest.fixture(scope="module")
def dataset(run_file: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("data") / "bricks"
    export(out, episodes_of(load_run(run_file)), ["front"], PARTS)
    return out


def expected_actions(activation: int) -> np.ndarray:
    """Two of each chunk's four steps; the last chunk of an activation is cut by its end."""
    return np.concatenate([steps_of(activation, chunk)[:USED] for chunk in range(CHUNKS)])


def expected_apart_s(used: int, step_s: float) -> np.ndarray:
    """The arm stood until the first chunk was published, so its steps began then."""
    apart_s = np.full(used * CHUNKS - 1, step_s)
    apart_s[used - 1] -= LATENCY_MS / 1e3
    return apart_s


def test_every_activation_is_an_episode_with_the_steps_as_they_were_published(
    run_file: Path,
) -> None:
    episodes = episodes_of(load_run(run_file))
    assert [episode.frames[0].prompt for episode in episodes] == list(PROMPTS)
    for number, episode in enumerate(episodes):
        actions = np.array([frame.action for frame in episode.frames])
        np.testing.assert_array_equal(actions, expected_actions(number))
        apart_s = np.diff([frame.stamp_ns for frame in episode.frames]) / 1e9
        np.testing.assert_allclose(apart_s, expected_apart_s(USED, DT_S))


def test_a_chunk_that_ran_out_is_followed_by_frames_that_stand_still(tmp_path: Path) -> None:
    (episode,) = episodes_of(
        load_run(make_run(tmp_path / "run.mcap", prompts=PROMPTS[:1], silent=(3, 4)))
    )
    assert len(episode.frames) == USED * CHUNKS, "time goes on"
    ran_out = steps_of(0, 2)
    after = [frame.action for frame in episode.frames[2 * USED : 5 * USED]]
    np.testing.assert_array_equal(after[:HORIZON], ran_out)
    still = np.array([0, 0, 0, 0, 0, 0, ran_out[-1, -1]], np.float32)
    np.testing.assert_array_equal(after[HORIZON:], [still] * 2)


@pytest.mark.parametrize(("percent", "used"), [(100.0, USED), (50.0, 1)])
def test_at_a_lower_speed_override_only_steps_that_the_arm_had_time_for_are_frames(
    percent: float, used: int, tmp_path: Path
) -> None:
    (episode,) = episodes_of(
        load_run(make_run(tmp_path / "slow.mcap", prompts=PROMPTS[:1], percent=percent))
    )
    wanted = np.concatenate([steps_of(0, chunk)[:used] for chunk in range(CHUNKS)])
    np.testing.assert_array_equal([frame.action for frame in episode.frames], wanted)
    apart_s = np.diff([frame.stamp_ns for frame in episode.frames]) / 1e9
    np.testing.assert_allclose(apart_s, expected_apart_s(used, DT_S * 100 / percent))


@pytest.mark.parametrize("dt_s", [0.125, 0.4 / 3, 0.5, 0.04])
def test_chunks_that_come_between_two_steps_do_not_add_any(dt_s: float, tmp_path: Path) -> None:
    run = make_run(tmp_path / "run.mcap", of=spec(dt_s=dt_s), prompts=PROMPTS[:1])
    (episode,) = episodes_of(load_run(run))
    lasts_s = CHUNK_MS * CHUNKS / 1000
    assert abs(len(episode.frames) - lasts_s / dt_s) <= 1
    stamps_s = (np.array([frame.stamp_ns for frame in episode.frames]) - ZERO_NS) / 1e9
    even_s = stamps_s[0] + dt_s * np.arange(len(stamps_s))
    assert np.abs(stamps_s - even_s).max() <= dt_s / 2 + 1e-6


@pytest.mark.parametrize("dt_s", [0.15, 0.2, 0.3, 0.5, 1.0])
def test_each_delta_that_was_executed_as_a_whole_is_a_frame_however_soon_the_next_one_came(
    dt_s: float, tmp_path: Path
) -> None:
    run = make_run(tmp_path / "run.mcap", of=spec(dt_s=dt_s, horizon=1), prompts=PROMPTS[:1])
    (episode,) = episodes_of(load_run(run))
    actions = [frame.action for frame in episode.frames if frame.action[:6].any()]
    wanted = [steps_of(0, chunk)[0] for chunk in range(CHUNKS)]
    assert len(actions) >= CHUNKS - 1, "the end of the episode may cut the last one"
    np.testing.assert_array_equal(actions, wanted[: len(actions)])
    stamps_ms = [(frame.stamp_ns - ZERO_NS) / 1e6 for frame in episode.frames]
    if dt_s > (CHUNK_MS + LATENCY_MS) / 1000:  # the arm never stood: each begins at its observation
        assert np.diff(stamps_ms[1:]) == pytest.approx(CHUNK_MS, abs=1e-3)


@pytest.mark.parametrize("dt_s", [0.3, 0.5, 1.0])
def test_targets_that_came_sooner_than_a_step_lasts_are_frames_at_the_rate_of_the_steps(
    dt_s: float, tmp_path: Path
) -> None:
    of = spec(dt_s=dt_s, horizon=1, kind="absolute")
    run = make_run(tmp_path / "run.mcap", of=of, prompts=PROMPTS[:1])
    (episode,) = episodes_of(load_run(run))
    assert abs(len(episode.frames) - CHUNK_MS * CHUNKS / 1000 / dt_s) <= 1


def test_standing_still_is_said_in_the_words_of_the_spec() -> None:
    step = np.arange(1, 9, dtype=np.float32)
    quaternion = spec(rotation="quaternion").action
    np.testing.assert_array_equal(standing_step(quaternion, step), [0, 0, 0, 0, 0, 0, 1, 8])
    absolute = spec(rotation="quaternion", kind="absolute").action
    np.testing.assert_array_equal(standing_step(absolute, step), step)
    delta = spec(gripper="delta_m").action
    np.testing.assert_array_equal(standing_step(delta, step[:7]), np.zeros(7))
    without = spec(gripper="none").action
    np.testing.assert_array_equal(standing_step(without, step[:6]), np.zeros(6))


def test_the_actions_in_the_file_are_those_of_the_chunks_to_the_bit(dataset: Path) -> None:
    table = pq.read_table(dataset / "data/chunk-000/file-000.parquet")
    actions = np.array(table["action"].to_pylist(), np.float32)
    wanted = np.concatenate([expected_actions(0), expected_actions(1)])
    np.testing.assert_array_equal(actions, wanted)
    assert table["index"].to_pylist() == list(range(len(wanted)))
    assert table["episode_index"].to_pylist() == [0] * 20 + [1] * 20
    assert table["task_index"].to_pylist() == [0] * 20 + [1] * 20
    np.testing.assert_allclose(
        table["timestamp"].to_numpy(), np.tile(np.arange(20) / FPS, 2).astype(np.float32)
    )
    assert pq.ParquetFile(dataset / "data/chunk-000/file-000.parquet").num_row_groups == 2


def test_states_are_those_of_the_frames_time(dataset: Path) -> None:
    table = pq.read_table(dataset / "data/chunk-000/file-000.parquet")
    states = np.array(table["observation.state"].to_pylist())
    assert states.shape == (40, 7)
    begin_ms = 500 + 5
    seen_ms = begin_ms + np.arange(20) * CHUNK_MS / USED
    seen_ms[:USED] += LATENCY_MS
    nearest_ms = np.round(seen_ms / STATE_MS) * STATE_MS
    np.testing.assert_allclose(states[:20, 2], nearest_ms / 1e4, atol=STATE_ATOL)
    np.testing.assert_allclose(states[:, [0, 1, 6]], [[0.4, 0.0, 0.05]] * 40, atol=STATE_ATOL)


def test_the_video_shows_the_newest_picture_of_each_frame(dataset: Path) -> None:
    for episode in range(2):
        path = dataset / f"videos/observation.images.front/chunk-000/file-00{episode}.mp4"
        with av.open(str(path)) as video:
            stream = video.streams.video[0]
            assert stream.average_rate == FPS
            frames = [(frame.time, frame.to_ndarray(format="rgb24")) for frame in video.decode()]
        assert len(frames) == 20
        for index, (time_s, rgb) in enumerate(frames):
            assert time_s == pytest.approx(index / FPS, abs=1e-4)
            assert rgb.shape == (HEIGHT, WIDTH, 3)
            at_ms = 505 + episode * (CHUNK_MS * CHUNKS + 500) + index * 100
            assert abs(float(rgb.mean()) - 2 * (at_ms // 50)) < BRIGHTNESS


def test_a_picture_that_was_overtaken_is_shown_for_no_frame(run_file: Path) -> None:
    (episode, *_) = episodes_of(load_run(run_file))
    begin_ns = episode.frames[0].stamp_ns
    stamps_ns = [begin_ns + round(at_s * 1e9) for at_s in (0.0, 0.4, 0.2, 0.2, 0.6, 0.5, 1.0, 1.4)]
    shown = chosen(episode, "front", stamps_ns)
    assert shown == sorted(shown), "the video is written in the order of reception"
    assert set(shown) == {0, 1, 4, 6, 7}
    for number, frame in zip(shown, episode.frames, strict=True):
        assert stamps_ns[number] <= frame.stamp_ns


@pytest.mark.parametrize("late_s", [0.05, 0.4, 0.9])
def test_an_episode_begins_with_the_first_image_and_shows_none_of_the_future(
    late_s: float, run_file: Path, tmp_path: Path
) -> None:
    episodes = episodes_of(load_run(run_file))
    whole = [len(episode.frames) for episode in episodes]
    first = next(iter(pictures(episodes[0].run.file, "front")))
    early = episodes[0]
    early.frames = [
        replace(frame, stamp_ns=first.stamp_ns - round((late_s - at / FPS) * 1e9))
        for at, frame in enumerate(early.frames)
    ]
    written = export(tmp_path / "out", episodes, ["front"], PARTS)
    missed = sum(frame.stamp_ns < first.stamp_ns for frame in early.frames)
    assert 0 < missed == math.ceil(late_s * FPS)
    assert written.frames == sum(whole) - missed


Cut = Callable[[RecordedEpisode], None]


def _before_the_first_image(episode: RecordedEpisode) -> None:
    first = next(iter(pictures(episode.run.file, "front")))
    before_ns = first.stamp_ns - 1_000_000
    episode.frames = [replace(frame, stamp_ns=before_ns) for frame in episode.frames]


def _beyond_the_last_image(episode: RecordedEpisode) -> None:
    *frames, last = episode.frames
    episode.frames = [*frames, replace(last, stamp_ns=last.stamp_ns + 10**10)]


def _without_states(episode: RecordedEpisode) -> None:
    begin_ns, end_ns = (episode.frames[at].stamp_ns for at in (5, 9))
    poses = [
        each for each in episode.run.poses if not begin_ns < each.header.stamp_wall_ns < end_ns
    ]
    episode.run = replace(episode.run, poses=poses)


@pytest.mark.parametrize(
    ("cut", "why"),
    [
        (_before_the_first_image, "ended before the first image"),
        (_beyond_the_last_image, r"no images of camera 'front' within 0.5 s before its frame at "),
        (_without_states, r"no state/pose within 100 ms of its frame at "),
    ],
)
def test_an_episode_with_a_gap_is_left_out_by_name_and_the_others_are_written(
    cut: Cut, why: str, run_file: Path, tmp_path: Path
) -> None:
    first, second = episodes_of(load_run(run_file))
    cut(first)
    written = export(tmp_path / "out", [first, second], ["front"], PARTS)
    (gap,) = written.left_out
    assert re.search(rf"teach.mcap: the episode at \d\.\d s .*{why}", gap)
    alone = export(tmp_path / "alone", [second], ["front"], PARTS)
    assert (written.episodes, written.frames) == (1, alone.frames)
    np.testing.assert_array_equal(states(tmp_path / "out"), states(tmp_path / "alone"))
    with pytest.raises(RecordingError, match=rf"without a gap: .*{why}.*--camera"):
        export(tmp_path / "none", [first], ["front"], PARTS)


def test_what_was_left_out_is_said(
    run_file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "gappy.mcap"
    gappy = RecordingWriter(path, KEYS, profile_yaml=PROFILE, base_frame="base", began_ns=ZERO_NS)
    for sample in load_run(run_file).file.entries():
        gone = 1e9 < sample.received_ns - ZERO_NS < 2e9
        if not (gone and sample.key == KEYS.camera_jpeg("front")):
            gappy.write(sample)
    gappy.finish({"dropped": {}})
    done = typed(capsys, "dataset", "export", str(path), "-o", str(tmp_path / "out"), "--json")
    said = json.loads(done.stdout)
    assert (done.code, said["episodes"]) == (0, 1)
    (gap,) = said["left_out"]
    assert f"left out: {gap}" in done.said.replace("\n", " ")


def test_info_names_and_types_what_the_spec_declares(dataset: Path) -> None:
    info = json.loads((dataset / "meta/info.json").read_text())
    assert info["codebase_version"] == "v3.0"
    assert (info["fps"], info["total_episodes"], info["total_frames"]) == (FPS, 2, 40)
    action = info["features"]["action"]
    assert action["names"] == ["x", "y", "z", "roll", "pitch", "yaw", "gripper_open_fraction"]
    assert (action["dtype"], action["shape"]) == ("float32", [7])
    assert info["features"]["observation.images.front"]["shape"] == [HEIGHT, WIDTH, 3]
    ours = json.loads((dataset / "meta/vla_zenoh.json").read_text())
    assert ours["spec"] == spec().to_dict()
    assert action_names(spec(rotation="quaternion", gripper="none").action)[3:] == [
        "qx",
        "qy",
        "qz",
        "qw",
    ]


def test_where_a_camera_was_and_its_lens_are_written_of_each_episode(tmp_path: Path) -> None:
    mount = {
        "frame": "front_optical_frame",
        "link": "panda_link0",
        "position_m": [1.0, 0.0, 0.5],
        "rpy_rad": [-1.9, 0.0, 1.6],
    }
    changed = override(load_profile("panda_sim"), {"cameras": {"front": {"mount": mount}}})
    run = load_run(make_run(tmp_path / "run.mcap", profile_yaml=to_yaml(changed)))
    lens = {"fx_px": 500.0, "fy_px": 500.0, "cx_px": 320.0, "cy_px": 240.0}
    said = {"cameras": {"front": {"intrinsics": lens}}}
    run.statuses["camera"] = NodeStatus("camera", "ok", "host", 1, 2, detail=said)
    export(tmp_path / "out", episodes_of(run), ["front"], PARTS)
    ours = json.loads((tmp_path / "out/meta/vla_zenoh.json").read_text())
    for episode in ours["episodes"]:
        assert episode["cameras"] == {"front": {"mount": mount, "intrinsics": lens}}


def test_openvla_statistics_are_those_of_the_actions(dataset: Path) -> None:
    actions = np.concatenate([expected_actions(0), expected_actions(1)]).astype(float)
    found = openvla_statistics(dataset, "bricks")["bricks"]
    assert found["action"]["mask"] == [True] * 6 + [False]
    assert (found["num_transitions"], found["num_trajectories"]) == (40, 2)
    for name, wanted in (
        ("q01", np.quantile(actions, 0.01, axis=0)),
        ("q99", np.quantile(actions, 0.99, axis=0)),
        ("mean", actions.mean(axis=0)),
        ("std", actions.std(axis=0)),
        ("min", actions.min(axis=0)),
        ("max", actions.max(axis=0)),
    ):
        np.testing.assert_allclose(found["action"][name], wanted, rtol=1e-12)
    assert found["proprio"]["mask"] == [True] * 6 + [False]


def test_figures_of_pictures_are_those_of_their_pixels() -> None:
    random = np.random.default_rng(0)
    colours, seen = Histogram(), []
    for _ in range(3):
        rgb = random.integers(0, 256, (40, 40, 3), np.uint8)
        colours.add(rgb)
        seen.append(rgb[::4, ::4].reshape(-1, 3) / 255)
    found, wanted = colours.statistics(), of_numbers(np.concatenate(seen))
    assert found["count"] == [3]
    for name in ("min", "max", "mean", "std"):
        np.testing.assert_allclose(np.reshape(found[name], 3), wanted[name], rtol=1e-9)
    for name in ("q01", "q10", "q50", "q90", "q99"):
        np.testing.assert_allclose(np.reshape(found[name], 3), wanted[name], atol=1.5 / 255)


@pytest.mark.parametrize(("unit_m", "unit"), [(0.001, "mm"), (0.0001, "m")])
def test_depth_is_a_column_of_files_with_every_count_of_the_recording(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], unit_m: float, unit: str
) -> None:
    run = make_run(tmp_path / "deep.mcap", depth_unit_m=unit_m)
    out, name = tmp_path / "out", "observation.images.front_depth"
    done = typed(capsys, "dataset", "export", str(run), "--output", str(out), "--json")
    assert done.code == 0, done.stderr
    assert json.loads(done.stdout)["depth"] == ["front"]
    info = json.loads((out / "meta" / "info.json").read_text())["features"][name]
    assert (info["dtype"], info["shape"]) == ("image", [HEIGHT, WIDTH, 1])
    assert info["info"] == {"is_depth_map": True, "depth_unit": unit}
    rows = pq.read_table(next((out / "data").rglob("*.parquet"))).to_pylist()
    scale = 1.0 if unit == "mm" else unit_m
    found = []
    for index, row in enumerate(rows):
        episode, frame = divmod(index, USED * CHUNKS)
        at_ms = 505 + episode * (CHUNK_MS * CHUNKS + 500) + frame * 100
        image = cv2.imdecode(np.frombuffer(row[name]["bytes"], np.uint8), cv2.IMREAD_UNCHANGED)
        np.testing.assert_allclose(image, depth_counts(at_ms // 50) * scale, rtol=1e-6)
        found.append(image[::4, ::4].reshape(-1))
    kept = json.loads((out / "meta" / "stats.json").read_text())[name]
    assert kept["count"] == [len(rows)]
    wanted = of_numbers(np.concatenate(found).astype(np.float64))
    for key in ("min", "max", "mean", "std"):
        np.testing.assert_allclose(np.reshape(kept[key], 1), wanted[key], rtol=1e-5)


def test_depth_may_be_left_out(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run = make_run(tmp_path / "deep.mcap", depth_unit_m=0.001)
    args = ("--output", str(tmp_path / "out"), "--no-depth", "--json")
    done = typed(capsys, "dataset", "export", str(run), *args)
    assert json.loads(done.stdout)["depth"] == []
    info = json.loads((tmp_path / "out" / "meta" / "info.json").read_text())
    assert not [name for name in info["features"] if "depth" in name]


def test_depths_of_two_units_do_not_become_one_dataset(tmp_path: Path) -> None:
    runs = [
        load_run(make_run(tmp_path / f"{number}.mcap", depth_unit_m=unit_m))
        for number, unit_m in enumerate((0.001, 0.0001))
    ]
    episodes = [episode for run in runs for episode in episodes_of(run)]
    with pytest.raises(RecordingError, match=r"the unit 0\.0001, before it was 0\.001.*--no-depth"):
        export(tmp_path / "out", episodes, [], PARTS, depth=["front"])


def test_the_state_of_an_arm_has_as_many_joints_as_it_was_recorded_with(
    run_file: Path, tmp_path: Path
) -> None:
    run = load_run(run_file)
    six, none = tuple(f"j{n}" for n in range(6)), np.zeros(6)
    joint = JointState(six, np.arange(6) / 10, none, none)
    run = replace(run, joints=[heard._replace(record=joint) for heard in run.poses])
    export(tmp_path / "six", episodes_of(run), [], read_parts("joint+joint_deg+gripper_m"))
    info = json.loads((tmp_path / "six" / "meta" / "info.json").read_text())
    state = info["features"]["observation.state"]
    assert state["shape"] == [13]
    assert state["names"][5:7] == ["j5", "j0_deg"]
    rows = pq.read_table(next((tmp_path / "six" / "data").rglob("*.parquet")))
    first = rows.column("observation.state")[0].as_py()
    np.testing.assert_allclose(first[:6], np.arange(6) / 10, atol=STATE_ATOL)
    np.testing.assert_allclose(first[6:12], np.rad2deg(np.arange(6) / 10), rtol=STATE_ATOL)


JOINTS = ("shoulder", "elbow", "wrist")
MAX_WIDTH_M = 0.08
"""Of the profile that the runs were recorded with."""


def joint_run(folder: Path, **action: str) -> Run:
    """A run whose worker acts in joints, with the joints it was recorded with."""
    of = spec(space="joint", joints=JOINTS, rotation="rotvec", **action)
    run = load_run(make_run(folder / "joints.mcap", of=of))
    joint = JointState(JOINTS, np.array([0.1, 0.2, 0.3]), np.zeros(3), None)
    return replace(run, joints=[heard._replace(record=joint) for heard in run.poses])


@pytest.mark.parametrize(
    ("gripper", "percent"),
    [("open_fraction", 100.0), ("absolute_m", 100.0 / MAX_WIDTH_M), ("none", 0.0)],
)
def test_positions_of_joints_are_exported_in_the_numbers_of_lerobots_robots(
    tmp_path: Path, gripper: str, percent: float
) -> None:
    episodes = episodes_of(joint_run(tmp_path, kind="absolute", gripper=gripper))
    assert usual_state(episodes) == ("joint+gripper_open" if percent else "joint")
    export(tmp_path / "out", episodes, [], read_parts(usual_state(episodes)))
    features = json.loads((tmp_path / "out" / "meta" / "info.json").read_text())["features"]
    names = [*(f"{name}.pos" for name in JOINTS), *(["gripper.pos"] if percent else [])]
    assert features["observation.state"]["names"] == features["action"]["names"] == names
    rows = pq.read_table(next((tmp_path / "out" / "data").rglob("*.parquet")))
    actions = np.array([row.as_py() for row in rows.column("action")])
    for number in range(2):
        wanted = np.concatenate(
            [steps_of(number, chunk, len(names))[:USED] for chunk in range(CHUNKS)]
        ).astype(np.float64)
        found = actions[20 * number : 20 * number + 20]
        np.testing.assert_allclose(np.radians(found[:, :3]), wanted[:, :3], rtol=1e-6)
        if percent:
            np.testing.assert_allclose(found[:, 3], percent * wanted[:, 3], rtol=1e-6)
    state = rows.column("observation.state")[0].as_py()
    np.testing.assert_allclose(np.radians(state[:3]), (0.1, 0.2, 0.3), rtol=1e-6)
    if percent:
        width_m = episodes[0].run.grippers[0].record.width_m
        assert state[3] == pytest.approx(100.0 * width_m / MAX_WIDTH_M)


def test_joints_that_are_no_positions_keep_our_names_and_units(tmp_path: Path) -> None:
    for kind, gripper in (("delta", "open_fraction"), ("absolute", "delta_m")):
        episodes = episodes_of(joint_run(tmp_path / kind, kind=kind, gripper=gripper))
        assert usual_state(episodes) == "joint+gripper_m"
        assert action_names(episodes[0].spec.action) == [*JOINTS, f"gripper_{gripper}"]


def test_a_joint_that_slides_stays_in_metres(tmp_path: Path) -> None:
    profile = made_arm(tmp_path, "sztytz")
    joints = profile.robot.arm_joints
    of = spec(space="joint", joints=joints, kind="absolute", gripper="none", rotation="rotvec")
    run = load_run(make_run(tmp_path / "lift.mcap", of=of, profile_yaml=to_yaml(profile)))
    joint = JointState(joints, np.array([0.1, 0.2, 0.3]), np.zeros(3), None)
    run = replace(run, joints=[heard._replace(record=joint) for heard in run.poses])
    episodes = episodes_of(run)
    export(tmp_path / "out", episodes, [], read_parts("joint"))
    rows = pq.read_table(next((tmp_path / "out" / "data").rglob("*.parquet")))
    columns = ("observation.state", "action")
    state, action = (np.array(rows.column(name)[0].as_py()) for name in columns)
    np.testing.assert_allclose(state, [0.1, *np.degrees([0.2, 0.3])], rtol=1e-6)
    asked = steps_of(0, 0, 3)[0].astype(np.float64)
    np.testing.assert_allclose(action, [asked[0], *np.degrees(asked[1:])], rtol=1e-6)
    ours = json.loads((tmp_path / "out" / "meta" / "vla_zenoh.json").read_text())
    scale = [float(number) for number in ours["options"]["joint_scale_rad"].split(",")]
    np.testing.assert_allclose(action * scale, asked, rtol=1e-6)
    with pytest.raises(SpecError, match="joint_deg, and joint1 slides: name joint"):
        export(tmp_path / "deg", episodes, [], read_parts("joint_deg"))


def test_joint_deltas_on_the_start_of_their_chunk_become_deltas_on_the_step_before(
    tmp_path: Path,
) -> None:
    first, *_ = episodes_of(joint_run(tmp_path, kind="delta", relative_to="start"))
    assert first.spec.action.relative_to == "previous"
    assert (first.spec.action.space, first.spec.action.joints) == ("joint", JOINTS)
    raw = steps_of(0, 0, 4)
    for index, wanted in enumerate((raw[0], raw[1] - raw[0])):
        action = first.frames[index].action
        np.testing.assert_allclose(action[:3], wanted[:3], atol=1e-7)
        assert action[3] == raw[index, 3], "the gripper is no delta"


def test_what_cannot_become_a_dataset_is_named(run_file: Path, tmp_path: Path) -> None:
    run = load_run(run_file)
    assert episodes_of(run, "somebody") == []
    with pytest.raises(RecordingError, match="hold no episode"):
        export(tmp_path / "a", [], [], PARTS)
    with pytest.raises(RecordingError, match="has no images of camera 'wrist'; it has"):
        export(tmp_path / "a", episodes_of(run), ["wrist"], PARTS)
    with pytest.raises(RecordingError, match="no state/joint"):
        export(tmp_path / "a", episodes_of(run), [], read_parts("joint"))
    assert list(tmp_path.iterdir()) == [], "nothing half done is left"
    other = load_run(make_run(tmp_path / "other.mcap", of=spec(gripper="binary")))
    with pytest.raises(RecordingError, match=r"do not mean the same.*--worker"):
        export(tmp_path / "a", [*episodes_of(run), *episodes_of(other)], [], PARTS)
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "mine").write_text("kept")
    with pytest.raises(RecordingError, match="there already"):
        export(tmp_path / "full", episodes_of(run), [], PARTS)
    nameless = load_run(make_run(tmp_path / "nameless.mcap", with_spec=False))
    with pytest.raises(RecordingError, match="spec of worker 'teacher' is not in it"):
        episodes_of(nameless)
    with pytest.raises(RecordingError, match="whole number"):
        fps_of(spec(dt_s=0.15).action)
    with pytest.raises(RecordingError, match="no LeRobot dataset"):
        openvla_statistics(tmp_path, "x")


def test_the_commands_make_a_dataset_and_its_statistics(
    run_file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "bricks"
    done = typed(capsys, "dataset", "export", str(run_file.parent), "--output", str(out), "--json")
    assert done.code == 0, done.stderr
    said = json.loads(done.stdout)
    assert (said["episodes"], said["frames"], said["cameras"]) == (2, 40, ["front"])
    done = typed(capsys, "dataset", "stats", str(out), "--name", "mine")
    assert done.code == 0, done.stderr
    assert json.loads((out / "dataset_statistics.json").read_text()).keys() == {"mine"}
    done = typed(capsys, "dataset", "export", str(run_file), "--output", str(out))
    assert done.code == 1
    assert "bricks exists; give another --output, or --force" in done.stderr


def test_wrench_and_effort_are_parts_of_a_state_where_the_robot_measured_them(
    tmp_path: Path,
) -> None:
    unmeasured = joint_run(tmp_path, kind="absolute")
    with pytest.raises(RecordingError, match="did not measure effort"):
        export(tmp_path / "none", episodes_of(unmeasured), [], read_parts("effort"))
    felt, effort = np.arange(6.0), np.array([3.0, -4.0, 0.5])
    run = replace(
        unmeasured,
        poses=[
            each._replace(record=replace(each.record, wrench=felt)) for each in unmeasured.poses
        ],
        joints=[
            each._replace(record=replace(each.record, effort_nm=effort))
            for each in unmeasured.joints
        ],
    )
    export(tmp_path / "out", episodes_of(run), [], read_parts("wrench+effort"))
    info = json.loads((tmp_path / "out" / "meta" / "info.json").read_text())
    names = info["features"]["observation.state"]["names"]
    assert names[:4] == ["force_x", "force_y", "force_z", "torque_x"]
    assert names[6:] == [f"{name}_effort" for name in JOINTS]
    rows = pq.read_table(next((tmp_path / "out" / "data").rglob("*.parquet")))
    for row in rows.column("observation.state"):
        np.testing.assert_array_equal(row.as_py(), [*felt, *effort])


@pytest.mark.parametrize(
    "action",
    [
        {},
        {"kind": "absolute", "rotation": "quaternion", "gripper": "absolute_m"},
        {"kind": "velocity", "frame": "tcp", "rotation": "rotvec", "gripper": "none"},
        {"anchor": "measured", "gripper": "binary", "gripper_threshold": 0.0},
        {"gripper": "open_fraction", "gripper_open_is_high": False},
        {"controller": {"kp": 150.0, "damping_ratio": 0.5}, "rotation": "rotvec"},
        {"space": "joint", "joints": JOINTS, "kind": "delta", "gripper": "delta_m"},
        {"space": "joint", "joints": JOINTS, "kind": "velocity", "anchor": "measured"},
        {"space": "joint", "joints": JOINTS, "kind": "absolute", "gripper": "delta_m"},
    ],
    ids=str,
)
def test_the_options_of_a_dataset_mean_what_its_spec_does(action: dict[str, Any]) -> None:
    wanted = ActionSpec.model_validate({"horizon": HORIZON, "dt_s": 0.1, **action})
    found = semantics_of(wanted, load_profile("panda_sim"))
    # Where an option says nothing the spec has its default.
    unused = {"rotation": wanted.rotation, "frame": wanted.frame, "anchor": wanted.anchor}
    assert found.spec.model_copy(update=unused) == wanted
    steps = np.random.default_rng(0).normal(0, 0.1, (HORIZON, wanted.dimension))
    if wanted.rotation == "quaternion" and wanted.space == "tcp":
        steps[:, wanted.rotation_columns] = 0.5
    np.testing.assert_allclose(found.rows(steps), steps)
    np.testing.assert_allclose(found.steps(steps), steps)


def test_a_camera_that_only_some_recordings_have_is_left_out_with_a_word(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    runs = tmp_path / "runs of today"
    make_run(runs / "one" / "up.mcap", prompts=PROMPTS[:1], cameras=("front", "wrist"))
    make_run(runs / "two" / "up.mcap", prompts=PROMPTS[:1], commander="command#2")
    words = ("export", str(runs), "-o", str(tmp_path / "out"), "--json")
    done = typed(capsys, "dataset", *words)
    assert done.code == 0, done.stderr
    assert json.loads(done.stdout)["cameras"] == ["front"]
    assert "camera wrist is left out: 1 of 2 recordings have no images of it" in done.said
    assert "two/up.mcap" in done.said


def test_a_recording_that_is_given_twice_is_exported_once(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = make_run(tmp_path / "runs" / "up.mcap", prompts=PROMPTS[:1])
    words = ("export", str(run), str(run.parent), "-o", str(tmp_path / "out"), "--json")
    done = typed(capsys, "dataset", *words)
    assert done.code == 0, done.stderr
    assert json.loads(done.stdout)["episodes"] == 1


def recorded_joints(run: Run, **position_rad: float) -> Run:
    """The run with these joints at rest."""
    names, values = tuple(position_rad), np.array([*position_rad.values()])
    record = JointState(names, values, np.zeros(len(names)), None)
    return replace(run, joints=[heard._replace(record=record) for heard in run.poses])


def states(folder: Path) -> np.ndarray:
    rows = pq.read_table(next((folder / "data").rglob("*.parquet")))
    return np.array(rows.column("observation.state").to_pylist())


def test_an_episode_that_is_in_two_recordings_is_exported_once_from_the_one_that_has_it_whole(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    runs = tmp_path / "saved"
    make_run(runs / "a.mcap", until_ms=4000)
    make_run(runs / "b.mcap")
    make_run(runs / "c.mcap", commander="command#2")
    done = typed(capsys, "dataset", "export", str(runs), "-o", str(tmp_path / "out"), "--json")
    assert done.code == 0, done.stderr
    made = json.loads(done.stdout)
    assert made["episodes"] == 2 * len(PROMPTS)
    assert made["frames"] == 2 * len(PROMPTS) * CHUNKS * USED
    whole, cut = sorted(made["left_out"], key=lambda why: "at 3.0 s" in why)
    assert "at 0.5 s is in" in whole
    assert "a.mcap: the episode at 3.0 s is in" in cut
    assert "b.mcap as well, and is taken from there" in cut


def test_an_evaluation_says_which_recordings_hold_the_same_time(tmp_path: Path) -> None:
    for name, commander in (("a", "command#1"), ("b", "command#1"), ("c", "command#2")):
        make_run(tmp_path / f"{name}.mcap", commander=commander)
    runs, _ = evaluate([tmp_path])
    told = [[why for why in run.problems if "counts twice in ALL" in why] for run in runs]
    assert [len(problems) for problems in told] == [0, 1, 0]
    assert "a.mcap" in told[1][0]


def test_an_episode_that_a_recording_ended_before_is_no_failure(tmp_path: Path) -> None:
    for until_ms, over in ((4000.0, False), (6000.0, True)):
        run = load_run(make_run(tmp_path / f"{until_ms}.mcap", until_ms=until_ms))
        assert [episode.is_over for episode in episodes_of(run)] == [True, over]


def test_recordings_of_two_robots_do_not_become_one_dataset(tmp_path: Path) -> None:
    other = load_profile("panda_sim")
    names = [f"left_{name}" for name in other.robot.arm_joints]
    robot = other.robot.model_copy(update={"arm_joints": tuple(names)})
    text = to_yaml(other.model_copy(update={"robot": robot}))
    runs = [
        load_run(make_run(tmp_path / "panda.mcap", prompts=PROMPTS[:1])),
        load_run(make_run(tmp_path / "left.mcap", prompts=PROMPTS[:1], profile_yaml=text)),
    ]
    episodes = [episode for run in runs for episode in episodes_of(run)]
    with pytest.raises(RecordingError, match=r"panda.mcap and .*left.mcap are of different robots"):
        export(tmp_path / "out", episodes, ["front"], PARTS)


def test_without_images_an_episode_whose_camera_was_not_recorded_is_exported(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = make_run(tmp_path / "up.mcap", prompts=PROMPTS[:1])
    words = ("export", str(run), "-o", str(tmp_path / "out"), "--no-images", "--json")
    done = typed(capsys, "dataset", *words)
    assert done.code == 0, done.stderr
    assert json.loads(done.stdout)["cameras"] == []


def test_joints_that_were_recorded_in_another_order_are_in_the_columns_of_their_names(
    run_file: Path, tmp_path: Path
) -> None:
    run = load_run(run_file)
    runs = recorded_joints(run, a=0.1, b=0.2), recorded_joints(run, b=0.2, a=0.1)
    episodes = [episode for each in runs for episode in episodes_of(each)]
    export(tmp_path / "out", episodes, [], read_parts("joint"))
    np.testing.assert_allclose(states(tmp_path / "out"), [[0.1, 0.2]] * 80, atol=STATE_ATOL)
    other = [*episodes, *episodes_of(recorded_joints(run, c=0.1, d=0.2))]
    with pytest.raises(
        RecordingError, match=r"teach\.mcap: the state has no joint a, b.*each robot"
    ):
        export(tmp_path / "none", other, [], read_parts("joint"))


def test_joints_that_are_published_in_another_order_are_exported_as_a_policy_is_told_them(
    run_file: Path,
) -> None:
    names = load_profile("panda_sim").robot.arm_joints
    values = dict(zip(names, np.arange(len(names)) / 10, strict=True))
    run = recorded_joints(
        load_run(run_file), **{name: values[name] for name in sorted(names)[::-1]}
    )
    episode = episodes_of(run)[0]
    found = states_of(episode, numbers_of(episode, ("joint",)))
    np.testing.assert_allclose(found, [[*values.values()]] * len(found), atol=STATE_ATOL)


def test_joints_that_a_model_names_in_another_order_are_exported_as_a_policy_is_asked_for_them(
    tmp_path: Path,
) -> None:
    names = tuple(load_profile("panda_sim").robot.arm_joints)
    found = []
    for order in (names, names[::-1]):
        of = spec(space="joint", joints=order, kind="absolute", gripper="open_fraction")
        run = make_run(tmp_path / f"{order[0]}.mcap", of=of, prompts=PROMPTS[:1])
        (episode,) = episodes_of(load_run(run))
        assert episode.spec.action.joints == names
        found.append(np.array([frame.action for frame in episode.frames]))
    one, other = found
    np.testing.assert_array_equal(one[:, : len(names)], other[:, len(names) - 1 :: -1])
    np.testing.assert_array_equal(one[:, -1], other[:, -1])


def test_a_home_that_was_changed_between_runs_does_not_change_the_signs_of_rotations(
    tmp_path: Path,
) -> None:
    profile = load_profile("panda_sim")
    home_rad = list(profile.robot.home_rad)
    home_rad[-1] += 2.0  # so far that the reference has the other sign
    robot = profile.robot.model_copy(update={"home_rad": tuple(home_rad)})
    other = to_yaml(profile.model_copy(update={"robot": robot}))
    files = [
        make_run(tmp_path / "before.mcap", prompts=PROMPTS[:1]),
        make_run(tmp_path / "after.mcap", prompts=PROMPTS[:1], profile_yaml=other),
    ]
    episodes = [episode for file in files for episode in episodes_of(load_run(file))]
    signs = [
        np.sign(numbers_of(each, ("quat_xyzw",))[""].reference[:2]).tolist() for each in episodes
    ]
    assert signs[0] != signs[1]
    export(tmp_path / "out", episodes, [], read_parts("quat_xyzw"))
    assert len(np.unique(states(tmp_path / "out").round(6), axis=0)) == 1


STREAMS = (
    *("task", "state/pose", "state/gripper", "command/pose", "delta/teacher"),
    "camera/front/jpeg",
)


@pytest.mark.parametrize(
    ("key", "by_ms"),
    [
        *((key, 2000.0) for key in (*STREAMS, "camera/front/jpeg")),
        ("state/pose", 60.0),
        ("", 3.6e6),
    ],
)
def test_a_clock_that_was_set_back_is_named_and_no_data_set_is_made_of_it(
    key: str, by_ms: float, tmp_path: Path
) -> None:
    run = load_run(make_run(tmp_path / "back.mcap", set_back=(key, 1500, by_ms)))
    (first, *_) = (each for each in run.problems if "go back" in each)
    assert f"by {by_ms / 1e3:.3f} s" in first
    assert first.startswith(("1.5 s", "1.6 s", "1.7 s"))
    with pytest.raises(RecordingError, match=r"back\.mcap: 1\.\d s after its beginning the stamps"):
        episodes_of(run)


def test_records_stay_in_the_order_in_which_they_were_made_where_a_clock_was_set_back(
    tmp_path: Path,
) -> None:
    whole = load_run(make_run(tmp_path / "whole.mcap"))
    run = load_run(make_run(tmp_path / "back.mcap", set_back=("", 1500, 2000.0)))
    heights_m = [entry.record.position_m[2] for entry in run.poses]
    assert heights_m == sorted(heights_m)
    for stream in ("poses", "tasks", "commands", "chunks"):
        stamps, wanted = (
            [entry.header.stamp_wall_ns for entry in getattr(each, stream)] for each in (run, whole)
        )
        assert stamps == wanted, stream
    assert [each.stamp_ns for each in pictures(run.file, "front")] == [
        each.stamp_ns for each in pictures(whole.file, "front")
    ]


def test_a_step_of_a_clock_that_a_node_told_of_is_named_with_its_size(tmp_path: Path) -> None:
    why = "the wall clock was set by +2.000 s"
    told = put(KEYS.event("camera"), Event("warning", "refusal", "clock_step", why), 10, 1)
    path = tmp_path / "run.mcap"
    out = RecordingWriter(path, KEYS, profile_yaml=PROFILE, base_frame="base", began_ns=ZERO_NS)
    out.write(told)
    out.finish()
    assert load_run(path).problems == [f"node#1: {why}"]


def test_times_of_reception_are_those_of_the_wall_clock_at_the_start_of_the_file(
    tmp_path: Path,
) -> None:
    path = tmp_path / "run.mcap"
    about = {CLOCK_SET: str(3600 * 10**9)}
    out = RecordingWriter(
        path, KEYS, profile_yaml=PROFILE, base_frame="base", began_ns=ZERO_NS, about=about
    )
    out.write(put(KEYS.state_gripper, GripperState(0.05, False, False), 10, 1))
    out.finish()
    assert load_run(path).began_ns == ZERO_NS + 3600 * 10**9 + 11_000_000


@pytest.mark.parametrize("by_ms", [0.0, 5.0])
def test_stamps_that_go_back_by_little_are_put_in_order(by_ms: float, tmp_path: Path) -> None:
    run = load_run(make_run(tmp_path / "run.mcap", set_back=("state/pose", 1500, by_ms + 12)))
    stamps = [entry.header.stamp_wall_ns for entry in run.poses]
    assert stamps == sorted(stamps)
    assert not run.problems
    assert len(episodes_of(run)) == len(PROMPTS)


WIDER = PROFILE.replace("max_width_m: 0.08", "max_width_m: 0.1")


@pytest.mark.parametrize(
    ("action", "state", "refused"),
    [
        ({"gripper": "open_fraction"}, "position", True),
        ({"gripper": "absolute_m"}, "position+gripper_open", True),
        ({"gripper": "none"}, "position+gripper_closed", True),
        ({"gripper": "absolute_m"}, "position+gripper_m", False),
        ({"gripper": "binary"}, "position", False),
        ({"gripper": "none"}, "position", False),
    ],
)
def test_a_share_of_two_widths_is_refused_and_metres_are_not(
    action: dict[str, str], state: str, refused: bool, tmp_path: Path
) -> None:
    said = spec(**action)
    assert WIDER != PROFILE
    runs = [
        load_run(make_run(tmp_path / f"{name}.mcap", of=said, profile_yaml=text))
        for name, text in (("one", PROFILE), ("two", WIDER))
    ]
    episodes = [episode for run in runs for episode in episodes_of(run)]
    out = tmp_path / "out"
    if not refused:
        assert export(out, episodes, [], read_parts(state)).episodes == len(episodes)
        return
    with pytest.raises(
        RecordingError, match=r"one\.mcap and .*two\.mcap have different.*0\.08 and 0\.1"
    ):
        export(out, episodes, [], read_parts(state))
    assert not out.exists()


def read_back(path: Path) -> tuple[Any, list[str]]:
    """What counts of a recording, and what is said of it."""
    try:
        run = load_run(path)
    except RecordingError as error:
        return None, [str(error)]
    streams = (run.tasks, run.poses, run.grippers, run.chunks, run.commands)
    counted = [[(one.header.stamp_wall_ns, one.key) for one in stream] for stream in streams]
    try:
        frames = [frame.action.tobytes() for each in episodes_of(run) for frame in each.frames]
        profile = run.profile.robot.gripper.max_width_m
    except RecordingError as error:
        return None, [*run.problems, str(error)]
    return (counted, frames, profile, dict(run.picture_counts)), run.problems


def test_a_byte_that_flipped_anywhere_changes_nothing_or_is_named(
    run_file: Path, tmp_path: Path
) -> None:
    """Positions all over the file, most of them where its index and facts are."""
    data, path = run_file.read_bytes(), tmp_path / "flipped.mcap"
    whole, _ = read_back(run_file)
    facts = [*range(1200), *range(len(data) - 6000, len(data))]
    random = np.random.default_rng(0)
    for at in [*random.choice(facts, 16), *random.integers(0, len(data), 8)]:
        flipped = bytearray(data)
        flipped[at] ^= 1 << int(random.integers(8))
        path.write_bytes(flipped)
        found, problems = read_back(path)
        assert found == whole or problems, at
        for said in problems:
            assert "codec" not in said
            assert "buffer" not in said


@pytest.mark.parametrize("name", [b"panda", b"vla"])
def test_a_damaged_name_of_the_robot_is_named(name: bytes, run_file: Path, tmp_path: Path) -> None:
    data, path = run_file.read_bytes(), tmp_path / "flipped.mcap"
    what = {b"panda": b"robot", b"vla": b"root"}[name]
    field = b"".join(len(each).to_bytes(4, "little") + each for each in (what, name))
    assert data.count(field) == 1
    path.write_bytes(data.replace(field, field[:-1] + b"q"))
    _, problems = read_back(path)
    assert "holds nothing of that robot, but vla/panda/" in problems[0]


@pytest.mark.parametrize("tenth", range(1, 10))
def test_a_recording_that_was_cut_off_anywhere_is_read_so_far_and_named(
    tenth: int, run_file: Path, tmp_path: Path
) -> None:
    path, data = tmp_path / "cut.mcap", run_file.read_bytes()
    path.write_bytes(data[: len(data) * tenth // 10])
    _, problems = read_back(path)
    assert any("it ends within a record); read up to there" in each for each in problems)
