"""The benchmark of many robots: its model's cost, ages, ratios and figure, without a bus."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from benchmarks.load import declared_cost
from benchmarks.load.serving import CAMERA_HZ, Ages, compare, frame_time, fullest
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


def test_ages_are_of_all_robots_and_a_robot_without_a_chunk_is_an_error() -> None:
    found = Ages([[100.0] * 9, [300.0, 1200.0]]).row(took_s=2.0, oldest_s=1.0)
    assert (found["age_p50_ms"], found["chunks"], found["chunks_hz"]) == (100.0, 11, 1.0)
    assert found["worst_robot_p95_ms"] > found["age_p95_ms"] > 300.0
    assert found["too_old"] == pytest.approx(1 / 11, abs=1e-3)
    with pytest.raises(NodeError, match="no chunk"):
        Ages([[100.0], []]).row(2.0, 1.0)


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
        for way, growth in (("openpi", None), ("zmq", None), ("alone", None), ("batched", 0.5))
        for robots in (1, 8)
    ]
    files = write_figures(tmp_path, rows)
    assert {file.name for file in files} == {"serving.svg", "serving.pdf"}
    drawn = (tmp_path / "serving.svg").read_text("utf-8")
    for name in ("openpi's server", "one robot at a time", "vla-zenoh, k = 0.5"):
        assert name in drawn
    assert "ZeroMQ" not in drawn
