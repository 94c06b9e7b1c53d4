"""What happened in the demonstration, and when: told as it happens, kept for its picture."""

from __future__ import annotations

import time
from dataclasses import asdict, dataclass, field
from typing import Any


@dataclass(frozen=True)
class Step:
    """One step.

    Args:
        t_s: since the story began.
        what: happened.
        mark: in a word, for the picture; empty: it is not marked there.
    """

    t_s: float
    what: str
    mark: str = ""


@dataclass
class Story:
    """The steps, and what was found by measuring.

    Args:
        began_s: wall clock.
    """

    began_s: float = 0.0
    steps: list[Step] = field(default_factory=list)
    found: dict[str, Any] = field(default_factory=dict)

    def begin(self) -> None:
        self.began_s = time.time()

    def tell(self, what: str, mark: str = "", at_s: float | None = None) -> float:
        """One step, now or at a wall-clock time; that time."""
        at_s = time.time() if at_s is None else at_s
        step = Step(round(at_s - self.began_s, 3), what, mark)
        self.steps.append(step)
        print(f"{step.t_s:8.3f} s  {what}", flush=True)
        return at_s

    def as_json(self) -> dict[str, Any]:
        self.steps.sort(key=lambda step: step.t_s)
        return {"steps": [asdict(step) for step in self.steps], **self.found}


def as_tables(story: dict[str, Any]) -> str:
    """The steps, and both sides beside each other, in Markdown."""
    lines = ["| s | |", "|---|---|"]
    lines += [f"| {step['t_s']:.3f} | {step['what']} |" for step in story["steps"]]
    without, bridged = story["without"], story["with"]
    lines += ["", "| | by the maker's library alone | with us |", "|---|---|---|"]
    lines += [f"| {what} | {without[what]} | {bridged[what]} |" for what in without]
    return "\n".join(lines) + "\n"
