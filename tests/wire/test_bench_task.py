"""The task benchmark through real nodes: processes, pictures, keys."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from chain import command_line

TIMEOUT_S = 110.0


@pytest.mark.slow
@pytest.mark.parametrize(
    ("model", "family", "successes", "failures"),
    [("hold", "put", 0, {"not_moved": 2}), ("hold", "stay", 2, {}), ("scripted", "stay", 0, None)],
)
def test_who_knows_no_task_does_none_through_the_real_chain(
    tmp_path: Path, model: str, family: str, successes: int, failures: dict[str, int] | None
) -> None:
    json_file, out = tmp_path / "result.json", tmp_path / "run"
    words = ["bench", "task", "--model", model, "--family", family, "--episodes", "2"]
    words += ["--limit", "8", "--delay", "60", "--json", str(json_file), "--out", str(out)]
    done = command_line(*words, timeout_s=TIMEOUT_S)
    assert done.returncode == 0, done.stderr
    result = json.loads(json_file.read_text())
    assert result["mode"] == "real_time"
    assert (result["successes"], result["episodes"]) == (successes, 2)
    assert failures is None or result["failures"] == failures
    assert result["latency_ms"]["worker-scripted.inference"][0] >= 60.0
    assert (out / "failures.jpg").exists() == (successes == 0)
    assert "worker-scripted" in (out / "nodes.log").read_text()
