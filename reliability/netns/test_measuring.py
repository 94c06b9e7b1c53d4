"""What the faults are measured with: the wire that can be made bad, and the reading of a flight."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from netns import table
from netns.flight_log import COLUMNS, STOOD_S, Flight, brake_s, read_flight
from netns.rows import Row
from netns.wire import CUT, GOOD, QUEUE_BYTES, Shape, Way
from numpy.typing import NDArray

from vla_zenoh.profile import load_profile

FRAMES = 20_000
SHARE_TOLERANCE = 0.01
BYTES = 1500
TIME_TOLERANCE_S = 1e-9
BRAKE_TOLERANCE_S = 0.008
"""Two ticks of the command node."""


def way(shape: Shape) -> Way:
    made = Way(seed=1)
    made.shape = shape
    return made


def test_a_good_wire_hands_every_frame_over_at_once() -> None:
    good = way(GOOD)
    assert [good.out_s(BYTES, at_s) for at_s in (1.0, 1.0, 2.0)] == [1.0, 1.0, 2.0]


def test_a_cut_wire_hands_nothing_over() -> None:
    assert {way(CUT).out_s(BYTES, at_s) for at_s in (1.0, 2.0)} == {None}


def test_a_wire_loses_the_share_it_is_told() -> None:
    lossy = way(Shape(loss=0.05))
    lost = sum(lossy.out_s(BYTES, at_s) is None for at_s in range(FRAMES))
    assert lost / FRAMES == pytest.approx(0.05, abs=SHARE_TOLERANCE)
    assert (lossy.lost, lossy.carried) == (lost, FRAMES - lost)


def test_a_delay_that_varies_keeps_the_order_and_its_bounds() -> None:
    slow = way(Shape(delay_s=0.02, jitter_s=0.005))
    at_s = np.arange(FRAMES) * 1e-4
    out_s = np.array([slow.out_s(BYTES, now_s) for now_s in at_s])
    assert (np.diff(out_s) >= 0).all()
    late_s = out_s - at_s
    assert late_s.min() >= 0.015 - TIME_TOLERANCE_S
    assert late_s.max() <= 0.025 + TIME_TOLERANCE_S


def test_frames_overtake_where_the_wire_is_to_reorder() -> None:
    wild = way(Shape(delay_s=0.02, reorder=0.2))
    out_s = np.array([wild.out_s(BYTES, number * 1e-3) for number in range(FRAMES)])
    overtaking = np.diff(out_s) < 0
    assert overtaking.mean() == pytest.approx(0.16, abs=SHARE_TOLERANCE)  # after one that waits


def test_a_slow_link_carries_its_rate_and_holds_back_no_more_than_its_queue() -> None:
    slow = way(Shape(rate_bit_s=1e6))
    out_s = [at_s for _ in range(1000) if (at_s := slow.out_s(BYTES, 0.0)) is not None]
    assert len(out_s) == pytest.approx(QUEUE_BYTES / BYTES, abs=2)
    assert np.diff(out_s) == pytest.approx(BYTES * 8 / 1e6)


def test_a_link_with_a_small_mtu_drops_what_is_larger() -> None:
    small = way(Shape(mtu=1280))
    assert small.out_s(1280 + 14, 1.0) == 1.0
    assert small.out_s(1280 + 15, 1.0) is None


def flown(speed_m_s: NDArray[Any], period_s: float = 0.005) -> Flight:
    count = len(speed_m_s)
    twist = np.zeros((count, 6))
    twist[:, 2] = speed_m_s
    time_s = np.arange(count, dtype=np.float64) * np.float64(period_s)
    asked_s = np.where(time_s < 0.5, np.nan, np.floor(time_s * 10) / 10)
    return Flight(time_s, np.zeros((count, 3)), twist, np.zeros((count, 3)), asked_s, time_s)


def test_an_arm_stands_when_it_stays_slow_and_not_when_it_turns() -> None:
    speed = np.full(400, 0.1)
    speed[100:110] = 0.0  # shorter than standing
    speed[200:] = 0.0
    assert STOOD_S > 10 * 0.005
    assert flown(speed).stood_at_s(0.0) == pytest.approx(1.0)
    assert flown(speed[:200]).stood_at_s(0.0) is None
    assert flown(speed).moved_at_s(0.52, 0.05) == pytest.approx(0.55)


def test_the_change_of_velocity_is_taken_within_a_window_and_not_over_a_hole() -> None:
    ramp = flown(np.minimum(np.arange(400) * 0.005 * 1.5, 0.3))
    assert ramp.hardest_m_s2() == pytest.approx(1.5, rel=1e-6)
    holed = ramp.between(-1.0)
    holed.time_s[20:] += 0.2
    assert holed.hardest_m_s2() == pytest.approx(1.5, rel=1e-6)


def test_it_is_known_when_the_last_chunk_came() -> None:
    found_s = flown(np.zeros(400)).asked_at_s(np.array([0.4, 0.5, 1.234]))
    assert np.isnan(found_s[0])
    assert found_s[1:] == pytest.approx([0.5, 1.2])


def test_jerk_is_the_change_of_the_commanded_acceleration() -> None:
    commanded = flown(np.zeros(100), 0.004)
    commanded.last[50:, 1] = 0.08
    assert commanded.jerk_m_s3(0.004) == pytest.approx(0.08 / 0.004)


def test_a_brake_takes_what_its_jerk_limit_needs() -> None:
    profile = load_profile("panda_sim")
    speed, jerk = 0.1, profile.limits.translation.jerk_m_s3
    found_s = brake_s(profile, np.array([0.0, 0.0, speed]), np.zeros(3))
    assert found_s == pytest.approx(2 * (speed / jerk) ** 0.5, abs=BRAKE_TOLERANCE_S)


def test_a_flight_whose_last_row_is_half_written_is_read_to_there(tmp_path: Path) -> None:
    rows = np.arange(3.0 * COLUMNS).reshape(3, COLUMNS)
    (tmp_path / "sim.flight").write_bytes(rows[[1, 0, 2]].tobytes()[:-5])
    found = read_flight(tmp_path / "sim.flight")
    assert found.time_s.tolist() == [0.0, COLUMNS]
    assert found.position_m[1].tolist() == rows[1, 1:4].tolist()


def test_rows_that_were_not_run_again_stay_in_the_table(tmp_path: Path) -> None:
    path = tmp_path / "table.md"
    path.write_text(f"before\n{table.BEGIN}\n{table.END}\nafter\n")
    names = ["one", "two", "three"]
    table.write(path, [Row("two", "a", "stood"), Row("one", "b")], names)
    table.write(path, [Row("two", "a", "went on", stood_s=0.5, wrong=["too late"])], names)
    lines = path.read_text().splitlines()
    assert [line[:6] for line in lines if line.startswith("| `")] == ["| `one", "| `two"]
    assert "went on; **too late**" in path.read_text()
    assert (lines[0], lines[-1]) == ("before", "after")


def test_a_table_is_not_written_where_it_has_no_place(tmp_path: Path) -> None:
    path = tmp_path / "table.md"
    path.write_text("nothing")
    with pytest.raises(ValueError, match="has no <!-- faults"):
        table.write(path, [], [])
