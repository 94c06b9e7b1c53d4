"""The motion protocol's rows: what is judged as a fault, and what is measured at seams."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.motion.protocol import (
    PROTOCOL,
    Conditions,
    MeasuredStream,
    failed_row,
    make_row,
    path_length,
)
from benchmarks.motion.segments import SegmentOutcome
from benchmarks.motion.table import motion_table
from vla_zenoh.kinematics.so3 import Pose, exp3
from vla_zenoh.profile import load_profile

PROFILE = load_profile("panda_sim")
PERIOD_S = 1.0 / PROFILE.timing.command_hz
JERK_M_S3 = PROFILE.limits.translation.jerk_m_s3
GO_UP = PROTOCOL[0]
UP = 2


def outcome(**changes: float) -> SegmentOutcome:
    """Go up, done as asked."""
    done = dict(
        reached_m=0.5,
        reached_rad=0.0,
        drift_mm=0.0,
        drift_rad=0.0,
        asked_width_m=0.08,
        reached_width_m=0.08,
        steps_done=50,
        duration_s=10.0,
    )
    return SegmentOutcome(GO_UP.segment, **{**done, **changes})  # pyright: ignore[reportArgumentType]


def stream(jerk_m_s3: list[float], chunk_seq: list[int]) -> MeasuredStream:
    """Commands along z with these jerks, one a tick."""
    acceleration = np.zeros((len(jerk_m_s3) + 1, 6))
    acceleration[1:, UP] = np.cumsum(jerk_m_s3) * PERIOD_S
    twist = np.cumsum(acceleration, axis=0) * PERIOD_S
    return MeasuredStream(
        np.arange(len(acceleration)) * PERIOD_S,
        twist,
        acceleration,
        np.array(chunk_seq),
        0.5,
        0.0,
        1e-4,
        [20.0, 30.0],
        [10.0, 11.0],
    )


SMOOTH = stream([JERK_M_S3, 0.0, -JERK_M_S3, 0.0], [1, 1, 1, 2, 2])


def test_a_motion_as_asked_has_no_fault() -> None:
    row = make_row(GO_UP, Conditions(5.0), PROFILE, outcome(), SMOOTH)
    assert row["ok"]
    assert row["peak_jerk_over_limit"] == pytest.approx(1.0)
    assert row["asked_path_m"] == pytest.approx(0.5)


@pytest.mark.parametrize(
    ("changes", "fault"),
    [
        ({"reached_m": 0.4985}, "translation"),
        ({"reached_m": float("nan")}, "translation"),
        ({"reached_rad": 0.003}, "rotation"),
        ({"drift_mm": 1.5}, "off axis"),
        ({"drift_rad": 0.003}, "off axis"),
        ({"reached_width_m": 0.07}, "gripper"),
        ({"steps_done": 49}, "49 of 50 steps"),
        ({"steps_done": 51}, "51 of 50 steps"),
    ],
)
def test_what_the_arm_did_not_do_is_a_fault_by_name(changes: dict[str, float], fault: str) -> None:
    row = make_row(GO_UP, Conditions(5.0), PROFILE, outcome(**changes), SMOOTH)
    assert not row["ok"]
    assert len(row["faults"]) == 1
    assert row["faults"][0].startswith(fault)


def test_a_step_that_is_missing_is_told_with_what_was_refused_meanwhile() -> None:
    few, refused = outcome(steps_done=49), {"command.stale": 1}
    row = make_row(GO_UP, Conditions(5.0), PROFILE, few, SMOOTH, refused)
    assert row["faults"] == ["49 of 50 steps (refused: command.stale 1)"]


def test_a_jerk_over_its_limit_is_a_fault_and_found_at_the_seam_it_is_at() -> None:
    jerky = stream([JERK_M_S3, 0.0, -1.5 * JERK_M_S3, 0.0], [1, 1, 1, 2, 2])
    row = make_row(GO_UP, Conditions(5.0), PROFILE, outcome(), jerky)
    assert [fault.split()[0] for fault in row["faults"]] == ["jerk"]
    assert row["seams"] == 1
    assert row["seam_jerk_over_limit"] == pytest.approx(1.5)
    assert row["elsewhere_jerk_over_limit"] == pytest.approx(1.0)


def test_a_step_in_velocity_is_a_fault() -> None:
    stepping = stream([0.0] * 4, [1] * 5)
    stepping.twist[3:, UP] = 0.05
    row = make_row(GO_UP, Conditions(5.0), PROFILE, outcome(), stepping)
    assert [fault.split()[0] for fault in row["faults"]] == ["velocity"]


def test_a_way_there_and_back_counts_twice() -> None:
    poses = [
        Pose(np.array([0.0, 0.0, height]), exp3(np.array([0.0, 0.0, turn])))
        for height, turn in ((0.0, 0.0), (0.1, 0.3), (0.0, 0.0))
    ]
    assert path_length(poses) == (pytest.approx(0.2), pytest.approx(0.6))


def test_the_tables_hold_what_was_measured_and_what_was_not() -> None:
    rows = [
        make_row(GO_UP, Conditions(1.0), PROFILE, outcome(), SMOOTH),
        failed_row(GO_UP, Conditions(5.0, 8, 140.0, 0.3), "the arm is inactive"),
    ]
    table = motion_table(rows)
    assert table.row_count == len(rows)
    assert [str(cell) for cell in table.columns[-1].cells] == [
        "ok",
        "the arm is inactive",
    ]
