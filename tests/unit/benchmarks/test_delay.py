"""The benchmark of delays continues where it was killed, and counts each episode once."""

from __future__ import annotations

import json
from pathlib import Path

from benchmarks.delay import SEED, Episode, _plan, draw, read_outcomes, table


def line(way: str, seed: int, success: bool) -> str:
    row = {"way": way, "delay_ms": 0, "seed": seed, "success": success, "time_s": 5.0}
    return json.dumps(row) + "\n"


def test_a_line_that_a_kill_cut_off_is_run_again(tmp_path: Path) -> None:
    file = tmp_path / "delay.jsonl"
    file.write_text(line("blend", SEED, True) + line("blend", SEED + 1, True)[:20])
    assert read_outcomes(file) == {("blend", 0): {SEED: Episode(True, 5.0)}}
    assert file.read_text() == line("blend", SEED, True)


def test_the_rest_of_a_plan_is_the_plan_without_what_is_known() -> None:
    whole = list(_plan(100, 7, 0).requests())
    assert list(_plan(100, 7, 4).requests()) == whole[4:]


def test_points_are_compared_over_the_episodes_that_all_have_at_a_delay(
    tmp_path: Path,
) -> None:
    file = tmp_path / "delay.jsonl"
    assert table(read_outcomes(file)) == []
    known = [("replace", 0, False), ("replace", 1, True), ("blend", 0, True), ("blend", 1, True)]
    file.write_text(
        "".join(line(way, SEED + n, ok) for way, n, ok in [*known, ("blend", 2, False)])
    )
    replace, blend = table(read_outcomes(file))
    assert (replace["successes"], replace["episodes"]) == (1, 2)
    assert (blend["successes"], blend["episodes"]) == (2, 2)
    assert blend["against_replace"] == {"won": 1, "lost": 0, "p": 1.0}


def test_the_curve_is_drawn_with_a_line_a_way(tmp_path: Path) -> None:
    file = tmp_path / "delay.jsonl"
    file.write_text("".join(line(way, SEED, True) for way in ("replace", "prefix")))
    draw(tmp_path / "delay.svg", table(read_outcomes(file)))
    drawn = (tmp_path / "delay.svg").read_text("utf-8")
    assert all(f"<!-- {way} -->" in drawn for way in ("replace", "prefix", "delay of a chunk, ms"))
