"""A person's verdict reaches the dataset by way of the recording it stands in."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path

import pyarrow.parquet as pq
import pytest
from dataset_rig import PROMPTS, write_run
from typed import typed
from vla_zenoh_dataset.episodes import episodes_of
from vla_zenoh_dataset.success import succeeded, verdict_of_person
from vla_zenoh_trial.verdict import EpisodeVerdict

from vla_zenoh.lab.recording.run import load_run
from vla_zenoh.lab.recording.verdict import FACT, Verdict


def fact(verdict: Verdict, worker: str = "teacher") -> dict[str, object]:
    judged = EpisodeVerdict(
        *(1, 1, 1, worker, verdict, "by a hair", "person", "", 2.0, 10, 0, 1, None, "a.mcap", 0)
    )
    return {FACT: asdict(judged)}


def test_only_what_a_person_called_a_success_is_exported_where_that_is_asked(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The prompt is no task that a program can judge."""
    verdicts: tuple[Verdict, ...] = ("failure", "success")
    for verdict in verdicts:
        path, commander = tmp_path / f"{verdict}.mcap", f"command#{verdict}"
        write_run(path, prompts=PROMPTS[:1], ended=fact(verdict), commander=commander)
    (episode,) = episodes_of(load_run(tmp_path / "success.mcap"))
    assert succeeded(episode) is True
    for ended, known in (
        (fact("failure"), False),
        (fact("void"), None),
        (fact("success", "somebody"), None),
        ({}, None),
        (None, None),
    ):
        episode.run.file.ended = ended
        assert succeeded(episode) is known

    out = tmp_path / "good"
    words = ("export", str(tmp_path), "--output", str(out), "--label", "success", "--json")
    done = typed(capsys, "dataset", *words)
    assert done.code == 0, done.said
    assert json.loads(done.stdout)["episodes"] == 1
    table = pq.read_table(out / "meta/episodes/chunk-000/file-000.parquet")
    assert table["run"].to_pylist() == ["success.mcap"]
    assert table["success"].to_pylist() == [True]


def test_an_episode_whose_trial_was_killed_before_the_verdict_is_void(tmp_path: Path) -> None:
    trials = tmp_path / "trials.jsonl"
    trials.write_text("")
    path = write_run(tmp_path / "episode-0002.mcap", prompts=PROMPTS[:1])
    (episode,) = episodes_of(load_run(path))
    assert verdict_of_person(episode) == "void"
    trials.unlink()
    assert verdict_of_person(episode) is None
