"""What the demo says of a fixed motion that is off."""

from __future__ import annotations

from dataclasses import replace

import pytest

from vla_zenoh.lab.cli.demo_run import faults_of
from vla_zenoh.lab.demo.scripted_motions import parse_scripted
from vla_zenoh.lab.evaluation.result import PromptSegment

MAX_WIDTH_M = 0.08
UP = PromptSegment(
    prompt="HARD: go up x50",
    requests=50,
    seconds=5.0,
    path_m=0.5,
    path_rad=0.0,
    moved_m=(0.0, 0.0, 0.5),
    turned_rad=(0.0, 0.0, 0.0),
    asked_m=0.5,
    asked_rad=0.0,
    along_m=0.5,
    along_rad=0.0,
    drift_m=0.0,
    drift_rad=0.0,
    width_m=(0.08, 0.08),
)
YAW = replace(UP, asked_m=0.0, along_m=0.0, asked_rad=1.0, along_rad=1.0)


@pytest.mark.parametrize(
    ("segment", "prompt", "named"),
    [
        (UP, "HARD: go up x50", ""),
        (replace(UP, along_m=0.4985), "HARD: go up x50", ""),
        (replace(UP, along_m=0.497), "HARD: go up x50", "distance off by 0.003 m"),
        (replace(UP, along_m=None), "HARD: go up x50", "distance off by 0.5 m"),
        (replace(UP, along_m=float("nan")), "HARD: go up x50", "distance off by nan m"),
        (replace(UP, drift_m=0.003), "HARD: go up x50", "drift off by 0.003 m"),
        (replace(UP, drift_rad=0.01), "HARD: go up x50", "rotation drift off by 0.01 rad"),
        (replace(UP, width_m=(0.08, 0.07)), "HARD: go up x50", "gripper off by 0.01 m"),
        (YAW, "HARD: yaw left x20", ""),
        (replace(YAW, along_rad=0.99), "HARD: yaw left x20", "angle off by 0.01 rad"),
        (
            replace(UP, asked_m=0.0, along_m=0.0, width_m=(0.08, 0.0)),
            "HARD: close gripper x2",
            "",
        ),
        (
            replace(UP, asked_m=0.0, along_m=0.0, width_m=(0.08, 0.05)),
            "HARD: close gripper x2",
            "gripper off by 0.05 m",
        ),
    ],
)
def test_a_motion_that_is_off_by_more_than_2_mm_or_5_mrad_is_named(
    segment: PromptSegment, prompt: str, named: str
) -> None:
    faults = faults_of(segment, parse_scripted(prompt), MAX_WIDTH_M)
    assert [fault.partition(" (")[0] for fault in faults] == ([named] if named else [])
