"""Results of an evaluation, and their form as a row."""

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
"""Stages of a request, and their meaning."""
SHORT_SHARE, SHORT_M, SHORT_RAD = 0.1, 0.005, 0.02
"""An arm that misses what a prompt asks for by more than this share and length did not do it."""
TASKS = "tasks"
"""Name of a demo's verdicts in the metadata at the end of a recording."""
THESIS_NAMES = {"e2e": "end_to_end", "backend": "inference", "outbound": "outbound"}
"""Names of the thesis for its three stages."""


def _empty() -> FloatArray:
    return np.zeros(0)


@dataclass(frozen=True, slots=True)
class PromptSegment:
    """Motion of the arm during one prompt.

    Args:
        requests: executed.
        path_rad: length of the path in rotation.
        moved_m: (3,) displacement from the first pose to the last.
        turned_rad: (3,) rotation vector from the first pose to the last, base axes.
        asked_m: requested along the axis of the prompt; None where the request is unknown.
        asked_rad: requested about that axis.
        along_m: reached along it.
        along_rad: reached about it.
        drift_m: largest distance from the requested line; from the start without one.
        drift_rad: largest rotation off the requested axis.
        width_m: first and last opening of the gripper, where known.
        limits: that shortened it, each with its place and how often.
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
    limits: tuple[str, ...] = ()

    @property
    def asked(self) -> float | None:
        """Requested along the axis of the prompt, or about it; None or 0: nothing is known."""
        return self.asked_rad or self.asked_m

    @property
    def along(self) -> float:
        """Reached of `asked`."""
        found = self.along_rad if self.asked_rad else self.along_m
        return found or 0.0

    @property
    def reached_share(self) -> float:
        """`along` as a share of `asked`, which is above 0."""
        assert self.asked
        return self.along / self.asked

    @property
    def shortfall(self) -> str:
        """A sentence if the arm did not go where the prompt asked; else empty."""
        if not self.asked:
            return ""
        unit, least = ("rad", SHORT_RAD) if self.asked_rad else ("m", SHORT_M)
        if abs(self.asked - self.along) <= max(least, SHORT_SHARE * self.asked):
            return ""
        why = "its chunks were executed, and the arm did not do it"
        if self.limits:
            why = f"limits acted: {'; '.join(self.limits)}"
        return (
            f"prompt {self.prompt!r}: asked {self.asked:.4f} {unit}, reached {self.along:.4f} "
            f"{unit}: {why}"
        )


@dataclass(frozen=True, slots=True)
class PlotTrace:
    """Poses over time, for plots.

    Args:
        t_s: (n,) since the run began.
        position_m: (n, 3).
        rotvec_rad: (n, 3) since its first orientation, base axes.
        speed_m_s: (n,) of the position; empty where unknown.
    """

    t_s: FloatArray
    position_m: FloatArray
    rotvec_rad: FloatArray
    speed_m_s: FloatArray = field(default_factory=_empty)


@dataclass(frozen=True, slots=True)
class TaskVerdict:
    """Verdict on a task, of a demo's judge or of a person. `success`: None: not judged."""

    prompt: str
    success: bool | None
    said: str


@dataclass(frozen=True, slots=True)
class CameraView:
    """An image of the film strip.

    Args:
        t_s: since the run began.
        jpeg: a small JPEG file.
        model: input of the model, not the image of the camera.
    """

    t_s: float
    camera: str
    jpeg: bytes
    model: bool = False


