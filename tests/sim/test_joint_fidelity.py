"""Bounds of `benchmarks.joint_fidelity`, for a few of its cases on the simulated arms."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from benchmarks.joint_fidelity import (
    DROID_RATES_HZ,
    PANDA,
    SO101,
    Case,
    all_cases,
    arm_of,
    measure,
    random_track,
    singular_value,
    swivel,
    wrist,
)

AT_REST_MRAD = 1.0
MOVES_RAD = 0.4
STILL_M, SINGULAR = 1e-4, 1e-4


def carried_out(name: str, profile: str, way: str, duration_s: float = 0.0) -> dict[str, Any]:
    return measure(Case(name, profile, way, seed=7, duration_s=duration_s), perfect=False)


def test_the_tcp_rests_on_the_whole_path_of_the_elbow() -> None:
    arm = arm_of(PANDA, "joint")
    track = swivel(arm)
    places_m = np.array([arm.kinematics.forward(row).position_m for row in track.rows_rad])
    assert np.ptp(track.rows_rad, axis=0).max() > MOVES_RAD
    assert np.abs(places_m - places_m[0]).max() < STILL_M


def test_the_path_of_the_wrist_passes_a_singularity() -> None:
    arm = arm_of(PANDA, "joint")
    values = [singular_value(arm, row) for row in wrist(arm).rows_rad]
    assert min(values) < SINGULAR < 100 * SINGULAR < min(values[0], values[-1])


def test_a_random_path_is_that_of_its_seed() -> None:
    arm = arm_of(SO101, "joint")
    first, again, other = (random_track(arm, seed, 1.5, 0.7) for seed in (1, 1, 2))
    assert np.array_equal(first.rows_rad, again.rows_rad)
    assert not np.array_equal(first.rows_rad, other.rows_rad)


def test_the_benchmark_has_as_many_paths_as_it_says() -> None:
    cases = all_cases(50, seed=1)
    assert len(set(cases)) == len(cases)
    assert sum(case.profile == SO101 and case.way == "joints" for case in cases) == 50
    assert sum(case.name == "random" and case.way == "joints" for case in cases) == 50


@pytest.mark.long
@pytest.mark.parametrize("name", ["swivel", "wrist", "random"])
def test_joints_of_the_panda_rest_where_they_were_asked_to(name: str) -> None:
    found = carried_out(name, PANDA, "joints")
    assert found["rest_mrad"] < AT_REST_MRAD, found
    assert found["state"] == "active"


@pytest.mark.slow
def test_an_elbow_is_not_followed_where_its_policy_gives_poses() -> None:
    found = carried_out("swivel", PANDA, "poses")
    assert found["stuck"], found
    assert found["rest_mm"] < 1.0


@pytest.mark.slow
@pytest.mark.parametrize("duration_s", [1.5, 2.5])
def test_five_joints_rest_where_they_were_asked_to(duration_s: float) -> None:
    found = carried_out(f"random {duration_s:g} s", SO101, "joints", duration_s)
    assert found["rest_mrad"] < AT_REST_MRAD, found
    assert found["state"] == "active"


@pytest.mark.slow
@pytest.mark.parametrize("rate_hz", DROID_RATES_HZ)
def test_steps_of_the_joints_are_carried_out_whole(rate_hz: float) -> None:
    found = carried_out(f"steps, {rate_hz:g} Hz", PANDA, "steps", rate_hz)
    assert found["covered"] == pytest.approx(1.0, abs=1e-4), found


def test_poses_for_five_joints_are_rejected_by_name() -> None:
    found = carried_out("random 1.5 s", SO101, "poses", 1.5)
    assert "robot 'so101' has 5 arm joints" in found["rejected"]
