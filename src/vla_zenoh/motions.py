"""The thesis's ten HARD prompts: fixed deltas whose outcome is known beforehand.

``HARD: go up`` asks for one step of 0.01 m per request; ``HARD: go up x50`` for 50 of them, after
which the arm is to stand still. Source: the set points of "Building a ROS2-VLA Bridge".
"""

from __future__ import annotations

import re
from typing import NamedTuple

from vla_zenoh.errors import SpecError

STEP_M, STEP_RAD, STEP_WIDTH_M = 0.01, 0.05, 0.05
MAX_COUNT = 100_000


class HardMotion(NamedTuple):
    """One step of a motion.

    Args:
        name: as in the prompt.
        axis: 0..2 translation along x, y, z of the base, 3..5 rotation about them, 6 gripper width.
        step: m or rad.
    """

    name: str
    axis: int
    step: float


HARD: dict[str, HardMotion] = {
    motion.name: motion
    for motion in (
        HardMotion("go up", 2, STEP_M),
        HardMotion("go down", 2, -STEP_M),
        HardMotion("roll right", 3, STEP_RAD),
        HardMotion("roll left", 3, -STEP_RAD),
        HardMotion("pitch down", 4, STEP_RAD),
        HardMotion("pitch up", 4, -STEP_RAD),
        HardMotion("yaw left", 5, STEP_RAD),
        HardMotion("yaw right", 5, -STEP_RAD),
        HardMotion("open gripper", 6, STEP_WIDTH_M),
        HardMotion("close gripper", 6, -STEP_WIDTH_M),
    )
}
_PROMPT = re.compile(r"(?:hard:)?\s*(?P<name>[a-z ]+?)\s*(?:[x\u00d7]\s*(?P<count>\d{1,6}))?", re.I)


class HardPrompt(NamedTuple):
    """A prompt that was understood: `motion` None is ``hold``; `steps` None has no end."""

    motion: HardMotion | None
    steps: int | None


def parse_hard(prompt: str) -> HardPrompt:
    """Read ``HARD: go up``, ``HARD: rol left x20`` (so spelt in the thesis too) or ``hold``.

    Raises:
        SpecError: it names no motion; lists those there are.
    """
    match = _PROMPT.fullmatch(" ".join(prompt.split()))
    name = match["name"].lower().replace("rol ", "roll ") if match else ""
    count = int(match["count"]) if match and match["count"] else None
    if match is not None and name == "hold":
        return HardPrompt(None, count)
    if match is None or name not in HARD or (count or 0) > MAX_COUNT:
        raise SpecError(
            f"the scripted model does not know the prompt {prompt!r}; it knows: 'hold', "
            + ", ".join(f"'HARD: {known}'" for known in HARD)
            + "; a count may follow, as in 'HARD: go up x50'"
        )
    return HardPrompt(HARD[name], count)
