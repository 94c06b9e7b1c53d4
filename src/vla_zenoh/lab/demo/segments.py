"""Which prompts a demo puts, one after the other, and what the arm has to do for each."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vla_zenoh.policy.scripted_motions import ScriptedMotion, ScriptedPrompt, parse_scripted
from vla_zenoh.types import FloatArray

TOUR: tuple[tuple[str, int], ...] = (
    ("HARD: go up", 15),
    ("HARD: roll right", 6),
    ("HARD: roll left", 6),
    ("HARD: pitch down", 6),
    ("HARD: pitch up", 6),
    ("HARD: yaw left", 10),
    ("HARD: yaw right", 10),
    ("HARD: close gripper", 2),
    ("HARD: open gripper", 2),
    ("HARD: go down", 15),
)
"""Every axis there and back, and the gripper, within reach of the home pose."""


@dataclass(frozen=True, slots=True)
class DemoSegment:
    """One prompt carried out for a number of steps.

    Args:
        prompt: as put, without the count.
        steps: how many.
        motion: what one step is; None: to stand still.
        within: turn back before this distance (m or rad) from the start; None: never.
    """

    prompt: str
    steps: int
    motion: ScriptedMotion | None
    within: float | None = None

    @property
    def prompt_with_count(self) -> str:
        """The prompt that ends by itself after the steps."""
        return f"{self.prompt} x{self.steps}{self._turning}"

    @property
    def prompt_without_end(self) -> str:
        """The prompt that goes on until another one is put."""
        return f"{self.prompt}{self._turning}"

    @property
    def _turning(self) -> str:
        return "" if self.within is None else f" within {self.within:g}"

    @property
    def translation_m(self) -> FloatArray:
        """(3,) asked for in the base frame."""
        return self._asked()[:3]

    @property
    def rotation_rad(self) -> FloatArray:
        """(3,) rotation vector asked for in the base frame."""
        return self._asked()[3:6]

    def width_after_m(self, before_m: float, max_width_m: float) -> float:
        """Gripper width asked for, after `before_m`."""
        width_m = before_m
        if self.motion is not None and self.motion.axis == 6:
            asked = ScriptedPrompt(self.motion, self.steps, self.within)
            for index in range(self.steps):
                width_m = min(max(width_m + asked.step(index), 0.0), max_width_m)
        return width_m

    def _asked(self) -> FloatArray:
        asked = np.zeros(7)
        if self.motion is not None:
            asked[self.motion.axis] = ScriptedPrompt(self.motion, self.steps, self.within).offset(
                self.steps
            )
        return asked


def make_segment(prompt: str, steps: int) -> DemoSegment:
    """A segment of a HARD prompt; a count in the prompt wins over `steps`.

    Raises:
        SpecError: not a prompt the scripted model knows.
    """
    asked = parse_scripted(prompt)
    name = f"HARD: {asked.motion.name}" if asked.motion else "hold"
    return DemoSegment(
        name, steps if asked.steps is None else asked.steps, asked.motion, asked.within
    )


def tour() -> list[DemoSegment]:
    """The default demo."""
    return [make_segment(prompt, steps) for prompt, steps in TOUR]
