"""The thesis's CSV: one request per row, latencies and poses.

Columns ``t_client_start, t_publish, t_vla_in, t_vla_out`` (ns of one monotonic clock), ``success,
error``, ``x, y, z`` (m), ``qx, qy, qz`` (of a unit quaternion, whose w was not stored), ``gw``
(gripper, m), ``prompt``. Source: "Building a ROS2-VLA Bridge", its recordings and its evaluation:
latencies over the rows that have them, success over all rows, percentiles interpolated linearly.
"""

from __future__ import annotations

import csv
from collections import Counter
from collections.abc import Sequence
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np

from vla_zenoh.codec.settings import FALSE_WORDS, TRUE_WORDS
from vla_zenoh.errors import RecordingError
from vla_zenoh.lab.evaluation.result import Evaluation, PlotTrace
from vla_zenoh.lab.evaluation.segments import (
    angles_rad,
    idle_s,
    path_m,
    rotvecs,
    segment,
    turned_rad,
)
from vla_zenoh.types import FloatArray, shown

TIMES = ("t_client_start", "t_publish", "t_vla_in", "t_vla_out")
POSITION, ORIENTATION = ("x", "y", "z"), ("qx", "qy", "qz")
COLUMNS = (*TIMES, "success", "error", *POSITION, *ORIENTATION, "gw", "prompt")
STAGES_NS = {
    "end_to_end": ("t_client_start", "t_publish"),
    "outbound": ("t_client_start", "t_vla_in"),
    "inference": ("t_vla_in", "t_vla_out"),
    "inbound": ("t_vla_out", "t_publish"),
}
MAX_DIGITS = 19
"""Of nanoseconds in 64 bits."""
_TRUE, _FALSE = TRUE_WORDS | {"1.0"}, FALSE_WORDS | {"0.0"}


def evaluate_csv(path: Path, first: int | None = None) -> Evaluation:
    """Evaluate a file; `Evaluation.problems` lists what is missing in it.

    Args:
        path: of the file.
        first: only this many rows.

    Raises:
        RecordingError: the file cannot be read, or has none of the columns.
    """
    header, rows = _read(path)
    missing = [name for name in COLUMNS if name not in header]
    if len(missing) == len(COLUMNS):
        raise RecordingError(
            f"{path} has none of the columns {', '.join(COLUMNS)}; it begins with "
            f"{shown(', '.join(header))}"
        )
    run = Evaluation(path.stem, path)
    if missing:
        run.problems.append(f"columns missing: {', '.join(missing)}; their figures are left out")
    if not rows:
        run.problems.append("it has no rows")
    elif first is not None and len(rows) < first:
        run.problems.append(f"it has {len(rows)} rows, fewer than the {first} asked for")
    table = _Table(rows[:first], header, run.problems)
    run.requests = len(table.rows)
    _latency(run, table)
    _success(run, table)
    _motion(run, table)
    return run


def _read(path: Path) -> tuple[list[str], list[dict[str, str | None]]]:
    try:
        with path.open(newline="", encoding="utf-8-sig", errors="replace") as file:
            reader = csv.DictReader(file, skipinitialspace=True)
            header = [name.strip() for name in reader.fieldnames or ()]
            reader.fieldnames = header
            rows: list[dict[str, str | None]] = list(reader)
    except OSError as error:
        raise RecordingError(f"{path} cannot be read: {error.strerror}") from error
    except csv.Error as error:
        raise RecordingError(f"{path} is no CSV file: {error}") from error
    if not header:
        raise RecordingError(f"{path} is empty")
    return header, rows


class _Table:
    """Columns of a file as numbers; other cells become NaN and are reported as a problem."""

    def __init__(
        self, rows: Sequence[dict[str, str | None]], header: Sequence[str], problems: list[str]
    ) -> None:
        self.rows, self._header, self._problems = rows, header, problems

    def has(self, *names: str) -> bool:
        return all(name in self._header for name in names)

    def texts(self, name: str) -> list[str]:
        return [(row.get(name) or "").strip() for row in self.rows]

    def zero(self, name: str) -> int:
        """The first integer of a column, 0 without one."""
        words = self.texts(name) if self.has(name) else []
        return next((int(word) for word in words if _is_whole(word)), 0)

    def column(self, name: str, zero: int = 0) -> FloatArray:
        """Numbers minus `zero`: a float does not resolve the nanoseconds of a wall clock."""
        values = np.full(len(self.rows), np.nan)
        wrong: list[tuple[int, str]] = []
        for index, word in enumerate(self.texts(name)):
            try:
                values[index] = int(word) - zero if _is_whole(word) else float(word) - zero
            except (ValueError, OverflowError):
                wrong.append((index, word))
        wrong += [(int(i), "inf") for i in np.flatnonzero(np.isinf(values))]
        values[np.isinf(values)] = np.nan
        if wrong:
            index, word = wrong[0]
            self._problems.append(
                f"column {name}: {len(wrong)} of {len(values)} cells hold no number (row "
                f"{index + 1}: {word[:40]!r}); they are left out"
            )
        return values

    def columns(self, names: Sequence[str]) -> FloatArray:
        return np.column_stack([self.column(name) for name in names])


