"""The benchmark of many robots: its model's cost, ages, ratios and figure, without a bus."""

from __future__ import annotations

import sys
import threading
from pathlib import Path
from typing import Any

import pytest

from benchmarks.load import declared_cost
from benchmarks.load.ages import age_row
from benchmarks.load.asking import CAMERA_HZ, frame_time
from benchmarks.load.serving import Link, Setup, ask_peer, compare, fullest, read_link
from benchmarks.load.serving_figure import write_figures
from vla_zenoh.errors import NodeError
from vla_zenoh.policy import Observation
from vla_zenoh.types import Task


def row(way: str, robots: int, p95_ms: float, growth: float | None = None) -> dict[str, Any]:
    return {
        "way": way,
        "robots": robots,
        "model_ms": 80.0,
        "growth": growth,
        "age_p95_ms": p95_ms,
        "held_p95_ms": 2 * p95_ms,
        "cameras": 1,
        "side": 224,
        "jpeg": False,
        "cores": {"router": 0.2, "robots": 0.5},
        "host_cores": 2,
    }


@pytest.mark.parametrize(("robots", "growth", "asked_s"), [(1, "1", 0.04), (4, "0.5", 0.1)])
def test_an_inference_takes_what_the_model_declares(
    monkeypatch: pytest.MonkeyPatch, robots: int, growth: str, asked_s: float
) -> None:
    slept_s: list[float] = []
    monkeypatch.setattr(declared_cost.time, "sleep", slept_s.append)
    seen = Observation(1, 1, Task(1, True, "hold", "declared", 10.0))
    answers = declared_cost.DeclaredCost("40", growth).infer_batch([seen] * robots)
    assert slept_s == [pytest.approx(asked_s)]
    assert len(answers) == robots


def test_ages_are_of_all_robots_and_a_robot_without_chunks_is_an_error() -> None:
    quick = [(number / 10, number / 10 + 0.1) for number in range(9)]
    slow = [(0.0, 0.3), (0.0, 1.2)]
    found = age_row([quick, slow], took_s=2.0, oldest_s=1.0)
    assert (found["age_p50_ms"], found["chunks"], found["chunks_hz"]) == (100.0, 11, 1.0)
    assert found["worst_robot_p95_ms"] > found["age_p95_ms"] > 300.0
    assert found["robots_p50_p95_ms"][0] == [100.0, 100.0]
    assert found["too_old"] == pytest.approx(1 / 11, abs=1e-3)
    with pytest.raises(NodeError, match="had 1 chunk"):
        age_row([quick, slow[:1]], 2.0, 1.0)


def test_what_a_robot_has_gets_older_until_the_next_chunk_even_if_that_is_of_an_older_image() -> (
    None
):
    found = age_row([[(1.0, 1.1), (0.9, 1.5), (2.0, 2.1)]], took_s=2.0, oldest_s=1.0)
    assert found["held_p50_ms"] == pytest.approx(600.0, abs=10.0)
    assert found["held_p95_ms"] == pytest.approx(1050.0, abs=10.0)


def test_bytes_of_a_process_are_those_of_all_its_connections() -> None:
    told = (
        'ESTAB 0 0 127.0.0.1:1 127.0.0.1:2 users:(("a",pid=7,fd=3)) bytes_sent:5 bytes_received:2\n'
        'ESTAB 0 0 127.0.0.1:2 127.0.0.1:1 users:(("b",pid=71,fd=3)) bytes_sent:9\n'
        'ESTAB 0 0 127.0.0.1:3 127.0.0.1:4 users:(("a",pid=7,fd=4)) bytes_received:40\n'
    )
    assert read_link(told, 7) == Link(sent=5, received=42)


@pytest.mark.parametrize("peer", ["openpi", "groot"])
def test_robots_of_another_server_wait_for_each_other(peer: str) -> None:
    setup = Setup(2, 80.0, None, 10.0, 64, 2.0, cameras=2)
    found = ask_peer(peer, Path(sys.executable), setup, threading.Event())
    assert found["age_p50_ms"] > 130.0  # alone it is at most 80 and a camera's period
    assert len(found["robots_p50_p95_ms"]) == 2
    assert set(found["cores"]) == {"server", "robots"}


def test_a_server_whose_library_is_missing_is_an_error_that_names_it() -> None:
    setup = Setup(1, 50.0, None, 10.0, 64, 2.0)
    with pytest.raises(NodeError, match="lerobot"):
        ask_peer("lerobot", Path(sys.executable), setup, threading.Event())


def test_cameras_take_turns_and_a_robot_asks_with_its_newest_image() -> None:
    taken = [frame_time(100.0, robot, 4) for robot in range(4)]
    assert all(100.0 - 1 / CAMERA_HZ < at_s <= 100.0 for at_s in taken)
    assert len({round(at_s, 6) for at_s in taken}) == 4


def test_our_age_is_told_as_a_share_of_openpis_at_the_same_cost_and_number() -> None:
    rows = [row("openpi", 8, 600.0), row("batched", 8, 150.0, 0.15), row("batched", 4, 90.0, 0.15)]
    compare(rows)
    assert [each.get("p95_of_openpi") for each in rows] == [None, 0.25, None]


def test_a_full_computer_is_named_with_the_process_that_takes_most() -> None:
    busy = row("batched", 64, 400.0, 0.15)
    assert fullest(busy) == ""
    busy["cores"]["robots"] = 1.7
    assert fullest(busy) == "robots"


def test_the_figure_has_a_curve_for_each_way_but_the_one_that_lies_on_another(
    tmp_path: Path,
) -> None:
    rows = [
        row(way, robots, 100.0 * robots, growth)
        for way, growth in (("openpi", None), ("groot", None), ("alone", None), ("batched", 1.0))
        for robots in (1, 8)
    ]
    files = write_figures(tmp_path, rows)
    assert {file.name for file in files} == {
        f"serving{width}.{kind}" for width in ("", "_page") for kind in ("svg", "png", "pdf")
    }
    drawn = (tmp_path / "serving_page.svg").read_text("utf-8")
    for name in ("openpi's server", "one robot at a time", "vla-zenoh, k = 1", "held, p95 (ms)"):
        assert name in drawn
    assert "ZeroMQ" not in drawn
