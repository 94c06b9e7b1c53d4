"""The thesis's CSV: its figures by its definitions, and whatever else such a file may hold.

Its recordings are not ours to ship. Whoever has them sets ``VLA_ZENOH_THESIS`` to the folder with
``recordings/`` and ``summary_per_file.csv``; the files made here have the same columns.
"""

from __future__ import annotations

import csv
import io
import json
import math
import os
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from typer.testing import CliRunner

from benchmarks.__main__ import app
from benchmarks.thesis.csv_file import COLUMNS, evaluate_csv
from benchmarks.thesis.published import thesis_table
from vla_zenoh.errors import RecordingError
from vla_zenoh.lab.evaluation.evaluate import combined
from vla_zenoh.lab.evaluation.result import Evaluation

TOLERANCE = 1e-12  # of lengths that are sums of a few floats
ANGLE_RAD = 0.05
PUBLISHED_DIGITS = 3
THESIS = os.environ.get("VLA_ZENOH_THESIS", "")

Row = dict[str, Any]


def rows(count: int, **changes: Any) -> list[Row]:
    """Goes up by 0.01 m and about x by 0.05 rad a request, which takes 100 ms + its number."""
    out: list[Row] = []
    for index in range(count):
        start_ns = 10**15 + index * 200_000_000
        half = index * ANGLE_RAD / 2
        out.append(
            {
                "t_client_start": start_ns,
                "t_publish": start_ns + (100 + index) * 1_000_000,
                "t_vla_in": start_ns + 5_000_000,
                "t_vla_out": start_ns + (90 + index) * 1_000_000,
                "success": "True",
                "error": "",
                "x": 0.5,
                "y": 0.0,
                "z": 0.1 + 0.01 * index,
                "qx": math.sin(half),
                "qy": 0.0,
                "qz": 0.0,
                "gw": 0.08,
                "prompt": "HARD: go up",
            }
            | changes
        )
    return out


def write(path: Path, table: Sequence[Row], columns: Sequence[str] = COLUMNS) -> Path:
    text = io.StringIO(newline="")
    writer = csv.DictWriter(text, columns, extrasaction="ignore")
    writer.writeheader()
    writer.writerows(table)
    path.write_text(text.getvalue())
    return path


def evaluated(tmp_path: Path, table: Sequence[Row], first: int | None = None) -> Evaluation:
    return evaluate_csv(write(tmp_path / "record01.csv", table), first)


# -- figures --------------------------------------------------------------------------------------
@pytest.mark.skipif(not THESIS, reason="VLA_ZENOH_THESIS names no folder with its recordings")
def test_the_published_figures_come_out_to_the_last_digit() -> None:
    files = sorted((Path(THESIS) / "recordings").rglob("*.csv"))
    ours = {run.name: run.row() for run in (evaluate_csv(file, 50) for file in files)}
    with (Path(THESIS) / "summary_per_file.csv").open(newline="") as file:
        published = list(csv.DictReader(file))
    assert published
    for row in published:
        name = row.pop("record_id")
        found = {key: ours[name][key] for key in row}
        assert int(row.pop("n_rows")) == found.pop("n_rows")
        assert {key: f"{value:.{PUBLISHED_DIGITS}f}" for key, value in found.items()} == row, name


def test_rows_carry_the_names_and_definitions_of_the_thesis(tmp_path: Path) -> None:
    row = evaluated(tmp_path, rows(60), 50).row()
    e2e = [100.0 + index for index in range(50)]
    assert row["record_id"] == "record01"
    assert row["n_rows"] == 50
    assert row["e2e_mean_ms"] == pytest.approx(sum(e2e) / 50)
    # Linear between the 47th and 48th of 50 values: position 0.95 * 49 = 46.55.
    assert row["e2e_p95_ms"] == pytest.approx(146.55)
    assert (row["e2e_min_ms"], row["e2e_max_ms"]) == (100.0, 149.0)
    assert row["backend_mean_ms"] == pytest.approx(sum(e2e) / 50 - 15)
    assert row["outbound_p95_ms"] == 5.0
    assert row["success_rate"] == 1.0
    assert row["trans_total_m"] == pytest.approx(0.49, abs=TOLERANCE)
    assert row["rot_total_rad"] == pytest.approx(49 * ANGLE_RAD, abs=TOLERANCE)


def test_a_turn_beyond_half_is_measured_on_the_shorter_way(tmp_path: Path) -> None:
    """w was not stored: beyond half a turn the stored x, y, z are those of the other sign."""
    table = rows(100)
    assert table[-1]["qx"] < table[60]["qx"]
    run = evaluated(tmp_path, table)
    turned = sum(
        2 * math.acos(min(1.0, abs(math.sin(a) * math.sin(b) + abs(math.cos(a) * math.cos(b)))))
        for a, b in ((i * ANGLE_RAD / 2, (i + 1) * ANGLE_RAD / 2) for i in range(99))
    )
    assert run.path_rad == pytest.approx(turned, abs=1e-6)


