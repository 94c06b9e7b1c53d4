"""Figures that the thesis published, beside ours."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from rich.table import Table

from vla_zenoh.cli.output import new_table

Row = dict[str, Any]


@dataclass(frozen=True, slots=True)
class PublishedRun:
    """Figures of one run; None where none was published.

    Args:
        path_m: length of the path of the TCP, in translation.
        path_rad: the same in rotation.
        e2e_ms: request to pose command, mean and p95.
        outbound_ms: request to its arrival at the model, mean and p95.
    """

    path_m: float | None = None
    path_rad: float | None = None
    e2e_ms: tuple[float, float] | None = None
    outbound_ms: tuple[float, float] | None = None


THESIS: dict[tuple[str, float], PublishedRun] = {
    ("go up", 1.0): PublishedRun(0.248, 0.421, (7.323, 8.055), (5.963, 6.631)),
    ("go up", 5.0): PublishedRun(0.121),
    ("yaw right", 1.0): PublishedRun(None, 1.248),
    ("yaw right", 5.0): PublishedRun(None, 1.003),
    ("yaw left", 5.0): PublishedRun(0.096, 1.251, (6.189, 6.948), (5.122, 5.702)),
    ("pitch down", 1.0): PublishedRun(0.076, 0.238, (7.210, 8.340), (5.939, 6.692)),
    ("pitch down", 5.0): PublishedRun(None, 0.285),
    ("roll left", 1.0): PublishedRun(None, 0.043),
    ("roll left", 5.0): PublishedRun(None, 0.010),
    ("close gripper", 5.0): PublishedRun(0.001, 0.001, (6.169, 6.828), (5.047, 5.594)),
}
"""By motion and rate in Hz."""


def thesis_table(rows: Sequence[Row]) -> Table:
    """The thesis's Table 5.2 beside ours: one step a request, path lengths over 50 requests.

    Args:
        rows: of any conditions; those that the thesis ran too are shown.
    """
    columns = ("prompt", "Hz", "asked", "thesis", "ours", "thesis e2e", "ours", "outbound", "ours")
    table = new_table(*columns, left=("prompt",), title="beside the thesis")
    for row in rows:
        published = THESIS.get((row["prompt"], row["rate_hz"]))
        if published is None or "asked_m" not in row or row["horizon"] > 1 or row["delay_ms"]:
            continue
        times = (
            _mean_p95(published.e2e_ms),
            _mean_p95((row["e2e_ms_mean"], row["e2e_ms_p95"])),
            _mean_p95(published.outbound_ms),
            _mean_p95((row["outbound_ms_mean"], row["outbound_ms_p95"])),
        )
        table.add_row(
            row["prompt"],
            f"{row['rate_hz']:g}",
            _paths(row["asked_path_m"] or None, row["asked_path_rad"] or None),
            _paths(published.path_m, published.path_rad),
            _paths(row["path_m"], row["path_rad"]),
            *times,
        )
    table.caption = (
        "path of the TCP over 50 requests in m and rad, the thesis's on a real arm, ours "
        "simulated; mean / p95 in ms: e2e from the request (ours: the camera's stamp) to the "
        "command, outbound to the model (ours: until its answer is with the command node)"
    )
    return table


def _paths(path_m: float | None, path_rad: float | None) -> str:
    parts = ((path_m, "m"), (path_rad, "rad"))
    return ", ".join(f"{value:.3f} {unit}" for value, unit in parts if value is not None)


def _mean_p95(pair: tuple[float | None, float | None] | None) -> str:
    if pair is None or pair[0] is None or pair[1] is None:
        return ""
    return f"{pair[0]:.1f} / {pair[1]:.1f}"
