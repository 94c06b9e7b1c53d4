"""Plan of a trial: workers, prompt, setups, and the random order of episodes. Pure."""

from __future__ import annotations

import math
import random
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, fields
from typing import Any

from vla_zenoh.errors import RecordError
from vla_zenoh_trial.verdict import EpisodeVerdict

MAX_SETUPS = 10_000
HIDDEN = "[worker]"
"""Replaces the names of workers in a blind trial."""


@dataclass(frozen=True, slots=True)
class DueEpisode:
    """The next episode.

    Args:
        setup: number of its setup, from 1.
        turn: which of that setup's episodes, from 1.
    """

    setup: int
    turn: int
    worker: str


@dataclass(frozen=True, slots=True)
class TrialPlan:
    """Every worker does every setup once.

    Args:
        setups: a description of each; empty: its number is enough.

    Raises:
        RecordError: a value is not allowed.
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
            raise RecordError("prompt: empty; it is the task of the workers")
        if not 1 <= len(self.setups) <= MAX_SETUPS:
            raise RecordError(f"setups: {len(self.setups)}, allowed: 1 to {MAX_SETUPS}")
        if not (math.isfinite(self.seconds) and self.seconds > 0):
            raise RecordError(f"seconds: {self.seconds}, allowed: more than 0")

    @property
    def episodes(self) -> int:
        return len(self.setups) * len(self.workers)

    def words(self, setup: int) -> str:
        """Description of a setup, by its number from 1."""
        return self.setups[setup - 1]

    def order(self, setup: int) -> tuple[str, ...]:
        """The workers in the order in which they do this setup, drawn from the seed."""
        workers = list(self.workers)
        random.Random(f"{self.seed} {setup}").shuffle(workers)
        return tuple(workers)

    def next_due(self, done: Iterable[EpisodeVerdict]) -> DueEpisode | None:
        """The first episode without a verdict other than void in `done`; None: all have one."""
        judged = {(each.setup, each.worker) for each in done if each.verdict != "void"}
        for setup in range(1, len(self.setups) + 1):
            for turn, worker in enumerate(self.order(setup), 1):
                if (setup, worker) not in judged:
                    return DueEpisode(setup, turn, worker)
        return None

    def differences(self, asked: Mapping[str, Any]) -> list[str]:
        """Fields of `asked` that differ from this plan, as text; fields that are None do not."""
        out = []
        for field in fields(self):
            wanted, mine = asked.get(field.name), getattr(self, field.name)
            if wanted is not None and wanted != mine:
                out.append(f"{field.name} {_shown(mine)}, not {_shown(wanted)}")
        return out

    def hide(self, text: str) -> str:
        """`text` without the names of workers, in a blind trial."""
        if not self.blind:
            return text
        names = "|".join(sorted(map(re.escape, self.workers), key=len, reverse=True))
        return re.sub(rf"(?<!\w)({names})(?!\w)", HIDDEN, text)


def _shown(value: Any) -> str:
    if isinstance(value, tuple):
        return ", ".join(value) if len(value) <= 5 and any(value) else f"({len(value)} of them)"
    return repr(value) if isinstance(value, str) else f"{value}"
