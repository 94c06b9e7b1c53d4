"""What an evaluation found out, and how it is written as a row."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from vla_zenoh.lab.statistics import Distribution, distribution
from vla_zenoh.types import FloatArray

STAGES = {
    "end_to_end": "picture or request to command",
    "outbound": "until the model has it",
    "inference": "in the model",
    "inbound": "model's answer to command",
    "worker_to_command": "of that, until the command node has it",
    "command_to_pose": "of that, until the pose command",
}
"""Stages of a request, and what they are."""
THESIS_NAMES = {"e2e": "end_to_end", "backend": "inference", "outbound": "outbound"}
"""How the thesis calls its three stages."""


@dataclass(frozen=True, slots=True)
class PromptSegment:
    """What one prompt led to.

    Args:
        prompt: as put.
        requests: carried out.
        seconds: how long.
        path_m: length of the way.
        path_rad: length of the way in rotation.
        moved_m: (3,) from its first pose to its last.
        turned_rad: (3,) rotation vector likewise, base axes.
        asked_m: along the asked axis; None where it is not known what was asked.
        asked_rad: about it.
        along_m: reached along the asked axis.
        along_rad: reached about it.
        drift_m: furthest distance from the asked line (from the start, where none was asked).
        drift_rad: largest rotation off the asked axis.
        width_m: gripper, first and last, where known.
    """

    prompt: str
    requests: int
    seconds: float
    path_m: float | None
    path_rad: float | None
    moved_m: tuple[float, ...]
    turned_rad: tuple[float, ...]
    asked_m: float | None
    asked_rad: float | None
    along_m: float | None
    along_rad: float | None
    drift_m: float | None
    drift_rad: float | None
    width_m: tuple[float, float] | None


@dataclass(frozen=True, slots=True)
class PlotTrace:
    """Poses over time, for plots.

    Args:
        t_s: (n,) since the run began.
        position_m: (n, 3).
        rotvec_rad: (n, 3) since its first orientation, base axes.
    """

    t_s: FloatArray
    position_m: FloatArray
    rotvec_rad: FloatArray


@dataclass(frozen=True, slots=True)
class CameraView:
    """A picture of the strip.

    Args:
        t_s: since the run began.
        camera: its name.
        jpeg: a small JPEG file.
        model: it is what the model was given, not what the camera took.
    """

    t_s: float
    camera: str
    jpeg: bytes
    model: bool = False


@dataclass(slots=True)
class Evaluation:
    """One run, or all of them.

    Args:
        name: ``record_id``.
        kind: ``mcap`` or ``csv``.
        path: of the file; None for all of them.
        requests: rows of a CSV file; chunks of the obeyed worker.
        succeeded: of those, how many; None where it is not known.
        seconds: from the first to the last of them.
        prompts: in their order.
        stages_ms: stage -> one value per request.
        request_t_s: time of each request, (n,).
        path_m: length of the way of the TCP; of the measured one where it is known.
        path_rad: likewise in rotation.
        command_path_m: of the commanded one.
        command_path_rad: likewise.
        tracking_mm: commanded against measured position at the same time.
        tracking_mrad: likewise for orientation.
        jerk: (n,) size of the commanded jerk in m/s^3 (rad/s^3 where joints are commanded).
        jerk_unit: of `jerk`.
        active_s: how long the arm obeyed.
        idle_s: how long of it it stood.
        seam_goal_mm: by how much the goal jumped where a new chunk took over.
        seam_velocity_mm_s: by how much the commanded velocity did.
        refusals: reason -> how often.
        skipped: reason -> how often; what belongs to normal running.
        width_m: gripper opening, (n,).
        width_t_s: when, (n,).
        gripper_orders: how many.
        segments: what each prompt led to.
        problems: what could not be read, in words.
        measured: for plots.
        commanded: for plots.
        marks: (seconds, prompt), for plots.
        views: pictures at chosen times.
    """

    name: str
    kind: str
    path: Path | None = None
    requests: int = 0
    succeeded: int | None = None
    seconds: float = 0.0
    prompts: list[str] = field(default_factory=list)
    stages_ms: dict[str, FloatArray] = field(default_factory=dict)
    request_t_s: FloatArray = field(default_factory=lambda: np.zeros(0))
    path_m: float | None = None
    path_rad: float | None = None
    command_path_m: float | None = None
    command_path_rad: float | None = None
    tracking_mm: FloatArray = field(default_factory=lambda: np.zeros(0))
    tracking_mrad: FloatArray = field(default_factory=lambda: np.zeros(0))
    jerk: FloatArray = field(default_factory=lambda: np.zeros(0))
    jerk_unit: str = "m_s3"
    active_s: float | None = None
    idle_s: float | None = None
    seam_goal_mm: FloatArray = field(default_factory=lambda: np.zeros(0))
    seam_velocity_mm_s: FloatArray = field(default_factory=lambda: np.zeros(0))
    refusals: Counter[str] = field(default_factory=Counter)
    skipped: Counter[str] = field(default_factory=Counter)
    width_m: FloatArray = field(default_factory=lambda: np.zeros(0))
    width_t_s: FloatArray = field(default_factory=lambda: np.zeros(0))
    gripper_orders: int | None = None
    segments: list[PromptSegment] = field(default_factory=list)
    problems: list[str] = field(default_factory=list)
    measured: PlotTrace | None = None
    commanded: PlotTrace | None = None
    marks: list[tuple[float, str]] = field(default_factory=list)
    views: list[CameraView] = field(default_factory=list)

    @property
    def success_rate(self) -> float | None:
        """Share of the requests that succeeded."""
        if self.succeeded is None or not self.requests:
            return None
        return self.succeeded / self.requests

    def latency(self) -> dict[str, Distribution]:
        """Stage -> distribution in ms, in the order of `STAGES`."""
        found = {stage: distribution(self.stages_ms.get(stage, ())) for stage in STAGES}
        return {stage: value for stage, value in found.items() if value is not None}

    def row(self) -> dict[str, Any]:
        """Flat: the thesis's column names first, with its definitions, then ours."""
        out: dict[str, Any] = {"record_id": self.name, "n_rows": self.requests}
        for name, stage in THESIS_NAMES.items():
            found = distribution(self.stages_ms.get(stage, ()))
            values = asdict(found) if found else dict.fromkeys(Distribution.__dataclass_fields__)
            out[f"{name}_count"] = found.count if found else 0
            for short in ("mean", "std", "p50", "p95", "p99", "min", "max"):
                out[f"{name}_{'median' if short == 'p50' else short}_ms"] = values[short]
        out |= {
            "success_rate": self.success_rate,
            "trans_total_m": self.path_m,
            "rot_total_rad": self.path_rad,
            "kind": self.kind,
            "seconds": self.seconds,
            "command_path_m": self.command_path_m,
            "command_path_rad": self.command_path_rad,
            "drift_max_m": _largest(segment.drift_m for segment in self.segments),
            "drift_max_rad": _largest(segment.drift_rad for segment in self.segments),
            "active_s": self.active_s,
            "idle_s": self.idle_s,
            "gripper_orders": self.gripper_orders,
            "gripper_travel_m": _travel(self.width_m),
        }
        for name, values in (
            ("tracking_mm", self.tracking_mm),
            ("tracking_mrad", self.tracking_mrad),
            (f"jerk_{self.jerk_unit}", self.jerk),
            ("seam_goal_mm", self.seam_goal_mm),
            ("seam_velocity_mm_s", self.seam_velocity_mm_s),
        ):
            found = distribution(values)
            for short in ("mean", "p95", "max"):
                out[f"{name}_{short}"] = getattr(found, short) if found else None
        out["seams"] = len(self.seam_goal_mm)
        out["refused"] = self.refusals.total()
        return out

    def to_dict(self) -> dict[str, Any]:
        """`row`, and beside it what does not fit into one."""
        return self.row() | {
            "file": str(self.path) if self.path else None,
            "prompts": self.prompts,
            "latency_ms": {stage: asdict(found) for stage, found in self.latency().items()},
            "refusals": dict(sorted(self.refusals.items())),
            "skipped": dict(sorted(self.skipped.items())),
            "gripper_width_m": None
            if not len(self.width_m)
            else {
                "first": float(self.width_m[0]),
                "last": float(self.width_m[-1]),
                "min": float(np.nanmin(self.width_m)),
                "max": float(np.nanmax(self.width_m)),
            },
            "segments": [
                {name: getattr(segment, name) for name in PromptSegment.__dataclass_fields__}
                for segment in self.segments
            ],
            "problems": self.problems,
        }


def _largest(values: Iterable[float | None]) -> float | None:
    return max((value for value in values if value is not None), default=None)


def _travel(width_m: FloatArray) -> float | None:
    there = width_m[np.isfinite(width_m)]
    return float(np.abs(np.diff(there)).sum()) if len(there) else None
