"""Motion protocol: ten prompts, 50 steps each, at several rates, and the row of each. Pure.

Where 50 steps would leave the arm's reach, the path turns back instead of being cut. A prompt
starts where its preparation has left the arm.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.motion.segments import DemoSegment, SegmentOutcome, make_segment
from vla_zenoh.kinematics.so3 import Pose, log3, norm3
from vla_zenoh.profile import Profile
from vla_zenoh.types import FloatArray

STEPS = 50
RATES_HZ = (1.0, 2.0, 5.0, 10.0)
PREPARATION_HZ = 10.0
WAY_HZ = 20.0
"""Rate of the measured poses that a path length is summed over, so that tremor does not count."""
TOLERANCE_M, TOLERANCE_RAD = 0.001, 0.002
OFF_AXIS_MM, OFF_AXIS_RAD = 1.0, 0.002
VELOCITY_STEP_SLACK = 1.02
"""Share by which a velocity step may exceed acceleration limit times period, for rounding."""


@dataclass(frozen=True, slots=True)
class MotionCase:
    """One prompt of the protocol.

    Args:
        prompt: HARD prompt, with where to turn back.
        preparation: prompt that moves the arm to the start, or "".
    """

    prompt: str
    preparation: str = ""

    @property
    def name(self) -> str:
        """The motion's name."""
        return self.segment.motion.name if self.segment.motion else "hold"

    @property
    def segment(self) -> DemoSegment:
        """The segment to run."""
        return make_segment(self.prompt, STEPS)


PROTOCOL: tuple[MotionCase, ...] = (
    MotionCase("HARD: go up"),
    MotionCase("HARD: go down", "HARD: go up x50"),
    MotionCase("HARD: roll left within 0.9", "HARD: go up x20"),
    MotionCase("HARD: roll right within 0.9", "HARD: go up x20"),
    MotionCase("HARD: pitch up within 0.9", "HARD: go up x20"),
    MotionCase("HARD: pitch down within 0.9", "HARD: go up x20"),
    MotionCase("HARD: yaw left", "HARD: go up x20"),
    MotionCase("HARD: yaw right within 2.0", "HARD: go up x20"),
    MotionCase("HARD: close gripper within 0.08"),
    MotionCase("HARD: open gripper within 0.08"),
)


@dataclass(frozen=True, slots=True)
class Conditions:
    """Conditions of a run.

    Args:
        rate_hz: requests per second.
        horizon: steps of a chunk.
        delay_ms: duration of an inference.
        jitter: share by which that varies.
    """

    rate_hz: float
    horizon: int = 1
    delay_ms: float = 0.0
    jitter: float = 0.0

    @property
    def name(self) -> str:
        """As shown in progress."""
        chunk = f", chunks of {self.horizon}" if self.horizon > 1 else ""
        delay = f", {self.delay_ms:g} ms +-{self.jitter:.0%}" if self.delay_ms else ""
        return f"{self.rate_hz:g} Hz{chunk}{delay}"


@dataclass(frozen=True, slots=True)
class MeasuredStream:
    """The commanded motion of a case.

    Args:
        time_s: (n,) stamps.
        twist: (n, 6).
        acceleration: (n, 6).
        chunk_seq: (n,) chunk that each command is caused by; -1: none.
        path_m: path length of the measured TCP in translation.
        path_rad: path length in rotation.
        tracking_m: largest distance between measured and reference pose.
        e2e_ms: camera stamp to pose command, one per chunk.
        outbound_ms: camera stamp to chunk received, one per chunk.
    """

    time_s: FloatArray
    twist: FloatArray
    acceleration: FloatArray
    chunk_seq: NDArray[np.int64]
    path_m: float
    path_rad: float
    tracking_m: float
    e2e_ms: Sequence[float]
    outbound_ms: Sequence[float]


def failed_row(trial: MotionCase, conditions: Conditions, why: str) -> dict[str, Any]:
    """The row of a case that did not end; it has no figures."""
    return {"prompt": trial.name, **asdict(conditions), "faults": [why], "ok": False}


