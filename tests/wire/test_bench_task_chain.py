"""The task benchmark through real nodes: processes, pictures, keys."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from chain import command_line

TIMEOUT_S = 110.0
ORACLE = Path(__file__).parents[1] / "oracle"
"""A worker that cheats: it listens to where the objects are."""


@pytest.mark.slow
@pytest.mark.parametrize(
    ("model", "family", "successes", "failures"),
    [("hold", "put", 0, {"not_moved": 2}), ("hold", "stay", 2, {}), ("scripted", "stay", 0, None)],
)
def test_who_knows_no_task_does_none_through_the_real_chain(
    tmp_path: Path, model: str, family: str, successes: int, failures: dict[str, int] | None
) -> None:
    out = tmp_path / "run"
    words = ["bench", "task", "--model", model, "--family", family, "--episodes", "2"]
    words += ["--limit", "8", "--delay", "60", "--output", str(out)]
    done = command_line(*words, timeout_s=TIMEOUT_S)
    assert done.returncode == 0, done.stderr
    result = json.loads((out / "result.json").read_text())
    assert result["mode"] == "real_time"
    assert (result["successes"], result["episodes"]) == (successes, 2)
    assert failures is None or result["failures"] == failures
    assert result["latency_ms"]["worker-scripted.inference"][0] >= 60.0
    assert (out / "failures.jpg").exists() == (successes == 0)
    assert "worker-scripted" in (out / "nodes.log").read_text()


@pytest.mark.slow
def test_who_does_the_task_through_the_real_chain_is_said_to_have_done_it(tmp_path: Path) -> None:
    out = tmp_path / "run"
    words = ["bench", "task", "--model", "oracle", "--family", "put", "--episodes", "3"]
    words += ["--rate", "10", "--output", str(out)]
    done = subprocess.run(
        [sys.executable, "-m", "vla_zenoh", *words],
        env={**os.environ, "VLA_ZENOH_PATH": str(ORACLE)},
        capture_output=True,
        text=True,
        timeout=TIMEOUT_S,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    result = json.loads((out / "result.json").read_text())
    assert result["successes"] == 3, result["all"]
    assert result["time_to_success_s"]["p95"] < result["limit_s"]
