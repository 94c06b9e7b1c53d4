"""The benchmark of rest: what is copied for Zenoh alone, and its figure, without a bus."""

from __future__ import annotations

import os
import time
from pathlib import Path
from typing import Any

import pytest
from vla_zenoh_figures.style import write

from benchmarks.rest import CAMERAS, NAMES, OURS, PLAIN, READS, bench_profile, draw, measured, sent
from vla_zenoh.types import NodeStatus

BUSY_S = 0.1


def status(counts: dict[str, tuple[float, float, int]]) -> NodeStatus:
    return NodeStatus("arm", "ready", "here", 1, 1, detail={"net": {"sent": counts}})


def test_zenoh_alone_is_given_the_rates_and_sizes_that_ours_had() -> None:
    before = status({"state/pose": (190.0, 38_000.0, 1000)})
    after = status({"state/pose": (200.0, 40_000.0, 3000), "spec/a": (0.5, 100.0, 1)})
    assert sent(before, after, 10.0) == {"state/pose": (200.0, 200), "spec/a": (0.5, 200)}


def test_each_camera_has_a_node_of_its_own(tmp_path: Path) -> None:
    profile = bench_profile(tmp_path)
    assert set(profile.camera_servers().values()) == set(CAMERAS)


def test_the_time_of_a_process_is_told_as_user_and_system() -> None:
    with measured({"me": os.getpid()}) as row:
        until_s = time.monotonic() + BUSY_S
        while time.monotonic() < until_s:
            pass
    user, system = row["percent"]["me"]
    assert user > 10.0
    assert system >= 0.0


def test_the_figure_has_both_ways(tmp_path: Path) -> None:
    percent = {name: [1.0, 0.5] for name in NAMES}
    rows: list[dict[str, Any]] = [{"way": way, "percent": percent} for way in (OURS, PLAIN)]
    write(draw(rows), tmp_path / "rest.svg")
    drawn = (tmp_path / "rest.svg").read_text("utf-8")
    assert all(word in drawn for word in (OURS, PLAIN, "percent of a core"))


@pytest.mark.parametrize("name", READS)
def test_every_node_reads_only_nodes_that_there_are(name: str) -> None:
    assert set(READS[name]) <= set(NAMES)
