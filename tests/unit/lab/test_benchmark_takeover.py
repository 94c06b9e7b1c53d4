"""A teacher that watches a model on a benchmark, takes over, and is an intervention in the data."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import typer
from benchmark_rig import Reacher, own_benchmark, request
from vla_zenoh_benchmarks.cli import BenchmarkEpisodes
from vla_zenoh_benchmarks.contract import BenchmarkObservation
from vla_zenoh_benchmarks.episode import EpisodeConditions, EpisodeOutcome
from vla_zenoh_benchmarks.process import run_episode
from vla_zenoh_benchmarks.recorded import EpisodeRecorder, recording_file
from vla_zenoh_benchmarks.takeover import WINDOW_S, Takeover
from vla_zenoh_dataset.episodes import RecordedEpisode, episodes_of
from vla_zenoh_dataset.success import succeeded

from vla_zenoh.lab.recording.run import load_run
from vla_zenoh.profile import load_profile
from vla_zenoh.types import ActionChunk

TEACHER = "teacher"


class Wrong(Reacher):
    """Turns every motion by an angle, and teaches nothing."""

    def __init__(self, turn_rad: float, share: float = 1.0) -> None:
        super().__init__(1)
        cos, sin = share * np.cos(turn_rad), share * np.sin(turn_rad)
        self._turn = np.array([[cos, -sin], [sin, cos]])

    def ask(self, seen: BenchmarkObservation) -> ActionChunk:
        found = super().ask(seen)
        steps = found.steps.copy()
        steps[:, :2] = steps[:, :2] @ self._turn.T
        return replace(found, steps=steps)


def corrected(
    folder: Path, model: Reacher, disagreement: float = 0.7, worker: str | None = None
) -> tuple[EpisodeOutcome, RecordedEpisode]:
    """An episode with a teacher that reaches the mark, and its recording."""
    benchmark, wanted = own_benchmark(), request("far")
    path = recording_file(folder, wanted.key)
    profile = load_profile("panda_sim")
    recorder = EpisodeRecorder(path, profile, "wrong", model.spec, [], benchmark.action)
    teacher = Reacher(1)
    teacher.worker = TEACHER
    takeover = Takeover(teacher, disagreement)
    outcome = run_episode(benchmark, wanted, model, EpisodeConditions(), recorder, takeover)
    recorder.finish(success=outcome.success, steps=outcome.steps)
    (episode,) = episodes_of(load_run(path), worker)
    return outcome, episode


@pytest.mark.parametrize("model", [Wrong(np.pi / 2), Wrong(np.pi), Wrong(0.0, 0.0)])
def test_a_model_that_goes_astray_is_taken_over_and_the_teacher_finishes(
    tmp_path: Path, model: Wrong
) -> None:
    outcome, episode = corrected(tmp_path, model)
    window = round(WINDOW_S / own_benchmark().action.dt_s)
    assert outcome.taken_over_at == window - 1
    assert outcome.success
    assert succeeded(episode)
    assert episode.worker == "wrong"
    led = [frame.intervention for frame in episode.frames]
    assert led == [index >= window - 1 for index in range(outcome.steps)]


def test_every_frame_has_the_step_that_was_carried_out_whoever_led(tmp_path: Path) -> None:
    outcome, episode = corrected(tmp_path, Wrong(np.pi))
    recorded = np.array([frame.action for frame in episode.frames])
    np.testing.assert_allclose(recorded, np.array(outcome.actions), atol=1e-7)


def test_what_the_teacher_led_alone_is_an_episode_of_its_own(tmp_path: Path) -> None:
    outcome, episode = corrected(tmp_path, Wrong(np.pi), worker=TEACHER)
    assert outcome.taken_over_at is not None
    assert succeeded(episode)
    own = np.array(outcome.actions[outcome.taken_over_at :], np.float32)
    np.testing.assert_array_equal([frame.action for frame in episode.frames], own)


@pytest.mark.parametrize("model", [Wrong(0.0), Wrong(np.pi / 8)])
def test_a_model_that_goes_about_the_teachers_way_keeps_the_arm(
    tmp_path: Path, model: Wrong
) -> None:
    outcome, episode = corrected(tmp_path, model)
    assert outcome.taken_over_at is None
    assert outcome.success
    assert not any(frame.intervention for frame in episode.frames)


def test_how_far_both_may_differ_is_told(tmp_path: Path) -> None:
    turned = Wrong(np.pi / 8)  # apart by 0.39 of the teacher's motion
    assert corrected(tmp_path / "loose", turned, 0.45)[0].taken_over_at is None
    assert corrected(tmp_path / "strict", turned, 0.35)[0].taken_over_at is not None


@pytest.mark.parametrize(
    ("options", "named"),
    [
        ({"delay_ms": 100.0}, "--delay"),
        ({"composition": "blend"}, "--composition"),
        ({"takeover": TEACHER, "mode": "live"}, "--takeover"),
        ({"disagreement": 0.5}, "--disagreement"),
    ],
)
def test_an_option_without_the_one_it_belongs_to_is_an_error_that_names_both(
    options: dict[str, Any], named: str
) -> None:
    with pytest.raises(typer.BadParameter, match=f"^{named}: .*(add|leave out) --"):
        BenchmarkEpisodes(**options).conditions  # noqa: B018
