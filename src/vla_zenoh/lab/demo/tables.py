"""Run folder: commands and measured poses as CSV, and the chunks."""

from __future__ import annotations

import csv
import json
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from vla_zenoh.policy import ModelSpec

_TIMES = ("heard_wall_ns", "stamp_wall_ns", "seq")
_POSE = ("x_m", "y_m", "z_m", "qx", "qy", "qz", "qw")
_TWIST = ("vx_m_s", "vy_m_s", "vz_m_s", "wx_rad_s", "wy_rad_s", "wz_rad_s")
POSE_COLUMNS = (*_TIMES, *_POSE, *_TWIST)
COMMAND_COLUMNS = (*POSE_COLUMNS, "goal_x_m", "goal_y_m", "goal_z_m", "state", "chunk_seq")


def write_commands(path: Path, commands: Iterable[Any]) -> None:
    """Write one row per pose command."""
    rows = (
        [
            entry.received_ns,
            entry.header.stamp_wall_ns,
            entry.header.seq,
            *_numbers(entry.record.position_m),
            *_numbers(entry.record.quat_xyzw),
            *_numbers(entry.record.twist),
            *_numbers(entry.record.goal_position_m),
            entry.record.state,
            entry.record.cause.chunk_seq if entry.record.cause else "",
        ]
        for entry in commands
    )
    _write(path, COMMAND_COLUMNS, rows)


def write_poses(path: Path, poses: Iterable[Any]) -> None:
    """Write one row per measured pose."""
    rows = (
        [
            entry.received_ns,
            entry.header.stamp_wall_ns,
            entry.header.seq,
            *_numbers(entry.record.position_m),
            *_numbers(entry.record.quat_xyzw),
            *_numbers(entry.record.twist),
        ]
        for entry in poses
    )
    _write(path, POSE_COLUMNS, rows)


def write_chunks(path: Path, spec: ModelSpec, chunks: Sequence[np.ndarray]) -> None:
    """Write a chunk file for ``vla-zenoh worker replay``: spec, steps (N, H, D), length (N,)."""
    horizon, dimension = spec.action.horizon, spec.action.dimension
    steps = np.zeros((len(chunks), horizon, dimension), np.float32)
    for index, chunk in enumerate(chunks):
        steps[index, : len(chunk)] = chunk
    length = np.array([len(chunk) for chunk in chunks], np.int32)
    np.savez_compressed(path, spec=json.dumps(spec.to_dict()), steps=steps, length=length)


def _numbers(values: np.ndarray) -> list[str]:
    return [f"{value:.9g}" for value in values]


def _write(path: Path, columns: Sequence[str], rows: Iterable[Sequence[Any]]) -> None:
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(columns)
        writer.writerows(rows)
