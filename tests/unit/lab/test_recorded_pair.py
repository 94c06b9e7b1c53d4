"""Recordings of a robot of parts: what is whose, in evaluation and dataset."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
from dataset_rig import CHUNKS, HORIZON, LATENCY_MS, spec, steps_of, write_run
from pair_recording_rig import (
    BEGIN_MS,
    END_MS,
    SPEED_M_S,
    WIDTH_M,
    joints_rad,
    pair_spec,
    write_pair_run,
)
from vla_zenoh_dataset.episodes import episodes_of
from vla_zenoh_dataset.features import action_names, names_of_state, numbers_of, usual_state
from vla_zenoh_dataset.lerobot import export
from vla_zenoh_dataset.openvla import openvla_statistics
from vla_zenoh_policy_servers.state_vector import read_parts

from vla_zenoh.lab.evaluation.evaluate import combined, evaluate
from vla_zenoh.lab.recording.run import load_run
from vla_zenoh.policy import standing_step

USED, COLUMNS = 2, 6
NAMES = [
    f"{part}_{name}.pos" for part in ("left", "right") for name in ("joint1", "joint2", "gripper")
]
STATE_ATOL, MAX_WIDTH_M = 1e-6, 0.08


@pytest.fixture(scope="module")
def run_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_pair_run(tmp_path_factory.mktemp("runs") / "pair.mcap")


@pytest.fixture(scope="module")
def dataset(run_file: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("data") / "pair"
    episodes = episodes_of(load_run(run_file))
    export(out, episodes, ["front"], read_parts(usual_state(episodes)))
    return out


def test_states_and_commands_of_each_part_are_told_apart(run_file: Path) -> None:
    run = load_run(run_file)
    assert run.part_names == ("left", "right")
    for part in run.part_names:
        own = run.of_part(part)
        assert {entry.record.width_m for entry in own.grippers} == {WIDTH_M[part]}
        assert len(own.joint_commands) == CHUNKS
        assert own.chunks == run.chunks
        assert own.part_names == (part,)


def test_a_recording_of_one_arm_has_one_part_without_a_name(tmp_path: Path) -> None:
    run = load_run(write_run(tmp_path / "arm.mcap"))
    assert run.part_names == ("",)
    assert run.of_part("") is run


def test_the_motion_of_each_part_is_evaluated_by_itself(run_file: Path) -> None:
    runs, faults = evaluate([run_file])
    assert faults == {}
    assert [run.name for run in runs] == ["pair/left", "pair/right"]
    seconds = (END_MS + 490) / 1e3
    for run, speed_m_s in zip(runs, SPEED_M_S.values(), strict=True):
        assert run.path_m == pytest.approx(speed_m_s * seconds, rel=1e-6)
        assert run.requests == CHUNKS


def test_what_the_parts_have_in_common_counts_once(run_file: Path) -> None:
    runs, _ = evaluate([run_file])
    both = combined(runs)
    assert both.requests == both.executed == CHUNKS
    assert len(both.stages_ms["inference"]) == CHUNKS
    assert both.path_m == pytest.approx(sum(run.path_m or 0 for run in runs))


def test_columns_of_a_dataset_have_the_names_of_lerobots_robots_with_two_arms(
    dataset: Path,
) -> None:
    features = json.loads((dataset / "meta/info.json").read_text())["features"]
    assert features["action"]["names"] == NAMES
    assert features["observation.state"]["names"] == NAMES


@pytest.mark.parametrize("bare", ["left", "right"])
@pytest.mark.parametrize("state", ["", "joint+gripper_m"])
def test_a_part_without_a_gripper_has_no_columns_of_one(
    tmp_path: Path, bare: str, state: str
) -> None:
    episodes = episodes_of(load_run(write_pair_run(tmp_path / "pair.mcap", bare=bare)))
    export(tmp_path / "out", episodes, ["front"], read_parts(state or usual_state(episodes)))
    features = json.loads((tmp_path / "out/meta/info.json").read_text())["features"]
    for feature, count in (("action", 5), ("observation.state", 5)):
        names = features[feature]["names"]
        assert len(names) == count
        assert [name for name in names if "gripper" in name and name.startswith(bare)] == []
        assert len([name for name in names if "gripper" in name]) == 1


def test_actions_and_states_of_each_part_are_in_the_numbers_of_lerobots_robots(
    dataset: Path,
) -> None:
    table = pq.read_table(next(dataset.glob("data/*/*.parquet")))
    unit = np.array([np.pi / 180, np.pi / 180, MAX_WIDTH_M / 100] * 2)
    actions = np.array(table["action"].to_pylist()) * unit
    wanted = [steps_of(0, chunk, COLUMNS)[:USED] for chunk in range(CHUNKS)]
    np.testing.assert_allclose(actions, np.concatenate(wanted), rtol=1e-6)
    states = np.array(table["observation.state"].to_pylist()) * unit
    for number, state in enumerate(states):
        at_ms = BEGIN_MS + 5 + 100 * number + (LATENCY_MS if number < USED else 0)
        near_ms = (at_ms // 10 * 10, at_ms // 10 * 10 + 10)
        for part, own in zip(SPEED_M_S, (state[:3], state[3:]), strict=True):
            assert (
                min(np.abs(own[:2] - joints_rad(part, each)).max() for each in near_ms) < STATE_ATOL
            )
            assert own[2] == pytest.approx(WIDTH_M[part])


def test_numbers_that_are_no_positions_keep_their_names_behind_the_part(run_file: Path) -> None:
    assert action_names(pair_spec(kind="delta", gripper="delta_m").action) == [
        f"{part}_{name}"
        for part in ("left", "right")
        for name in ("joint1", "joint2", "gripper_delta_m")
    ]
    (episode,) = episodes_of(load_run(run_file))
    assert names_of_state(numbers_of(episode, read_parts("position")), episode.spec.action)[:4] == [
        *(f"left_{axis}" for axis in "xyz"),
        "right_x",
    ]


def test_one_arm_keeps_its_names() -> None:
    assert action_names(spec().action)[-1] == "gripper_open_fraction"


def test_a_chunk_that_ran_out_leaves_both_arms_where_they_are(tmp_path: Path) -> None:
    (episode,) = episodes_of(load_run(write_pair_run(tmp_path / "gap.mcap", silent=(3, 4))))
    last = steps_of(0, 2, COLUMNS)[-1]
    after = [frame.action for frame in episode.frames[2 * USED + HORIZON : 5 * USED]]
    np.testing.assert_array_equal(after, [last] * 2)
    deltas = standing_step(pair_spec(kind="delta").action, last)
    np.testing.assert_array_equal(deltas, [0, 0, last[2], 0, 0, last[5]])


def test_steps_from_the_start_of_a_chunk_become_deltas_of_each_arm(tmp_path: Path) -> None:
    model = pair_spec(kind="delta", relative_to="start")
    (episode,) = episodes_of(load_run(write_pair_run(tmp_path / "start.mcap", of=model)))
    assert {each.action.relative_to for each in episode.spec.action.parts} == {"previous"}
    steps = steps_of(0, 0, COLUMNS)
    first, second = (frame.action for frame in episode.frames[:2])
    np.testing.assert_array_equal(first, steps[0])
    for arm in (slice(0, 2), slice(3, 5)):
        np.testing.assert_allclose(second[arm], steps[1, arm] - steps[0, arm], atol=1e-7)
    np.testing.assert_array_equal(second[[2, 5]], steps[1, [2, 5]])


def test_openvla_scales_joints_and_not_grippers(dataset: Path) -> None:
    mask = openvla_statistics(dataset, "pair")["pair"]["action"]["mask"]
    assert mask == [True, True, False] * 2