def test_nanoseconds_of_a_wall_clock_are_not_rounded(tmp_path: Path) -> None:
    table = rows(3)
    for row in table:
        for name in ("t_client_start", "t_publish", "t_vla_in", "t_vla_out"):
            row[name] += 1_700_000_000_000_000_001
        row["t_publish"] += 1
    assert evaluated(tmp_path, table).stages_ms["end_to_end"][0] == 100.000001


def test_what_was_asked_is_told_from_the_drift(tmp_path: Path) -> None:
    table = rows(11)
    for index, row in enumerate(table):
        row["x"] = 0.5 + 0.003 * math.sin(index * math.pi / 10)
    (segment,) = evaluated(tmp_path, table).segments
    assert segment.asked_m == pytest.approx(0.11)
    assert segment.along_m == pytest.approx(0.10)
    assert segment.drift_m == pytest.approx(0.003)
    assert segment.drift_rad == pytest.approx(10 * ANGLE_RAD)


def test_turning_right_is_not_turning_left(tmp_path: Path) -> None:
    right, left = (rows(11, prompt=f"HARD: rol {side}") for side in ("right", "left"))
    assert evaluated(tmp_path, right).segments[0].along_rad == pytest.approx(0.5)
    assert evaluated(tmp_path, left).segments[0].along_rad == pytest.approx(-0.5)


def test_each_prompt_is_a_segment(tmp_path: Path) -> None:
    table = [*rows(5), *rows(5, prompt="pick up the red cube"), *rows(5)]
    run = evaluated(tmp_path, table)
    assert run.prompts == ["HARD: go up", "pick up the red cube", "HARD: go up"]
    assert [segment.asked_m for segment in run.segments] == [0.05, None, 0.05]


def test_failed_rows_count_by_their_reason(tmp_path: Path) -> None:
    table = rows(10)
    for index in (1, 4, 5):
        table[index] |= {"success": "False", "error": "timeout" if index < 5 else ""}
    run = evaluated(tmp_path, table)
    assert run.executed_share == 0.7
    assert run.refusals == {"timeout": 2, "no reason given": 1}


def test_an_arm_that_stands_is_idle(tmp_path: Path) -> None:
    table = rows(11)
    for row in table[5:]:
        row |= {"z": table[5]["z"], "qx": table[5]["qx"]}
    run = evaluated(tmp_path, table)
    assert (run.active_s, run.idle_s) == (pytest.approx(2.0), pytest.approx(1.0))


def test_all_runs_together_are_all_their_requests(tmp_path: Path) -> None:
    short = evaluate_csv(write(tmp_path / "a.csv", rows(2)))
    long = evaluate_csv(write(tmp_path / "b.csv", rows(30, success="False", error="x")))
    both = combined([short, long]).row()
    values = [100, 101, *range(100, 130)]
    assert (both["record_id"], both["n_rows"]) == ("ALL", 32)
    assert both["e2e_mean_ms"] == pytest.approx(np.mean(values))
    assert both["e2e_p95_ms"] == pytest.approx(np.percentile(values, 95))
    assert both["success_rate"] == 2 / 32
    assert both["trans_total_m"] == pytest.approx(0.30, abs=TOLERANCE)


# -- files that are not as they should be ---------------------------------------------------------
def test_no_rows_are_said(tmp_path: Path) -> None:
    run = evaluated(tmp_path, [], 50)
    row = run.row()
    assert (row["n_rows"], row["e2e_mean_ms"], row["success_rate"]) == (0, None, None)
    assert (row["trans_total_m"], row["rot_total_rad"]) == (None, None)
    assert run.problems == ["it has no rows"]


def test_one_row_has_a_latency_and_no_way(tmp_path: Path) -> None:
    row = evaluated(tmp_path, rows(1)).row()
    assert (row["e2e_mean_ms"], row["e2e_p95_ms"], row["e2e_std_ms"]) == (100.0, 100.0, 0.0)
    assert (row["trans_total_m"], row["rot_total_rad"]) == (0.0, 0.0)


def test_fewer_rows_than_asked_for_are_evaluated_and_said(tmp_path: Path) -> None:
    run = evaluated(tmp_path, rows(49), 50)
    assert run.requests == 49
    assert run.problems == ["it has 49 rows, fewer than the 50 asked for"]


