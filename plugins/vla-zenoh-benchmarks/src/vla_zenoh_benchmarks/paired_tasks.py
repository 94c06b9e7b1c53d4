"""Paired comparison of two runs of `bench task` or `bench sim` over the same layouts.

Most of the noise in a success rate comes from the layouts. Pairing episodes with the same task in
the same layout cancels it, so that far fewer episodes tell two policies apart.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from pydantic import AliasChoices, BaseModel, ConfigDict, Field, ValidationError

from vla_zenoh.errors import RecordError, describe_fault
from vla_zenoh_benchmarks.statistics import ALPHA, Paired, paired

CONDITIONS = (
    *("mode", "replan", "profile", "vary", "held_out"),
    *("prompt", "delay_ms", "rate_hz", "limit_s"),
    *("benchmark", "benchmark_options", "composition", "takeover", "disagreement"),
)
"""What influences the success rate beside the model and its options."""

Task = tuple[int, str, str, str, str, int]
"""Seed, family, target, onto, direction, and number of earlier occurrences."""


class _Read(BaseModel):
    model_config = ConfigDict(frozen=True, strict=True, extra="ignore", allow_inf_nan=False)


class PairedOutcome(_Read):
    """Outcome of one episode in a result file."""

    seed: int = Field(validation_alias=AliasChoices("seed", "episode"))
    family: str = Field(validation_alias=AliasChoices("family", "task"))
    target: str = ""
    onto: str = ""
    direction: str = ""
    success: bool
    failure: str

    @property
    def task(self) -> str:
        onto = f"on {self.onto}" if self.onto else ""
        return " ".join(part for part in (self.family, self.target, onto, self.direction) if part)


class TaskResultFile(_Read):
    """Result file of `vla-zenoh bench task` or `bench sim`."""

    model: str
    options: dict[str, str]
    scene: str = Field(validation_alias=AliasChoices("scene", "suite"))
    mode: str
    replan: int = 0
    profile: str = ""
    vary: tuple[str, ...] = ()
    held_out: bool = False
    prompt: str | None = None
    delay_ms: float
    rate_hz: float | None = None
    limit_s: float = 0.0
    benchmark: str = ""
    benchmark_options: dict[str, str] = Field(default_factory=dict)
    composition: str = ""
    takeover: str = ""
    disagreement: float = 0.0
    all: tuple[PairedOutcome, ...]

    def by_task(self) -> dict[Task, PairedOutcome]:
        """Every episode by task and layout."""
        asked: Counter[Any] = Counter()
        out: dict[Task, PairedOutcome] = {}
        for each in self.all:
            what = (each.seed, each.family, each.target, each.onto, each.direction)
            out[*what, asked[what]] = each
            asked[what] += 1
        return out


def read_run(content: bytes, where: str) -> TaskResultFile:
    """Parse a result file of `bench task`. Raises RecordError: it is no such file."""
    try:
        return TaskResultFile.model_validate_json(content)
    except ValidationError as error:
        fault = error.errors(include_url=False)[0]
        place = ".".join(map(str, fault["loc"]))
        why = f"{place} {describe_fault(fault)}" if place else describe_fault(fault)
        raise RecordError(
            f"{where} is no result of `vla-zenoh bench task` or `bench sim`: {why}"
        ) from error


@dataclass(frozen=True, slots=True)
class Comparison:
    """Paired comparison of two runs.

    Args:
        b: the second run; differences are B minus A.
        pairs: episodes with the same task and layout, in A's order.
    """

    a: TaskResultFile
    b: TaskResultFile
    pairs: tuple[tuple[PairedOutcome, PairedOutcome], ...]

    @property
    def counts(self) -> Paired:
        """Counts over all pairs; B is first."""
        return _counts(self.pairs)

    @property
    def b_is_worse(self) -> bool:
        """B has significantly fewer successes in the same tasks."""
        return self.counts.difference < 0 and self.counts.p < ALPHA

    @property
    def unpaired(self) -> tuple[int, int]:
        """Episodes of A and of B without a partner."""
        return len(self.a.all) - len(self.pairs), len(self.b.all) - len(self.pairs)

    def by(self, of: Callable[[PairedOutcome], str]) -> dict[str, Paired]:
        """Counts by a property of the task."""
        return {
            name: _counts(pair for pair in self.pairs if of(pair[0]) == name)
            for name in sorted({of(one) for one, _ in self.pairs})
        }

    def disagreements(self) -> Iterator[dict[str, Any]]:
        """Pairs with one success: whose, and how the other failed."""
        for one, other in self.pairs:
            if one.success != other.success:
                failed = other if one.success else one
                yield {
                    "seed": one.seed,
                    "task": one.task,
                    "done_by": "a" if one.success else "b",
                    "failure_of_the_other": failed.failure,
                }

    def to_dict(self) -> dict[str, Any]:
        only_a, only_b = self.unpaired
        return {
            "a": _shown(self.a),
            "b": _shown(self.b),
            "differ": differing(self.a, self.b),
            "unpaired": {"a": only_a, "b": only_b},
            **figures(self.counts),
            "b_is_worse": self.b_is_worse,
            "by_family": {k: figures(v) for k, v in self.by(lambda one: one.family).items()},
            "by_task": {k: figures(v) for k, v in self.by(lambda one: one.task).items()},
            "disagreements": list(self.disagreements()),
        }


def compare(a: TaskResultFile, b: TaskResultFile, differ: Collection[str] = ()) -> Comparison:
    """Pair the episodes of two runs.

    Args:
        differ: those of `CONDITIONS` that may differ.

    Raises:
        RecordError: other conditions differ, or the runs share no task.
    """
    if a.scene != b.scene:
        raise RecordError(
            f"A was run in {a.scene}, B in {b.scene}: a seed lays them out differently, "
            "so no layout is in both"
        )
    others = {name: pair for name, pair in differing(a, b).items() if name not in differ}
    if others:
        listed = ", ".join(
            f"{name} is {_shown_value(one)} in A and {_shown_value(two)} in B"
            for name, (one, two) in others.items()
        )
        named = " ".join(f"--differ {name}" for name in others)
        raise RecordError(
            f"the runs were not made alike: {listed}. That would be attributed to the models; "
            f"repeat one of them, or, to compare just that: {named}"
        )
    first, second = a.by_task(), b.by_task()
    pairs = tuple((one, second[task]) for task, one in first.items() if task in second)
    if not pairs:
        raise RecordError(_nothing_in_common(a, b))
    return Comparison(a, b, pairs)


def differing(a: TaskResultFile, b: TaskResultFile) -> dict[str, tuple[Any, Any]]:
    """Those of `CONDITIONS` that differ -> their values in A and B."""
    values = {name: (getattr(a, name), getattr(b, name)) for name in CONDITIONS}
    return {name: pair for name, pair in values.items() if pair[0] != pair[1]}


def figures(counts: Paired) -> dict[str, Any]:
    """Plain types of paired counts; B is first."""
    n = counts.setups
    return {
        "pairs": n,
        "both": counts.both,
        "only_a": counts.second,
        "only_b": counts.first,
        "neither": counts.neither,
        "rate_a": (counts.both + counts.second) / n,
        "rate_b": (counts.both + counts.first) / n,
        "difference": counts.difference,
        "difference_95": counts.stated_95,
        "p": counts.p,
    }


def _counts(pairs: Iterable[tuple[PairedOutcome, PairedOutcome]]) -> Paired:
    return paired((other.success, one.success) for one, other in pairs)


def _shown(run: TaskResultFile) -> Mapping[str, Any]:
    conditions = run.model_dump(mode="json", include={"model", "options", "scene", *CONDITIONS})
    return {**conditions, "episodes": len(run.all)}


def _shown_value(value: Any) -> str:
    if value in (None, (), {}, ""):
        return "not set"
    if isinstance(value, dict):
        return ", ".join(f"{name}={given}" for name, given in value.items())
    if isinstance(value, tuple):
        return "+".join(value)
    return f"{value:g}" if isinstance(value, float) else str(value)


def _nothing_in_common(a: TaskResultFile, b: TaskResultFile) -> str:
    seeds = [{each.seed for each in run.all} for run in (a, b)]
    if not all(seeds):
        return f"{'A' if not seeds[0] else 'B'} has no episodes: it was ended before its first"
    if seeds[0] & seeds[1]:
        return (
            "the layouts are the same, and other tasks were asked in them: run both with the same "
            "--family"
        )
    spans = [f"{min(each)} to {max(each)}" for each in seeds]
    return (
        f"no layout is in both: A has seeds {spans[0]}, B {spans[1]}; run one of them again with "
        "the other's --seed"
    )
