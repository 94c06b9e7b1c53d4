"""What a trial asks: which workers, for what, from which setups, in which order."""

from __future__ import annotations

import math
import random
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, fields
from typing import Any

from vla_zenoh.errors import RecordError
from vla_zenoh.lab.trial.verdict import EpisodeVerdict

MAX_SETUPS = 10_000
HIDDEN = "[worker]"
"""Stands for every worker's name while nobody is to know which one is at work."""


@dataclass(frozen=True, slots=True)
class DueEpisode:
    """The next episode.

    Args:
        setup: number of its setup, from 1.
        turn: which of that setup's episodes it is, from 1.
        worker: that is to be obeyed.
    """

    setup: int
    turn: int
    worker: str


@dataclass(frozen=True, slots=True)
class TrialPlan:
    """What is to be done: every worker does every setup once.

    Args:
        robot: its name.
        workers: each once.
        prompt: put before every episode.
        setups: words for each, empty where a number is all there is.
        seconds: an episode lasts at most so long.
        seed: of the order.
        blind: the person is not told who is at work.

    Raises:
        RecordError: one of them is not allowed.
    """

    robot: str
    workers: tuple[str, ...]
    prompt: str
    setups: tuple[str, ...]
    seconds: float
    seed: int
    blind: bool

    def __post_init__(self) -> None:
        if not self.workers or not all(self.workers):
            raise RecordError("workers: name one or more, separated by commas")
        if len(set(self.workers)) != len(self.workers):
            raise RecordError(f"workers: {', '.join(self.workers)} names one of them twice")
        if not self.prompt.strip():
            raise RecordError("prompt: say what the workers are to do")
        if not 1 <= len(self.setups) <= MAX_SETUPS:
            raise RecordError(f"setups: {len(self.setups)}, allowed: 1 to {MAX_SETUPS}")
        if not (math.isfinite(self.seconds) and self.seconds > 0):
            raise RecordError(f"seconds: {self.seconds}, allowed: more than 0")

    @property
    def episodes(self) -> int:
        """How many there are in all."""
        return len(self.setups) * len(self.workers)

    def words(self, setup: int) -> str:
        """Of the setup with this number, from 1."""
        return self.setups[setup - 1]

    def order(self, setup: int) -> tuple[str, ...]:
        """Who does this setup first, who next: drawn for each setup anew."""
        workers = list(self.workers)
        random.Random(f"{self.seed} {setup}").shuffle(workers)
        return tuple(workers)

    def next_due(self, done: Iterable[EpisodeVerdict]) -> DueEpisode | None:
        """What comes after `done`; None: nothing. Void episodes do not count as done."""
        judged = {(each.setup, each.worker) for each in done if each.verdict != "void"}
        for setup in range(1, len(self.setups) + 1):
            for turn, worker in enumerate(self.order(setup), 1):
                if (setup, worker) not in judged:
                    return DueEpisode(setup, turn, worker)
        return None

    def other_than(self, asked: Mapping[str, Any]) -> list[str]:
        """What was asked for that this plan has not, in words; fields that are None were not."""
        out = []
        for field in fields(self):
            wanted, mine = asked.get(field.name), getattr(self, field.name)
            if wanted is not None and wanted != mine:
                out.append(f"{field.name} {_said(mine)}, not {_said(wanted)}")
        return out

    def hide(self, text: str) -> str:
        """`text` without the workers' names, where nobody is to know them."""
        if not self.blind:
            return text
        names = "|".join(sorted(map(re.escape, self.workers), key=len, reverse=True))
        return re.sub(rf"(?<!\w)({names})(?!\w)", HIDDEN, text)


def _said(value: Any) -> str:
    if isinstance(value, tuple):
        return ", ".join(value) if len(value) <= 5 and any(value) else f"({len(value)} of them)"
    return repr(value) if isinstance(value, str) else f"{value}"
