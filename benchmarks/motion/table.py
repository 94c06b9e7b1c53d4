"""Table of the motion protocol."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from rich.table import Table
from rich.text import Text

from vla_zenoh.cli.output import new_table

Row = dict[str, Any]


def motion_table(rows: Sequence[Row]) -> Table:
    """Asked and reached motion, with peaks, tracking and jerk."""
    chunked = any(row["horizon"] > 1 for row in rows)
    delayed = any(row["delay_ms"] for row in rows)
    columns = (
        "prompt",
        "Hz",
        *(["chunk"] if chunked else []),
        *(["delay"] if delayed else []),
        "asked",
        "reached",
        "off mm",
        "mrad",
        "track mm",
        "v",
        "a",
        "jerk",
        *(["at seams"] if chunked or delayed else []),
        "",
    )
    table = new_table(*columns, left=("prompt", ""), title="50 steps each, measured at rest")
    table.caption = (
        "off: beside the asked direction or axis. track: measured from commanded pose, at most. "
        "v, a: peaks in m/s, m/s2, of rotations in rad. jerk: peak as a share of its limit"
    )
    for row in rows:
        conditions = (
            row["prompt"],
            f"{row['rate_hz']:g}",
            *([f"{row['horizon']}"] if chunked else []),
            *([f"{row['delay_ms']:g}±{row['jitter']:.0%}"] if delayed else []),
        )
        verdict = Text("ok", "green") if row["ok"] else Text("; ".join(row["faults"]), "red")
        if "asked_m" not in row:
            missing = len(table.columns) - len(conditions) - 1
            table.add_row(*conditions, *["-"] * missing, verdict)
            continue
        table.add_row(
            *conditions,
            *_amounts(row),
            f"{row['off_axis_mm']:.2f}",
            f"{row['off_axis_rad'] * 1e3:.2f}",
            f"{row['tracking_mm']:.2f}",
            _peak(row, "velocity", ""),
            _peak(row, "acceleration", "2"),
            f"{row['peak_jerk_over_limit']:.3f}",
            *([f"{row['seam_jerk_over_limit']:.3f}"] if chunked or delayed else []),
            verdict,
        )
    return table


def _amounts(row: Row) -> tuple[str, str]:
    if row["asked_m"]:
        return f"{row['asked_m']:.4f} m", f"{row['reached_m']:.4f} m"
    if row["asked_rad"]:
        return f"{row['asked_rad']:.4f} rad", f"{row['reached_rad']:.4f} rad"
    return f"{row['asked_width_m'] * 1e3:.1f} mm", f"{row['reached_width_m'] * 1e3:.1f} mm"


def _peak(row: Row, what: str, power: str) -> str:
    unit = "rad" if row["asked_rad"] else "m"
    return f"{row[f'peak_{what}_{unit}_s{power}']:.3f}"