@pytest.mark.parametrize(
    ("missing", "gone"),
    [
        ("t_publish", ["e2e_mean_ms"]),
        ("t_vla_in", ["backend_mean_ms", "outbound_mean_ms"]),
        ("z", ["trans_total_m"]),
        ("qx", ["rot_total_rad"]),
        ("success", ["success_rate"]),
        ("gw", ["gripper_travel_m"]),
        ("prompt", []),
        ("error", []),
    ],
)
def test_a_missing_column_takes_its_own_figures_only(
    tmp_path: Path, missing: str, gone: list[str]
) -> None:
    columns = [name for name in COLUMNS if name != missing]
    run = evaluate_csv(write(tmp_path / "a.csv", rows(10), columns))
    assert run.problems == [f"columns missing: {missing}; their figures are left out"]
    whole = evaluate_csv(write(tmp_path / "b.csv", rows(10))).row()
    row = run.row()
    names = (
        "e2e_mean_ms",
        "backend_mean_ms",
        "outbound_mean_ms",
        "success_rate",
        "trans_total_m",
        "rot_total_rad",
        "gripper_travel_m",
    )
    for name in names:
        assert row[name] == (None if name in gone else whole[name])


def test_text_in_a_number_column_is_said_and_the_rest_evaluated(tmp_path: Path) -> None:
    table = rows(10)
    table[3]["z"], table[4]["z"] = "n/a", ""
    table[6]["t_publish"] = "later"
    table[7]["qx"] = "inf"
    run = evaluated(tmp_path, table)
    row = run.row()
    assert row["e2e_count"] == 9
    assert row["trans_total_m"] == pytest.approx(0.09, abs=TOLERANCE)
    assert row["rot_total_rad"] == pytest.approx(9 * ANGLE_RAD, abs=TOLERANCE)
    assert run.problems == [
        "column t_publish: 1 of 10 cells hold no number (row 7: 'later'); they are left out",
        "column z: 2 of 10 cells hold no number (row 4: 'n/a'); they are left out",
        "column qx: 1 of 10 cells hold no number (row 8: 'inf'); they are left out",
    ]


def test_a_word_that_is_neither_true_nor_false_counts_as_failed(tmp_path: Path) -> None:
    table = rows(4)
    table[0]["success"] = "perhaps"
    run = evaluated(tmp_path, table)
    assert run.executed_share == 0.75
    assert "1 of 4 cells are neither true nor false ('perhaps')" in run.problems[0]


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "is empty"),
        (b"a,b\n1,2\n", "none of the columns"),
        (b"\x89MCAP0\r\n" + bytes(range(256)) * 8, "none of the columns|no CSV file"),
    ],
)
def test_a_file_of_something_else_is_refused(tmp_path: Path, content: bytes, message: str) -> None:
    (tmp_path / "a.csv").write_bytes(content)
    with pytest.raises(RecordingError, match=message):
        evaluate_csv(tmp_path / "a.csv")


@settings(max_examples=60)
@given(content=st.binary(max_size=300) | st.text(max_size=300).map(str.encode))
def test_whatever_a_file_holds_it_is_evaluated_or_refused(
    tmp_path_factory: pytest.TempPathFactory, content: bytes
) -> None:
    path = tmp_path_factory.mktemp("any") / "a.csv"
    path.write_bytes(",".join(COLUMNS).encode() + b"\n" + content)
    with suppress(RecordingError):
        json.dumps(evaluate_csv(path).row())


# -- the command ----------------------------------------------------------------------------------
def test_the_command_shows_recordings_and_our_motions_beside_the_published_ones(
    tmp_path: Path,
) -> None:
    recording = write(tmp_path / "good.csv", rows(10))
    ours = {
        "prompt": "go up",
        "rate_hz": 1.0,
        "horizon": 1,
        "delay_ms": 0.0,
        "asked_m": 0.5,
        "asked_path_m": 0.5,
        "asked_path_rad": 0.0,
        "path_m": 0.5,
        "path_rad": 0.0,
        "e2e_ms_mean": 20.0,
        "e2e_ms_p95": 30.0,
        "outbound_ms_mean": 10.0,
        "outbound_ms_p95": 11.0,
    }
    failed = {"prompt": "go down", "rate_hz": 1.0, "horizon": 1, "delay_ms": 0.0}
    (tmp_path / "result.json").write_text(json.dumps([ours, failed]))
    done = CliRunner().invoke(
        app, ["thesis", str(recording), str(tmp_path / "result.json")], env={"COLUMNS": "200"}
    )
    assert done.exit_code == 0, done.output
    assert "good" in done.output
    beside = thesis_table([ours, failed])
    assert beside.row_count == 1
    assert list(beside.columns[3].cells) == ["0.248 m, 0.421 rad"]
    assert list(beside.columns[6].cells) == ["20.0 / 30.0"]
