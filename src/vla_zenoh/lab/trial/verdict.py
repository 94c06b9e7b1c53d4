"""What became of an episode, and what a person says of it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal, get_args

Verdict = Literal["success", "failure", "void"]
"""A void episode tells nothing of its worker and is done again."""
End = Literal[
    "person", "policy", "time", "lost", "stopped", "taken", "recording", "refused", "broken_off"
]
FACT = "trial"
"""Name under which the record of an episode stands at the end of its recording."""
END_WORDS: dict[End, str] = {
    "person": "ended by you",
    "policy": "the policy says that it is done",
    "time": "the time is over",
    "lost": "the command node braked and ended it",
    "stopped": "stopped by an emergency stop",
    "taken": "somebody else took the arm, or changed what it is to do",
    "recording": "the recording failed",
    "refused": "the arm was not given",
    "broken_off": "broken off",
}
INTERVENTIONS: frozenset[End] = frozenset({"stopped", "taken"})
_VERDICTS: dict[str, Verdict] = {
    "y": "success",
    "yes": "success",
    "n": "failure",
    "no": "failure",
    "x": "void",
}


@dataclass(frozen=True, slots=True)
class EpisodeVerdict:
    """One episode that was done, well or not.

    Args:
        number: of the attempt, from 1; it names the recording.
        setup: number of its setup, from 1.
        turn: which of that setup's episodes, from 1.
        worker: that was obeyed.
        verdict: the person's.
        note: likewise.
        end: what ended it.
        why: in words.
        time_s: from activation to the end.
        chunks: carried out.
        brakes: times the command node braked by itself: for want of a chunk, or to end it.
        began_ns: when the arm was given, wall clock of the person's computer; 0: it was not.
        start_m: (3,) where the TCP stood then, base frame; None: it was not heard.
        recording: file name in the folder, empty: there is none.
        dropped: samples that are missing in it.
    """

    number: int
    setup: int
    turn: int
    worker: str
    verdict: Verdict
    note: str
    end: End
    why: str
    time_s: float
    chunks: int
    brakes: int
    began_ns: int
    start_m: tuple[float, float, float] | None
    recording: str
    dropped: int


def read_verdict(line: str) -> tuple[Verdict, str] | None:
    """``y``, ``n`` or ``x`` and a note, as a person types it; None: it is neither."""
    word, _, note = line.strip().partition(" ")
    verdict = _VERDICTS.get(word.lower())
    return None if verdict is None else (verdict, note.strip())


def verdict_in(ended: Mapping[str, Any] | None, worker: str) -> Verdict | None:
    """What a person said of `worker` at the end of a recording; None: nobody said anything.

    Args:
        ended: what stands at the end of the recording; None: it was cut off.
        worker: whose episode it is.
    """
    fact = (ended or {}).get(FACT)
    if not isinstance(fact, Mapping) or fact.get("worker") != worker:
        return None
    verdict = fact.get("verdict")
    return verdict if verdict in get_args(Verdict) else None