def make_row(
    trial: MotionCase,
    conditions: Conditions,
    profile: Profile,
    outcome: SegmentOutcome,
    stream: MeasuredStream,
    refused: Mapping[str, int] | None = None,
) -> dict[str, Any]:
    """One row of the result; `refused`: rejections of the nodes meanwhile, by ``node.reason``."""
    translation, rotation = profile.limits.translation, profile.limits.rotation
    # Commands are whole periods apart; their stamps add the jitter of reading the clock.
    period_s = 1.0 / profile.timing.command_hz
    step_s = np.round(np.diff(stream.time_s) / period_s) * period_s
    inside = step_s > 0
    step_s = step_s[inside][:, None]
    jerk = np.diff(stream.acceleration, axis=0)[inside] / step_s
    at_seam = (np.diff(stream.chunk_seq) != 0)[inside]
    change = np.diff(stream.twist, axis=0)[inside] / step_s
    motion = outcome.segment.motion
    axis = motion.axis if motion else 0
    asked_path = abs(motion.step) * outcome.segment.steps if motion else 0.0
    row: dict[str, Any] = {
        "prompt": trial.name,
        **asdict(conditions),
        "steps": outcome.segment.steps,
        "steps_done": outcome.steps_done,
        "within": outcome.segment.within,
        "asked_m": outcome.asked_m,
        "asked_rad": outcome.asked_rad,
        "reached_m": outcome.reached_m,
        "reached_rad": outcome.reached_rad,
        "asked_path_m": asked_path if axis < 3 else 0.0,
        "asked_path_rad": asked_path if 3 <= axis < 6 else 0.0,
        "path_m": stream.path_m,
        "path_rad": stream.path_rad,
        "off_axis_mm": outcome.drift_mm,
        "off_axis_rad": outcome.drift_rad,
        "asked_width_m": outcome.asked_width_m,
        "reached_width_m": outcome.reached_width_m,
        "e2e_ms_p50": _percentile(stream.e2e_ms, 50),
        "e2e_ms_p95": _percentile(stream.e2e_ms, 95),
        "e2e_ms_mean": _mean(stream.e2e_ms),
        "outbound_ms_p50": _percentile(stream.outbound_ms, 50),
        "outbound_ms_mean": _mean(stream.outbound_ms),
        "outbound_ms_p95": _percentile(stream.outbound_ms, 95),
        "tracking_mm": stream.tracking_m * 1e3,
        "peak_velocity_m_s": _peak(stream.twist[:, :3]),
        "peak_velocity_rad_s": _peak_norm(stream.twist[:, 3:]),
        "peak_acceleration_m_s2": _peak(stream.acceleration[:, :3]),
        "peak_acceleration_rad_s2": _peak_norm(stream.acceleration[:, 3:]),
        "peak_jerk_over_limit": _jerk_over_limit(jerk, profile),
        # Jerk at the seams between chunks, and elsewhere.
        "seams": int(at_seam.sum()),
        "seam_jerk_over_limit": _jerk_over_limit(jerk[at_seam], profile),
        "elsewhere_jerk_over_limit": _jerk_over_limit(jerk[~at_seam], profile),
        "peak_velocity_step_over_limit": max(
            _peak(change[:, :3]) / translation.acceleration_m_s2,
            _peak_norm(change[:, 3:]) / rotation.acceleration_rad_s2,
        ),
    }
    row["refused"] = dict(refused or {})
    row["faults"] = faults_of(row, outcome)
    row["ok"] = not row["faults"]
    return row


def faults_of(row: dict[str, Any], outcome: SegmentOutcome) -> list[str]:
    """Violations of the protocol's tolerances in a row."""
    checks = (
        ("translation", abs(row["reached_m"] - row["asked_m"]), TOLERANCE_M, "m"),
        ("rotation", abs(row["reached_rad"] - row["asked_rad"]), TOLERANCE_RAD, "rad"),
        ("off axis", row["off_axis_mm"], OFF_AXIS_MM, "mm"),
        ("off axis", row["off_axis_rad"], OFF_AXIS_RAD, "rad"),
        ("gripper", abs(row["reached_width_m"] - row["asked_width_m"]), 0.002, "m"),
        ("jerk", row["peak_jerk_over_limit"], 1.001, "times its limit"),
        (
            "velocity step",
            row["peak_velocity_step_over_limit"],
            VELOCITY_STEP_SLACK,
            "times what acceleration allows",
        ),
    )
    out = [
        f"{name} {value:.4g} {unit}" for name, value, limit, unit in checks if not value <= limit
    ]
    # Steps of overlapping chunks are requested more than once and executed once.
    wanted = outcome.segment.steps
    if outcome.steps_done < wanted or (row["horizon"] == 1 and outcome.steps_done > wanted):
        why = ", ".join(f"{name} {count}" for name, count in row["refused"].items())
        steps = f"{outcome.steps_done} of {outcome.segment.steps} steps"
        out.append(f"{steps} (refused: {why or 'nothing'})")
    return out


def path_length(poses: Sequence[Pose]) -> tuple[float, float]:
    """Path length through `poses`: m, and rad of the angles between them."""
    pairs = list(pairwise(poses))
    return (
        sum(norm3(b.position_m - a.position_m) for a, b in pairs),
        sum(norm3(log3(b.rotation @ a.rotation.T)) for a, b in pairs),
    )


def _jerk_over_limit(jerk: FloatArray, profile: Profile) -> float:
    """Largest of (n, 6) jerks, as a share of what the profile allows."""
    limits = profile.limits
    return max(
        _peak(jerk[:, :3]) / limits.translation.jerk_m_s3,
        _peak_norm(jerk[:, 3:]) / limits.rotation.jerk_rad_s3,
    )


def _percentile(values: Sequence[float], share: float) -> float | None:
    return round(float(np.percentile(values, share)), 3) if len(values) else None


def _mean(values: Sequence[float]) -> float | None:
    return round(float(np.mean(values)), 3) if len(values) else None


def _peak(values: FloatArray) -> float:
    return float(np.abs(values).max()) if values.size else 0.0


def _peak_norm(values: FloatArray) -> float:
    return float(np.linalg.norm(values, axis=1).max()) if values.size else 0.0
