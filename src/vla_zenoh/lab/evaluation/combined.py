"""All runs as one."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from vla_zenoh.lab.evaluation.result import STAGES, Evaluation
from vla_zenoh.lab.evaluation.trajectory import concatenated
from vla_zenoh.types import FloatArray

OVERALL = "ALL"
"""Its ``record_id``."""


def overall(runs: Sequence[Evaluation]) -> Evaluation:
    """All runs as one: values of all requests together, lengths and counts added up."""
    stages = {stage for run in runs for stage in run.stages_ms}

    def joined(name: str) -> FloatArray:
        return concatenated([getattr(run, name) for run in runs])

    units = {run.jerk_unit for run in runs if len(run.jerk)}
    judged = [run for run in runs if run.succeeded is not None]
    return Evaluation(
        OVERALL,
        "/".join(sorted({run.kind for run in runs})),
        requests=sum(run.requests for run in runs),
        succeeded=sum(run.succeeded or 0 for run in judged) if len(judged) == len(runs) else None,
        seconds=sum(run.seconds for run in runs),
        prompts=list(dict.fromkeys(prompt for run in runs for prompt in run.prompts)),
        stages_ms={
            stage: concatenated([run.stages_ms[stage] for run in runs if stage in run.stages_ms])
            for stage in STAGES
            if stage in stages
        },
        path_m=_sum(run.path_m for run in runs),
        path_rad=_sum(run.path_rad for run in runs),
        command_path_m=_sum(run.command_path_m for run in runs),
        command_path_rad=_sum(run.command_path_rad for run in runs),
        tracking_mm=joined("tracking_mm"),
        tracking_mrad=joined("tracking_mrad"),
        jerk=joined("jerk") if len(units) <= 1 else np.zeros(0),
        jerk_unit=next(iter(units), "m_s3"),
        active_s=_sum(run.active_s for run in runs),
        idle_s=_sum(run.idle_s for run in runs),
        seam_goal_mm=joined("seam_goal_mm"),
        seam_velocity_mm_s=joined("seam_velocity_mm_s"),
        refusals=_counters(run.refusals for run in runs),
        skipped=_counters(run.skipped for run in runs),
        gripper_orders=_sum(run.gripper_orders for run in runs),
        segments=[segment for run in runs for segment in run.segments],
    )


def _counters(counters: Iterable[Counter[str]]) -> Counter[str]:
    out: Counter[str] = Counter()
    for counter in counters:
        out.update(counter)
    return out


def _sum(values: Iterable[Any]) -> Any:
    there = [value for value in values if value is not None]
    return sum(there) if there else None


def to_mapping(runs: Sequence[Evaluation], faults: Mapping[str, str]) -> dict[str, Any]:
    """Everything, ready for JSON."""
    return {
        "runs": [run.to_dict() for run in runs],
        "overall": overall(runs).to_dict() if runs else None,
        "faults": dict(faults),
    }
