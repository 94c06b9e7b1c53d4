"""``vla-zenoh bench command``: which robots it is for, what it shows, and the loop beside it."""

from __future__ import annotations

import json
import os
import signal
import time
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner
from vla_zenoh_benchmarks import command_runner
from vla_zenoh_benchmarks.bare_loop import bare_loop

from vla_zenoh.errors import NodeError, ProfileError
from vla_zenoh.program.main import app


def test_a_robot_of_parts_is_rejected_before_anything_starts(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delattr(command_runner, "Host")
    out = tmp_path / "out.json"
    done = CliRunner().invoke(app, ["bench", "command", "-p", "two_pandas_sim", "-o", str(out)])
    assert isinstance(done.exception, ProfileError)
    assert str(done.exception) == (
        "the motion of bench command: for one arm only, and robot 'pair' has the parts left, right"
    )
    assert not out.exists()


SHARES = {"p50": 1.0, "p95": 2.0, "p99": 3.0, "max": 4.0}


@pytest.mark.parametrize("words", [[], ["--json"]])
def test_rates_that_were_measured_are_shown_though_a_later_one_fails(
    words: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def measured(_: Any, command_hz: float, *more: Any) -> dict[str, Any]:
        if command_hz > 500:
            raise NodeError("the command node at 1000 Hz is inactive (state comes late)")
        figures = dict.fromkeys(("held_hz", "missed_ticks", "bare_ticks", "bare_missed_ticks"), 0)
        times = dict.fromkeys(("tick_us", "late_us", "pose_age_ms"), SHARES)
        return {"command_hz": command_hz, "core_share": 0.1, "realtime": True, **figures, **times}

    monkeypatch.setattr(command_runner, "measure_command", measured)
    done = CliRunner().invoke(app, ["bench", "command", "--rates", "250,1000", *words])
    assert isinstance(done.exception, NodeError)
    if words:
        assert [row["command_hz"] for row in json.loads(done.stdout)] == [250.0]
    else:
        assert done.stdout.splitlines()[1].split()[0] == "250"


def children() -> set[int]:
    """Processes that this one has started, by any of its threads."""
    files = Path("/proc/self/task").glob("*/children")
    return {int(pid) for file in files for pid in file.read_text().split()}


def test_the_bare_loop_beside_it_counts_what_it_misses() -> None:
    before = children()
    with bare_loop(100) as bare:
        (pid,) = children() - before
        os.kill(pid, signal.SIGSTOP)
        time.sleep(0.3)
        os.kill(pid, signal.SIGCONT)
        time.sleep(0.2)
    assert 28 <= bare.missed < bare.ticks
