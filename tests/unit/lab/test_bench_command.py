"""``vla-zenoh bench command``: which robots it is for, and the loop beside it."""

from __future__ import annotations

import os
import signal
import time
from pathlib import Path

import pytest
from typer.testing import CliRunner
from vla_zenoh_benchmarks import command_runner
from vla_zenoh_benchmarks.bare_loop import bare_loop

from vla_zenoh.errors import ProfileError
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
