"""Figures as text, for the screen and the page."""

from __future__ import annotations

from collections.abc import Sequence

from vla_zenoh.lab.evaluation.result import Evaluation
from vla_zenoh.lab.statistics import distribution
from vla_zenoh.types import FloatArray

LATENCY_COLUMNS = ("min", "mean", "p50", "p95", "max")
SUMMARY_COLUMNS = (
    *("run", "n", "executed", "reached", "p50 ms", "p95 ms", "path m", "turn rad"),
    *("off mm", "track mm", "idle s", "refused"),
)
"""Requests, share of them that was executed, least share of a prompt's motion that was reached,
end-to-end latency, path of the TCP, largest distance off the requested axis, tracking error (p95),
time standing while active, rejections."""
NARROW = 7
"""Number of these columns that fit on a terminal of 80 characters."""
NONE = "-"


def number(value: float | None, unit: str, digits: int = 3, scale: float = 1.0) -> str:
    """`value` with its unit, a dash for None."""
    return NONE if value is None else f"{value * scale:.{digits}f} {unit}".rstrip()


def _share(value: float | None) -> str:
    return NONE if value is None else f"{value:.0%}"


def summary_row(run: Evaluation) -> tuple[str, ...]:
    """One line for one run, see `SUMMARY_COLUMNS`."""
    latency = run.latency().get("end_to_end")
    tracking = distribution(run.tracking_mm)
    drift_m = [found.drift_m for found in run.segments if found.drift_m is not None]
    return (
        run.name,
        str(run.requests),
        _share(run.executed_share),
        _share(run.reached_share),
        number(latency.p50 if latency else None, "", 1),
        number(latency.p95 if latency else None, "", 1),
        number(run.path_m, ""),
        number(run.path_rad, ""),
        number(max(drift_m, default=None), "", 1, 1e3),
        number(tracking.p95 if tracking else None, "", 2),
        number(run.idle_s, "", 1),
        str(run.refusals.total()),
    )


def latency_rows(run: Evaluation) -> list[tuple[str, ...]]:
    """Stage, its five figures in ms.

    A chunk that arrives within a tick is used in it: its latency may be some microseconds below
    zero, and is shown as zero.
    """
    return [
        (stage, *(f"{max(getattr(found, name), 0.0):.1f}" for name in LATENCY_COLUMNS))
        for stage, found in run.latency().items()
    ]


def tasks_done(run: Evaluation) -> str:
    """How many of the judged tasks were done."""
    judged = [verdict.success for verdict in run.verdicts if verdict.success is not None]
    return f"{sum(judged)} of {len(judged)}" if judged else NONE


def filled(
    columns: Sequence[str], rows: Sequence[Sequence[str]]
) -> tuple[tuple[str, ...], list[tuple[str, ...]]]:
    """The columns of a table in which any row has something, and their rows."""
    kept = [at for at in range(len(columns)) if any(row[at] != NONE for row in rows)]
    return tuple(columns[at] for at in kept), [tuple(row[at] for at in kept) for row in rows]


def segment_rows(run: Evaluation) -> list[tuple[str, ...]]:
    """Prompt, steps, asked, reached along it, furthest off it, gripper."""
    rows: list[tuple[str, ...]] = []
    for found in run.segments:
        unit, reached = ("rad", found.along_rad) if found.asked_rad else ("m", found.along_m)
        width = found.width_m
        rows.append(
            (
                found.prompt,
                str(found.requests),
                number(found.asked or None, unit, 4),
                number(reached if found.asked else None, unit, 4),
                number(found.drift_m, "mm", 2, 1e3),
                number(found.drift_rad, "mrad", 2, 1e3),
                NONE if width is None else f"{width[0] * 1e3:.1f} to {width[1] * 1e3:.1f} mm",
            )
        )
    return rows


SEGMENT_COLUMNS = (
    *("prompt", "steps", "asked", "reached"),
    *("off axis", "rotation off axis", "gripper"),
)


HINTS = {
    "requests": "chunks of the worker in control while the arm was active",
    "executed": "requests of which at least one step was executed, whether or not it did the task",
    "reached": "share of the motion that a prompt asked for; of the prompt that reached the least",
    "path": "length of the measured way of the TCP",
    "tracking error, mean / p95 / max": "measured from commanded position at the same time",
    "idle while active": "the arm stood still though it was active",
    "chunk seams": "where a new chunk took over from the one before",
    "goal at seams moves, mean / p95 / max": "how far the goal jumped there",
    "velocity step at seams": "change of velocity there that the acceleration does not explain",
    "refused": "messages that nodes rejected during the recording, by reason",
    "skipped": "chunks left out in normal operation, by reason",
}
"""Figure -> what it means."""


def figures(run: Evaluation) -> list[tuple[str, str]]:
    """Name and value of every figure; docs/how-to/recording.md says what they mean."""
    jerk_unit = run.jerk_unit.replace("_s3", "/s³")
    idle = (
        f"{run.idle_s:.1f} of {run.active_s:.1f} s"
        if run.idle_s is not None and run.active_s
        else NONE
    )
    rows = [
        ("tasks done", tasks_done(run)),
        ("requests", str(run.requests)),
        ("executed", _share(run.executed_share)),
        ("reached", _share(run.reached_share)),
        ("time", number(run.seconds, "s", 1)),
        ("path", number(run.path_m, "m", 4)),
        ("rotation path", number(run.path_rad, "rad", 4)),
        ("commanded path", number(run.command_path_m, "m", 4)),
        ("commanded rotation path", number(run.command_path_rad, "rad", 4)),
        ("tracking error, mean / p95 / max", _three(run.tracking_mm, "mm")),
        ("rotation tracking, mean / p95 / max", _three(run.tracking_mrad, "mrad")),
        ("commanded jerk, mean / p95 / max", _three(run.jerk, jerk_unit, 1)),
        ("idle while active", idle),
        ("chunk seams", str(len(run.seam_goal_mm)) if len(run.seam_goal_mm) else NONE),
        ("goal at seams moves, mean / p95 / max", _three(run.seam_goal_mm, "mm")),
        ("velocity step at seams", _three(run.seam_velocity_mm_s, "mm/s")),
        ("gripper orders", NONE if run.gripper_orders is None else str(run.gripper_orders)),
        ("refused", _counts(run.refusals.most_common())),
        ("skipped", _counts(run.skipped.most_common())),
    ]
    return [(name, value) for name, value in rows if value != NONE]


def _three(values: FloatArray, unit: str, digits: int = 2) -> str:
    found = distribution(values)
    if found is None:
        return NONE
    return " / ".join(f"{value:.{digits}f}" for value in (found.mean, found.p95, found.max)) + (
        f" {unit}"
    )


def _counts(counts: Sequence[tuple[str, int]]) -> str:
    return ", ".join(f"{name} {count}" for name, count in counts) or NONE
