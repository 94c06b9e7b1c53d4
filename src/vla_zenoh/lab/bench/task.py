"""What the task benchmark asks, and what its outcomes add up to."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np

from vla_zenoh.errors import ResourceError
from vla_zenoh.lab.statistics import wilson_95
from vla_zenoh.lab.tasks import (
    COLOURS,
    FAMILIES,
    LIMIT_S,
    Order,
    TaskEpisode,
    draw_episode,
    draw_stay,
)
from vla_zenoh.lab.tasks.wording import is_nonsense, parse_prompt
from vla_zenoh.policy.model_options import shown
from vla_zenoh.types import ObjectPoses

SCENE = "bricks"
"""The scene that has what tasks are about."""
STAY = "stay"
NOT_OBEYED, ARM_LOST, NO_STATE = "not_obeyed", "arm_lost", "no_state"
CHAIN_FAILURES: Mapping[str, str] = {
    NOT_OBEYED: "the arm was not given to the worker: activation was refused to the end",
    ARM_LOST: "the arm was taken from the worker while it was at work",
    NO_STATE: "the simulator's objects were not heard",
}
"""Kinds of failure of the chain, beside those of the task (`vla_zenoh.lab.tasks.FAILURES`)."""

BASELINES: Mapping[str, tuple[str, str]] = {
    "hold": ("scripted", "hold"),
    "scripted": ("scripted", "HARD: go down x12"),
}
"""Names that stand for a worker and a prompt of its own. Neither knows any task: what they reach is
what the measure gives away."""


@dataclass(frozen=True, slots=True)
class TaskPlan:
    """What is to be run.

    Args:
        model: name of the worker, or of one of `BASELINES`.
        episodes: how many.
        seed: of the first layout; the next ones follow it.
        family: one of `FAMILIES` or ``stay``; None: all three by turns.
        held_out: prompts in words that no model was trained with.
        pairs: each layout is used twice, with another brick the second time.
        prompt: put in place of the episode's own.
        limit_s: for one episode.
        rate_hz: chunks per second; None: as the profile says.
        delay_ms: added to every inference.
    """

    model: str
    episodes: int
    seed: int
    family: str | None = None
    held_out: bool = False
    pairs: bool = False
    prompt: str | None = None
    limit_s: float = LIMIT_S
    rate_hz: float | None = None
    delay_ms: float = 0.0

    @property
    def worker(self) -> str:
        """The worker that runs."""
        return BASELINES.get(self.model, (self.model, ""))[0]

    def requests(self) -> Iterator[TaskRequest]:
        """Every episode, before its layout is known."""
        families = (self.family,) if self.family else FAMILIES
        for index in range(self.episodes):
            layout = index // 2 if self.pairs else index
            yield TaskRequest(
                self.seed + layout,
                families[layout % len(families)],
                COLOURS[(layout + index % 2) % len(COLOURS)] if self.pairs else None,
            )

    def prompt_for(self, episode: TaskEpisode) -> str:
        """The prompt that is put for `episode`."""
        return self.prompt or BASELINES.get(self.model, ("", episode.prompt))[1]


@dataclass(frozen=True, slots=True)
class TaskRequest:
    """One episode to run.

    Args:
        seed: of the layout.
        family: of the task.
        target: colour of the brick, None: any.
    """

    seed: int
    family: str
    target: str | None = None

    def draw(self, objects: ObjectPoses, *, held_out: bool) -> TaskEpisode:
        """The task in this layout.

        A push that has no free way with the brick asked for is drawn with any other; where no brick
        has one, another family is asked instead of leaving the layout out.
        """
        if self.family == STAY:
            return draw_stay(self.seed)
        for family, target in ((self.family, self.target), (self.family, None)):
            try:
                return draw_episode(
                    self.seed, objects, family=family, target=target, held_out=held_out
                )
            except ResourceError:
                continue
        others = [family for family in FAMILIES if family != self.family]
        return draw_episode(self.seed, objects, family=others[0], held_out=held_out)


@dataclass(frozen=True, slots=True)
class TaskOutcome:
    """How one episode ended.

    Args:
        episode: what was asked.
        prompt: what was put.
        success: it was done.
        failure: kind, empty after a success.
        time_s: from activation to the verdict.
        why: a sentence, where the chain failed.
        pictures: (beginning, end) as JPEG, where there are any.
    """

    episode: TaskEpisode
    prompt: str
    success: bool
    failure: str
    time_s: float
    why: str = ""
    pictures: tuple[bytes, bytes] | None = None

    def to_dict(self) -> dict[str, Any]:
        """Plain types, without pictures."""
        order = {name: value for name, value in asdict(self.episode.order).items() if value}
        return {
            "seed": self.episode.seed,
            **order,
            "prompt": self.prompt,
            "success": self.success,
            "failure": self.failure,
            "time_s": round(self.time_s, 3),
            **({"why": self.why} if self.why else {}),
        }


@dataclass(slots=True)
class TaskScore:
    """All outcomes of a plan, and what they add up to.

    Args:
        plan: what was run.
        mode: ``real_time`` or ``lockstep``.
        profile: its name.
        vary: what was varied beside the places.
        ended: the outcomes.
        latency_ms: stage -> ``[p50, p95]``.
        wall_s: how long it all took.
        options: of the model, in force.
    """

    plan: TaskPlan
    mode: str
    profile: str
    vary: Sequence[str] = ()
    ended: list[TaskOutcome] = field(default_factory=list)
    latency_ms: dict[str, tuple[float, float]] = field(default_factory=dict)
    wall_s: float = 0.0
    options: Mapping[str, str] = field(default_factory=dict)

    def to_dict(self) -> dict[str, Any]:
        """Plain types."""
        plan = self.plan
        families = sorted({each.episode.order.family for each in self.ended})
        out: dict[str, Any] = {
            "model": plan.model,
            "options": shown(self.options),
            "mode": self.mode,
            "profile": self.profile,
            "scene": SCENE,
            "seed": plan.seed,
            "family": plan.family or "all",
            "held_out": plan.held_out,
            "prompt": plan.prompt,
            "vary": list(self.vary),
            "delay_ms": plan.delay_ms,
            "rate_hz": plan.rate_hz,
            "limit_s": plan.limit_s,
            **_figures(self.ended),
            "by_family": {
                family: _figures([e for e in self.ended if e.episode.order.family == family])
                for family in families
            },
            "latency_ms": {name: list(pair) for name, pair in self.latency_ms.items()},
            "wall_s": round(self.wall_s, 1),
            "all": [each.to_dict() for each in self.ended],
        }
        if plan.pairs:
            first, second = self.ended[0::2], self.ended[1::2]
            out["pairs"] = {"first_brick": _figures(first), "other_brick": _figures(second)}
        return out


def _figures(ended: Sequence[TaskOutcome]) -> dict[str, Any]:
    successes = sum(each.success for each in ended)
    times_s = [each.time_s for each in ended if each.success]
    kinds = Counter(each.failure for each in ended if not each.success)
    return {
        "success_rate": successes / len(ended) if ended else None,
        "successes": successes,
        "episodes": len(ended),
        "wilson_95": list(wilson_95(successes, len(ended))),
        "failures": dict(kinds.most_common()),
        "time_to_success_s": {
            "p50": float(np.median(times_s)),
            "p95": float(np.percentile(times_s, 95)),
        }
        if times_s
        else None,
    }


STAY = "stay"
FIRST_SEED = 1
"""The layout where nobody asks for another."""


@dataclass(frozen=True, slots=True)
class PromptedTask(TaskRequest):
    """An episode with a prompt that somebody thought of.

    Args:
        prompt: as put.
    """

    prompt: str = ""

    def draw(self, objects: ObjectPoses, *, held_out: bool) -> TaskEpisode:
        """What the prompt asks for; the arm is to stay where it asks for nothing."""
        return TaskEpisode(self.seed, parse_prompt(self.prompt) or Order(STAY), self.prompt)


@dataclass(frozen=True, slots=True)
class DemoPlan(TaskPlan):
    """Some prompts, or one task of every family, each in the same layout.

    Args:
        prompts: to be put one after the other; empty: one of every family, drawn.
    """

    prompts: tuple[str, ...] = ()

    def requests(self) -> Iterator[TaskRequest]:
        """Every episode."""
        for prompt in self.prompts:
            yield PromptedTask(self.seed, STAY, None, prompt)
        if not self.prompts:
            for family in FAMILIES:
                yield TaskRequest(self.seed, family)


def is_judged(prompt: str) -> bool:
    """Whether it is known here what `prompt` asks for."""
    return parse_prompt(prompt) is not None or is_nonsense(prompt)
