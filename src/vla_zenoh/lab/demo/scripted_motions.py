"""The thesis's ten HARD prompts: fixed deltas whose outcome is known beforehand.

``HARD: go up`` asks for one step of 0.01 m per request; ``HARD: go up x50`` for 50 of them, after
which the arm stands still; ``HARD: go down x50 within 0.1`` turns back before it is further than
0.1 m (or rad) from where it began, and again when it is back there. Source: the set points of
"Building a ROS2-VLA Bridge".
"""

from __future__ import annotations

import re
from functools import lru_cache
from typing import NamedTuple

from vla_zenoh.errors import PromptError

STEP_M, STEP_RAD, STEP_WIDTH_M = 0.01, 0.05, 0.05
MAX_COUNT = 100_000
GRIPPER_AXIS = 6


class ScriptedMotion(NamedTuple):
    """One step of a motion.

    Args:
        name: as in the prompt.
        axis: 0..2 translation along x, y, z of the base, 3..5 rotation about them, 6 gripper width.
        step: m or rad.
    """

    name: str
    axis: int
    step: float


HARD: dict[str, ScriptedMotion] = {
    motion.name: motion
    for motion in (
        ScriptedMotion("go up", 2, STEP_M),
        ScriptedMotion("go down", 2, -STEP_M),
        ScriptedMotion("roll right", 3, STEP_RAD),
        ScriptedMotion("roll left", 3, -STEP_RAD),
        ScriptedMotion("pitch down", 4, STEP_RAD),
        ScriptedMotion("pitch up", 4, -STEP_RAD),
        ScriptedMotion("yaw left", 5, STEP_RAD),
        ScriptedMotion("yaw right", 5, -STEP_RAD),
        ScriptedMotion("open gripper", 6, STEP_WIDTH_M),
        ScriptedMotion("close gripper", 6, -STEP_WIDTH_M),
    )
}
_PROMPT = re.compile(
    r"(?:hard:)?\s*(?P<name>[a-z ]+?)\s*"
    r"(?:[x\u00d7]\s*(?P<count>\d{1,6}))?\s*(?:within\s*(?P<within>\d+(?:\.\d+)?))?",
    re.I,
)


class ScriptedPrompt(NamedTuple):
    """A parsed prompt.

    Args:
        motion: None: stand still.
        steps: how many; None: no end.
        within: turn back before this distance (m or rad) from the start; None: never.
    """

    motion: ScriptedMotion | None
    steps: int | None
    within: float | None = None

    @property
    def text(self) -> str:
        """The prompt, as `parse_scripted` reads it."""
        name = "hold" if self.motion is None else f"HARD: {self.motion.name}"
        count = "" if self.steps is None else f" x{self.steps}"
        return name + count + ("" if self.within is None else f" within {self.within:g}")

    def offset(self, steps: float) -> float:
        """Where the asked axis is after `steps` of them, in m or rad from the start."""
        if self.motion is None:
            return 0.0
        return self._folded(steps) * self.motion.step

    def step(self, index: int) -> float:
        """What step `index` (from 0) asks for, in m or rad."""
        return self.offset(index + 1) - self.offset(index)

    def _folded(self, steps: float) -> float:
        if self.motion is None or self.within is None:
            return steps
        leg = max(1, int(self.within / abs(self.motion.step) + 1e-9))
        turn, along = divmod(steps, leg)
        return along if turn % 2 == 0 else leg - along


@lru_cache(maxsize=64)
def parse_scripted(prompt: str) -> ScriptedPrompt:
    """Read ``HARD: go up``, ``HARD: rol left x20`` (so spelt in the thesis too) or ``hold``.

    Raises:
        PromptError: it names no motion; lists the known ones.
    """
    match = _PROMPT.fullmatch(" ".join(prompt.split()))
    name = match["name"].lower().replace("rol ", "roll ") if match else ""
    count = int(match["count"]) if match and match["count"] else None
    within = float(match["within"]) if match and match["within"] else None
    if match is not None and name == "hold":
        return ScriptedPrompt(None, count)
    if match is None or name not in HARD or (count or 0) > MAX_COUNT or within == 0.0:
        raise PromptError(
            f"the scripted model does not know the prompt {prompt!r}; it knows: 'hold', "
            + ", ".join(f"'HARD: {known}'" for known in HARD)
            + "; a count and a range may follow, as in 'HARD: go down x50 within 0.1'"
        )
    return ScriptedPrompt(HARD[name], count, within)
