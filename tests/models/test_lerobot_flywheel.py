"""`make flywheel` in small: Meta-World's expert, data set, LeRobot's trainer, and both evaluations.

20 steps teach a network nothing. What is shown: every step runs, what LeRobot's own `lerobot-eval`
does with the policy on a seed is what `bench sim` does with it as a worker, and corrections are
trained on.
"""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

pytestmark = [pytest.mark.models, pytest.mark.timeout(600)]

ROOT = Path(__file__).resolve().parents[2]
EPISODES, RUN_S = 2, 500.0
ROUNDING = 1e-6
"""Of statistics: a data set holds float32."""
SMALL = (
    "policy.dim_model=32",
    "policy.dim_feedforward=64",
    "policy.n_heads=2",
    "batch_size=2",
    "num_workers=0",
)


def run(folder: Path) -> None:
    words = ["--demonstrations", str(EPISODES), "--steps", "20", "--episodes", str(EPISODES)]
    words += ["--corrections", "1", "--more-steps", "2"]
    words += [word for each in SMALL for word in ("--train", each)]
    command = [sys.executable, "-m", "benchmarks", "flywheel", "-o", str(folder), "--delays", ""]
    done = subprocess.run(
        [*command, *words, "--until", "native-to-corrected"],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=RUN_S,
        check=False,
    )
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-4000:]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("flywheel")
    run(folder)
    return folder


def row(folder: Path, step: str) -> dict[str, Any]:
    return json.loads((folder / "rows" / f"{step}.json").read_text("utf-8"))


def test_the_expert_demonstrates_and_the_data_set_has_the_statistics_of_its_recordings(
    folder: Path,
) -> None:
    assert row(folder, "demonstrations")["successes"] == EPISODES
    written = row(folder, "dataset")
    assert written["episodes"] == EPISODES
    assert written["frames"] == sum(each["steps"] for each in row(folder, "demonstrations")["all"])
    assert written["statistics_differ_by"] < ROUNDING


def test_both_evaluations_end_every_episode_in_the_same_state_bit_by_bit(folder: Path) -> None:
    cells = row(folder, "cells")
    assert (cells["of"], cells["same"], cells["same_end"]) == (EPISODES,) * 3


def test_the_expert_takes_over_and_what_it_led_is_trained_on(folder: Path) -> None:
    (watched,) = row(folder, "takeover")["all"]
    assert watched["success"]
    led = watched["steps"] - watched["taken_over_at"]
    written, corrected = row(folder, "dataset"), row(folder, "corrected-dataset")
    assert led > 0
    assert corrected["led_by_the_expert"] == led
    assert corrected["episodes"] == EPISODES + 1
    assert corrected["frames"] == written["frames"] + led
    for step in ("corrected-training", "longer-training"):
        assert row(folder, step)["steps"] == 2
    assert row(folder, "native-to-corrected")["pairs"] == EPISODES


def test_a_second_run_does_nothing_again(folder: Path) -> None:
    def written() -> dict[str, int]:
        return {file.name: file.stat().st_mtime_ns for file in (folder / "rows").iterdir()}

    before = written()
    run(folder)
    assert written() == before
