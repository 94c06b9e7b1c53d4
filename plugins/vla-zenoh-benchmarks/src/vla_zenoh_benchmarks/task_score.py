"""The score of the task benchmark: outcomes of a plan, and their figures."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from vla_zenoh.lab.tasks.task import SCENE, TaskOutcome, TaskPlan
from vla_zenoh.policy.options import shown
from vla_zenoh_benchmarks.statistics import wilson_95

PLANNED = ("seed", "held_out", "prompt", "delay_ms", "rate_hz", "limit_s")


@dataclass(slots=True)
class TaskScore:
    """Outcomes of a plan, and their figures.

    Args:
        mode: ``real_time`` or ``lockstep``.
        latency_ms: stage -> ``[p50, p95]``.
    """

    plan: TaskPlan
    mode: str
    profile: str
    vary: Sequence[str] = ()
    ended: list[TaskOutcome] = field(default_factory=list)
    latency_ms: dict[str, tuple[float, float]] = field(default_factory=dict)
    wall_s: float = 0.0
    options: Mapping[str, str] = field(default_factory=dict)

    def to_dict(self) -> dict[str, Any]:
        plan = self.plan
        families = sorted({each.episode.order.family for each in self.ended})
        return {
            "model": plan.model,
            "options": shown(self.options),
            "mode": self.mode,
            "profile": self.profile,
            "scene": SCENE,
            "family": plan.family or "all",
            "vary": list(self.vary),
            **{name: getattr(plan, name) for name in PLANNED},
            **_figures(self.ended),
            "by_family": {
                family: _figures([e for e in self.ended if e.episode.order.family == family])
                for family in families
            },
            "latency_ms": {name: list(pair) for name, pair in self.latency_ms.items()},
            "wall_s": round(self.wall_s, 1),
            "all": [each.to_dict() for each in self.ended],
        }


def _figures(ended: Sequence[TaskOutcome]) -> dict[str, Any]:
    successes = sum(each.success for each in ended)
    times_s = [each.time_s for each in ended if each.success]
    kinds = Counter(each.failure for each in ended if not each.success)
    return {
        "success_rate": successes / len(ended) if ended else None,
        "successes": successes,
        "episodes": len(ended),
        "wilson_95": list(wilson_95(successes, len(ended))),
        "failures": dict(kinds.most_common()),
        "time_to_success_s": {
            "p50": float(np.median(times_s)),
            "p95": float(np.percentile(times_s, 95)),
        }
        if times_s
        else None,
    }


def failure_sheet(ended: Sequence[TaskOutcome]) -> bytes | None:
    """A JPEG of the first failures with pictures; None: there are none."""
    from vla_zenoh.lab.tasks.task_sheet import sheet  # OpenCV

    return sheet([each for each in ended if not each.success])
