"""`bench sim` through the keys: a benchmark's process, a worker's process, and their ends."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from benchmark_rig import OWN_BENCHMARK, REACHER
from camera_rig import until
from chain import command_line

pytestmark = pytest.mark.long

TIMEOUT_S = 110.0
EPISODES = 40


@pytest.fixture
def model(tmp_path: Path) -> Path:
    file = tmp_path / "reacher.py"
    file.write_text(REACHER, "utf-8")
    return file


def words(model: Path, *more: str) -> list[str]:
    return ["bench", "sim", str(OWN_BENCHMARK), "--worker", str(model), *more]


def result(folder: Path) -> dict[str, Any]:
    return json.loads((folder / "result.json").read_text("utf-8"))


def test_a_worker_does_the_tasks_and_its_steps_can_be_replayed_to_the_bit(
    tmp_path: Path, model: Path
) -> None:
    out = tmp_path / "run"
    done = command_line(*words(model, "-n", "3", "-o", str(out)), timeout_s=TIMEOUT_S)
    assert done.returncode == 0, done.stderr
    found = result(out)
    assert (found["successes"], found["episodes"]) == (9, 9)
    assert [each["chunks"] for each in found["all"]] == [-(-e["steps"] // 3) for e in found["all"]]
    assert set(found["versions"]) == {"vla-zenoh", "numpy", "python"}
    assert "far" in (out / "index.html").read_text("utf-8")
    again = ["bench", "sim", str(OWN_BENCHMARK), "-n", "3", "--replay", str(out), "--json"]
    done = command_line(*again, timeout_s=TIMEOUT_S)
    assert json.loads(done.stdout)["same_end"] == 9, done.stderr


def test_a_model_that_fails_ends_the_run_with_its_own_words_and_keeps_what_was_done(
    tmp_path: Path, model: Path
) -> None:
    out = tmp_path / "run"
    asked = words(model, "--set", "fails=yes", "-n", "1", "-o", str(out))
    done = command_line(*asked, timeout_s=TIMEOUT_S)
    assert done.returncode == 1
    assert "inference_failed: ValueError: too far" in done.stderr
    assert [each["task"] for each in result(out)["all"]] == ["near", "middle"]


def test_a_run_that_was_killed_goes_on_where_it_was(tmp_path: Path, model: Path) -> None:
    out = tmp_path / "run"
    asked = words(model, "-n", str(EPISODES), "-o", str(out))
    with subprocess.Popen([sys.executable, "-m", "vla_zenoh", *asked]) as begun:
        try:
            until("an episode", lambda: lines(out), TIMEOUT_S)
        finally:
            begun.kill()
    before = lines(out)
    assert 0 < len(before) < 3 * EPISODES
    done = command_line(*asked, timeout_s=TIMEOUT_S)
    assert done.returncode == 0, done.stderr
    assert lines(out)[: len(before)] == before
    assert result(out)["episodes"] == 3 * EPISODES


def test_a_benchmark_whose_process_is_killed_begins_that_episode_again(
    tmp_path: Path, model: Path
) -> None:
    out = tmp_path / "run"
    asked = words(model, "-n", str(EPISODES), "-o", str(out), "--processes", "2")
    with subprocess.Popen([sys.executable, "-m", "vla_zenoh", *asked]) as begun:
        until("an episode", lambda: lines(out), TIMEOUT_S)
        os.kill(until("a process", lambda: environments(begun.pid), TIMEOUT_S)[-1], signal.SIGKILL)
        assert begun.wait(TIMEOUT_S) == 0
    found = result(out)
    assert (found["successes"], found["episodes"]) == (3 * EPISODES, 3 * EPISODES)
    assert len({(each["task"], each["episode"]) for each in found["all"]}) == 3 * EPISODES
    assert found["begun_again"] == 1


def lines(folder: Path) -> list[str]:
    file = folder / "episodes.jsonl"
    text = file.read_text("utf-8") if file.exists() else ""
    return [line for line in text.splitlines(keepends=True) if line.endswith("\n")]


def environments(parent: int) -> list[int]:
    """Processes of `parent` that run episodes; the first one only describes the benchmark."""
    out: list[int] = []
    for each in Path("/proc").iterdir():
        if each.name.isdigit():
            try:
                stat = (each / "stat").read_text().rpartition(")")[2].split()
                said = (each / "cmdline").read_bytes()
            except OSError:
                continue
            if int(stat[1]) == parent and b"vla_zenoh_benchmarks.process" in said:
                out.append(int(each.name))
    return sorted(out) if len(out) == 3 else []


def test_another_model_takes_over_where_it_disagrees_and_that_is_recorded(
    tmp_path: Path, model: Path
) -> None:
    astray = tmp_path / "astray.py"
    astray.write_text(REACHER.replace("np.clip(", "-np.clip("), "utf-8")
    out = tmp_path / "run"
    taken = ("--takeover", str(model), "-n", "1", "--tasks", "far", "-o", str(out))
    done = command_line(*words(astray, *taken), timeout_s=TIMEOUT_S)
    assert done.returncode == 0, done.stderr
    (episode,) = result(out)["all"]
    assert episode["success"]
    assert episode["taken_over_at"] == 4
    assert result(out)["takeover"] == "reacher"
    itself = command_line(*words(model, "--takeover", str(model), "-n", "1"), timeout_s=TIMEOUT_S)
    assert itself.returncode == 2
    assert "reacher leads already" in itself.stderr
