"""The tasks a demo lets a policy do: prompts as given, or one of every family."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from vla_zenoh.lab.bench.task import TaskAsked, TaskPlan
from vla_zenoh.lab.tasks import FAMILIES, Order, TaskEpisode
from vla_zenoh.lab.tasks.understand import makes_no_sense, understand
from vla_zenoh.types import ObjectPoses

STAY = "stay"
FIRST_SEED = 1
"""The layout where nobody asks for another."""


@dataclass(frozen=True, slots=True)
class SpokenTask(TaskAsked):
    """An episode with a prompt that somebody thought of.

    Args:
        prompt: as put.
    """

    prompt: str = ""

    def draw(self, objects: ObjectPoses, *, held_out: bool) -> TaskEpisode:
        """What the prompt asks for; the arm is to stay where it asks for nothing."""
        return TaskEpisode(self.seed, understand(self.prompt) or Order(STAY), self.prompt)


@dataclass(frozen=True, slots=True)
class Tour(TaskPlan):
    """Some prompts, or one task of every family, each in the same layout.

    Args:
        prompts: to be put one after the other; empty: one of every family, drawn.
    """

    prompts: tuple[str, ...] = ()

    def asked(self) -> Iterator[TaskAsked]:
        """Every episode."""
        for prompt in self.prompts:
            yield SpokenTask(self.seed, STAY, None, prompt)
        if not self.prompts:
            for family in FAMILIES:
                yield TaskAsked(self.seed, family)


def judged(prompt: str) -> bool:
    """Whether it is known here what `prompt` asks for."""
    return understand(prompt) is not None or makes_no_sense(prompt)
