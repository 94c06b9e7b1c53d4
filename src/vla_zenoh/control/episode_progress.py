"""How far the episode is: what was taken of its chunks, and whether the model is done."""

from __future__ import annotations

import math

from vla_zenoh.control.plan_timeline import GoalTimeline

WHOLE_STEP = 1e-6
"""Parts of steps that sum up to all but this are a step."""


class EpisodeProgress:
    """See the module. `chunks` that were accepted, `steps` of them that came in force."""

    def __init__(self) -> None:
        self.begin()

    def begin(self) -> None:
        """An episode begins."""
        self.chunks = self.steps = 0
        self.done = False

    def look(self, timeline: GoalTimeline, episode: int, now_ns: int) -> None:
        """Steps that have come in force, and whether they were the last ones."""
        plan = timeline.plan
        if plan.episode != episode:
            return
        steps = math.floor(plan.steps_in_force(now_ns) + WHOLE_STEP)
        self.steps = max(self.steps, steps)
        self.done = plan.done and plan.index_at(now_ns) == len(plan.goals) - 1