@dataclass(slots=True)
class Evaluation:
    """Figures of one run, or of all runs.

    Args:
        name: ``record_id``.
        path: of the file; None for all runs.
        requests: chunks of the worker in control.
        executed: number of those of which a step was executed; None where unknown. That the arm did
            what was asked is another thing: see `segments` and `verdicts`.
        seconds: from the first request to the last.
        stages_ms: stage -> one value per request.
        request_t_s: time of each request, (n,).
        path_m: length of the path of the TCP; of the measured one where known.
        path_rad: length of that path in rotation.
        command_path_m: length of the commanded path.
        command_path_rad: length of the commanded path in rotation.
        tracking_mm: distance between commanded and measured position at the same time.
        tracking_mrad: angle between commanded and measured orientation.
        jerk: (n,) norm of the commanded jerk in m/s^3 (rad/s^3 for joint commands).
        active_s: time in which the arm was active.
        idle_s: part of that time in which it stood still.
        seam_goal_mm: step of the goal where a new chunk replaced another.
        seam_velocity_mm_s: step of the commanded velocity there.
        refusals: rejections, by reason.
        skipped: chunks left out in normal operation, by reason.
        width_m: gripper opening, (n,).
        width_t_s: times of `width_m`, (n,).
        gripper_orders: number of gripper commands.
        segments: motion during each prompt.
        problems: messages about what could not be read.
        about: where it comes from: name and value of each known fact.
        verdicts: on the tasks of the run.
        film: MP4 file of the cameras; its time is that of the run.
        measured: for plots.
        commanded: for plots.
        marks: (seconds, prompt), for plots.
        views: pictures at chosen times.
    """

    name: str
    path: Path | None = None
    requests: int = 0
    executed: int | None = None
    seconds: float = 0.0
    prompts: list[str] = field(default_factory=list)
    stages_ms: dict[str, FloatArray] = field(default_factory=dict)
    request_t_s: FloatArray = field(default_factory=_empty)
    path_m: float | None = None
    path_rad: float | None = None
    command_path_m: float | None = None
    command_path_rad: float | None = None
    tracking_mm: FloatArray = field(default_factory=_empty)
    tracking_mrad: FloatArray = field(default_factory=_empty)
    jerk: FloatArray = field(default_factory=_empty)
    jerk_unit: str = "m_s3"
    active_s: float | None = None
    idle_s: float | None = None
    seam_goal_mm: FloatArray = field(default_factory=_empty)
    seam_velocity_mm_s: FloatArray = field(default_factory=_empty)
    refusals: Counter[str] = field(default_factory=Counter)
    skipped: Counter[str] = field(default_factory=Counter)
    width_m: FloatArray = field(default_factory=_empty)
    width_t_s: FloatArray = field(default_factory=_empty)
    gripper_orders: int | None = None
    segments: list[PromptSegment] = field(default_factory=list)
    problems: list[str] = field(default_factory=list)
    about: dict[str, str] = field(default_factory=dict)
    verdicts: list[TaskVerdict] = field(default_factory=list)
    film: bytes = b""
    measured: PlotTrace | None = None
    commanded: PlotTrace | None = None
    marks: list[tuple[float, str]] = field(default_factory=list)
    views: list[CameraView] = field(default_factory=list)

    @property
    def executed_share(self) -> float | None:
        """Share of the requests of which a step was executed."""
        if self.executed is None or not self.requests:
            return None
        return self.executed / self.requests

    @property
    def reached_share(self) -> float | None:
        """Share of the motion that its prompt asks for, of the segment that reached the least."""
        return min((each.reached_share for each in self.segments if each.asked), default=None)

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
            "success_rate": self.executed_share,
            "reached_share": self.reached_share,
            "trans_total_m": self.path_m,
            "rot_total_rad": self.path_rad,
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
        """`row` and the figures that do not fit into one."""
        return self.row() | {
            "file": str(self.path) if self.path else None,
            "prompts": self.prompts,
            "latency_ms": {stage: asdict(found) for stage, found in self.latency().items()},
            "refusals": dict(sorted(self.refusals.items())),
            "skipped": dict(sorted(self.skipped.items())),
            "gripper_width_m": None
            if not np.isfinite(self.width_m).any()
            else {
                "first": float(self.width_m[0]),
                "last": float(self.width_m[-1]),
                "min": float(np.nanmin(self.width_m)),
                "max": float(np.nanmax(self.width_m)),
            },
            "segments": [asdict(segment) for segment in self.segments],
            "problems": self.problems,
            "about": self.about,
            "verdicts": [asdict(verdict) for verdict in self.verdicts],
        }


def _largest(values: Iterable[float | None]) -> float | None:
    return max((value for value in values if value is not None), default=None)


def _travel(width_m: FloatArray) -> float | None:
    there = width_m[np.isfinite(width_m)]
    return float(np.abs(np.diff(there)).sum()) if len(there) else None
