"""A second worker that watches an episode and leads the arm from where both disagree to its end.

So an expert corrects a policy (DAgger: Ross, Gordon and Bagnell, AISTATS 2011): what it does from
there on is what the policy would have had to do in states that it came to by itself.
"""

from __future__ import annotations

from collections import deque

import numpy as np

from vla_zenoh.types import ActionChunk, FloatArray
from vla_zenoh_benchmarks.contract import raw_steps
from vla_zenoh_benchmarks.episode import Asked, EpisodeClock

WINDOW_S = 0.25
"""Both are compared over this time: one step in another direction is no disagreement."""


class Takeover:
    """A teacher beside the model of an episode.

    Args:
        teacher: asked at every step; what it asks for is carried out once it leads.
        disagreement: ratio of the difference between both motions within `WINDOW_S` to the
            teacher's motion, from which on it leads; an arm that stands has 1.
    """

    def __init__(self, teacher: Asked, disagreement: float) -> None:
        self.teacher, self._least = teacher, disagreement

    def begin(self, clock: EpisodeClock) -> None:
        """An episode begins."""
        self.teacher.begin(clock.request.task.prompt)
        count = max(1, round(WINDOW_S / clock.benchmark.action.dt_s))
        self._apart: deque[float] = deque(maxlen=count)
        self._moved: deque[float] = deque(maxlen=count)

    def disagrees(self, clock: EpisodeClock, action: FloatArray) -> bool:
        """Whether the teacher has to lead from here on, where the model asks for `action`."""
        self._answer, own = self._ask(clock)
        arm = slice(None) if clock.benchmark.action.gripper == "none" else slice(-1)
        self._apart.append(float(np.linalg.norm((action - own)[arm])))
        self._moved.append(float(np.linalg.norm(own[arm])))
        full = len(self._apart) == self._apart.maxlen
        return full and sum(self._apart) > self._least * sum(self._moved)

    def lead(self, clock: EpisodeClock) -> None:
        """Let the teacher lead to the end of the episode; its last answer is for now."""
        clock.taken_over_by(self.teacher)
        answer = self._answer
        while not clock.over:
            clock.heard(answer)
            (action,) = self._steps(clock, answer)
            clock.step(action)
            if not clock.over:
                answer, _ = self._ask(clock)

    def _ask(self, clock: EpisodeClock) -> tuple[ActionChunk, FloatArray]:
        cameras = [one.camera for one in self.teacher.spec.observation.cameras]
        answer = self.teacher.ask(clock.benchmark.observe(cameras))
        return answer, self._steps(clock, answer)[0]

    def _steps(self, clock: EpisodeClock, answer: ActionChunk) -> FloatArray:
        """The first step of an answer, (1, D), in the benchmark's numbers."""
        return raw_steps(answer.steps[:1], self.teacher.spec.action, clock.benchmark.action)
