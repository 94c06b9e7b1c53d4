"""Motion segments: what a scripted prompt asks for, and how the measured motion compares. Pure."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from vla_zenoh.kinematics.so3 import Pose, log3
from vla_zenoh.lab.demo.scripted_motions import ScriptedMotion, ScriptedPrompt, parse_scripted
from vla_zenoh.types import FloatArray

TOLERANCE_M, TOLERANCE_RAD = 0.002, 0.005
DRIFT_MM = 1.0
TOLERANCE_WIDTH_M = 0.002


@dataclass(frozen=True, slots=True)
class DemoSegment:
    """One scripted prompt for a number of steps.

    Args:
        prompt: without the count.
        motion: of one step; None: hold.
        within: turn back before this distance (m or rad) from the start; None: never.
    """

    prompt: str
    steps: int
    motion: ScriptedMotion | None
    within: float | None = None

    @property
    def prompt_with_count(self) -> str:
        """The prompt that ends by itself after the steps."""
        return self._parsed.text

    @property
    def asked(self) -> FloatArray:
        """(6,) translation in m and rotation vector that the prompt asks for, base frame."""
        asked = np.zeros(6)
        if self.motion is not None and self.motion.axis < 6:
            asked[self.motion.axis] = self._parsed.offset(self.steps)
        return asked

    def width_after_m(self, before_m: float, max_width_m: float) -> float:
        """Gripper width that the prompt asks for, from `before_m`."""
        width_m = before_m
        if self.motion is not None and self.motion.axis == 6:
            for index in range(self.steps):
                width_m = min(max(width_m + self._parsed.step(index), 0.0), max_width_m)
        return width_m

    @property
    def _parsed(self) -> ScriptedPrompt:
        return ScriptedPrompt(self.motion, self.steps, self.within)


def make_segment(prompt: str, steps: int) -> DemoSegment:
    """The segment of a HARD prompt; a count in the prompt overrides `steps`.

    Raises:
        SpecError: the scripted model does not know the prompt.
    """
    parsed = parse_scripted(prompt)
    name = f"HARD: {parsed.motion.name}" if parsed.motion else "hold"
    steps = steps if parsed.steps is None else parsed.steps
    return DemoSegment(name, steps, parsed.motion, parsed.within)


@dataclass(frozen=True, slots=True)
class RestPose:
    """Measured pose and gripper width at rest."""

    pose: Pose
    width_m: float


@dataclass(frozen=True, slots=True)
class SegmentOutcome:
    """Measured motion of a segment, from rest to rest. Drift is motion that was not asked for.

    Args:
        reached_m: translation along the asked direction; 0 where none was asked.
        reached_rad: rotation about the asked axis; 0 where none was asked.
        drift_mm: translation off the asked direction.
        drift_rad: rotation off the asked axis.
        asked_width_m: gripper width that the prompt asks for.
        steps_done: steps the command node accepted.
        duration_s: from the prompt until rest.
    """

    segment: DemoSegment
    reached_m: float
    reached_rad: float
    drift_mm: float
    drift_rad: float
    asked_width_m: float
    reached_width_m: float
    steps_done: int
    duration_s: float

    @property
    def asked_m(self) -> float:
        return float(np.linalg.norm(self.segment.asked[:3]))

    @property
    def asked_rad(self) -> float:
        return float(np.linalg.norm(self.segment.asked[3:]))

    def faults(self) -> list[str]:
        """Deviations beyond the tolerances; empty: the arm did what was asked."""
        translation_mm = abs(self.reached_m - self.asked_m) * 1e3
        width_mm = abs(self.reached_width_m - self.asked_width_m) * 1e3
        checks = (
            ("translation", translation_mm, TOLERANCE_M * 1e3, "mm"),
            ("rotation", abs(self.reached_rad - self.asked_rad), TOLERANCE_RAD, "rad"),
            ("drift", self.drift_mm, DRIFT_MM, "mm"),
            ("rotation drift", self.drift_rad, TOLERANCE_RAD, "rad"),
            ("gripper", width_mm, TOLERANCE_WIDTH_M * 1e3, "mm"),
        )
        out = [
            f"{name} off by {value:.4g} {unit} (allowed {limit:g})"
            for name, value, limit, unit in checks
            if not value <= limit
        ]
        if self.steps_done != self.segment.steps:
            out.append(f"{self.steps_done} of {self.segment.steps} steps were executed")
        return out

    def to_dict(self) -> dict[str, Any]:
        faults = self.faults()
        return {
            "prompt": self.segment.prompt,
            "steps": self.segment.steps,
            "steps_done": self.steps_done,
            "asked": {
                "translation_m": self.asked_m,
                "rotation_rad": self.asked_rad,
                "gripper_width_m": self.asked_width_m,
            },
            "reached": {
                "translation_m": self.reached_m,
                "rotation_rad": self.reached_rad,
                "gripper_width_m": self.reached_width_m,
            },
            "drift_mm": self.drift_mm,
            "rotation_drift_rad": self.drift_rad,
            "duration_s": self.duration_s,
            "ok": not faults,
            "faults": faults,
        }


def judge_segment(
    segment: DemoSegment,
    before: RestPose,
    after: RestPose,
    *,
    max_width_m: float,
    steps_done: int,
    duration_s: float,
) -> SegmentOutcome:
    """Split the motion between two rest poses into what `segment` asks for and drift."""
    translation = after.pose.position_m - before.pose.position_m
    rotation = log3(after.pose.rotation @ before.pose.rotation.T)
    along_m, off_m = _split(translation, segment.asked[:3])
    about_rad, off_rad = _split(rotation, segment.asked[3:])
    return SegmentOutcome(
        segment,
        along_m,
        about_rad,
        off_m * 1e3,
        off_rad,
        segment.width_after_m(before.width_m, max_width_m),
        after.width_m,
        steps_done,
        duration_s,
    )


def _split(vector: FloatArray, asked: FloatArray) -> tuple[float, float]:
    """Length of `vector` along `asked`, and of the rest; all is rest where nothing was asked."""
    norm = float(np.linalg.norm(asked))
    if norm == 0.0:
        return 0.0, float(np.linalg.norm(vector))
    along = float(vector @ asked) / norm
    return along, float(np.linalg.norm(vector - along * asked / norm))