def _is_whole(word: str) -> bool:
    return word.isdecimal() and len(word) <= MAX_DIGITS


def _latency(run: Evaluation, table: _Table) -> None:
    zero = table.zero(TIMES[0])
    times = {name: table.column(name, zero) for name in TIMES if table.has(name)}
    for stage, (begin, end) in STAGES_NS.items():
        if begin in times and end in times:
            run.stages_ms[stage] = (times[end] - times[begin]) / 1e6
    start = times.get("t_client_start", np.full(len(table.rows), np.nan))
    known = start[np.isfinite(start)]
    run.request_t_s = (start - known[0]) / 1e9 if len(known) else np.arange(float(len(start)))
    run.seconds = float(known[-1] - known[0]) / 1e9 if len(known) else 0.0


def _success(run: Evaluation, table: _Table) -> None:
    if not table.has("success"):
        return
    words = [word.lower() for word in table.texts("success")]
    run.executed = sum(word in _TRUE for word in words)
    strange = [word for word in words if word not in _TRUE | _FALSE]
    if strange:
        run.problems.append(
            f"column success: {len(strange)} of {len(words)} cells are neither true nor false "
            f"({strange[0][:40]!r}); they count as failed"
        )
    errors = table.texts("error") if table.has("error") else [""] * len(words)
    run.refusals = Counter(
        error or "no reason given"
        for word, error in zip(words, errors, strict=True)
        if word not in _TRUE
    )


def _motion(run: Evaluation, table: _Table) -> None:
    count = len(table.rows)
    nothing = np.full((count, 4), np.nan)
    position = table.columns(POSITION) if table.has(*POSITION) else nothing[:, :3]
    turns = _with_w(table.columns(ORIENTATION)) if table.has(*ORIENTATION) else nothing.copy()
    run.path_m, run.path_rad = path_m(position), turned_rad(turns)
    run.width_m = table.column("gw") if table.has("gw") else np.zeros(0)
    run.width_t_s = run.request_t_s if len(run.width_m) else np.zeros(0)
    prompts = table.texts("prompt") if table.has("prompt") else [""] * count
    run.prompts = [prompt for prompt, _ in groupby(prompts) if prompt]
    t_s = run.request_t_s
    if np.isfinite(position).any():
        run.measured = PlotTrace(t_s, position, rotvecs(turns))
    _idle(run, t_s, position, turns)
    at = 0
    for prompt, group in groupby(prompts):
        rows = slice(at, at + len(list(group)))
        at = rows.stop
        run.marks.append((float(t_s[rows.start]), prompt))
        seconds = _span(t_s[rows])
        width = run.width_m[rows] if len(run.width_m) else np.zeros(0)
        run.segments.append(
            segment(prompt, rows.stop - rows.start, seconds, position[rows], turns[rows], width)
        )


def _idle(run: Evaluation, t_s: FloatArray, position: FloatArray, turns: FloatArray) -> None:
    whole = np.isfinite(np.column_stack([t_s, position, turns])).all(axis=1)
    t_s, position, turns = t_s[whole], position[whole], turns[whole]
    if len(t_s) < 2 or not (np.diff(t_s) > 0).all():
        return
    apart_s = np.diff(t_s)
    speed = np.linalg.norm(np.diff(position, axis=0), axis=1) / apart_s
    run.active_s = float(t_s[-1] - t_s[0])
    run.idle_s = idle_s(t_s, speed, angles_rad(turns[:-1], turns[1:]) / apart_s)


def _span(t_s: Any) -> float:
    known = t_s[np.isfinite(t_s)]
    return float(known[-1] - known[0]) if len(known) else 0.0


def _with_w(vector_xyz: FloatArray) -> FloatArray:
    """Unit quaternions (n, 4) from x, y, z; w is positive."""
    w = np.sqrt(np.clip(1.0 - np.sum(vector_xyz**2, axis=1, keepdims=True), 0.0, None))
    full = np.hstack([vector_xyz, w])
    norm = np.linalg.norm(full, axis=1, keepdims=True)
    return full / np.where(norm > 0, norm, np.nan)
