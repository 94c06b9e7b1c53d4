"""Verdict on one trial episode: what the operator said of it, and how it ended."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from vla_zenoh.lab.recording.verdict import Verdict

End = Literal[
    "person", "policy", "time", "lost", "stopped", "taken", "recording", "refused", "broken_off"
]
END_WORDS: dict[End, str] = {
    "person": "ended by you",
    "policy": "the policy reported that it is done",
    "time": "the time limit was reached",
    "lost": "the command node braked and ended it",
    "stopped": "stopped by an emergency stop",
    "taken": "another client took the arm, or changed its task",
    "recording": "the recording failed",
    "refused": "activation was rejected",
    "broken_off": "aborted",
}
INTERVENTIONS: frozenset[End] = frozenset({"stopped", "taken"})
_VERDICTS: dict[str, Verdict] = {"y": "success", "n": "failure", "x": "void"}
_VERDICTS |= {"yes": "success", "no": "failure"}


@dataclass(frozen=True, slots=True)
class EpisodeVerdict:
    """Record of one attempt at an episode.

    Args:
        number: of the attempt, from 1; it names the recording.
        setup: number of its setup, from 1.
        turn: which of that setup's episodes, from 1.
        why: the reason, as a sentence.
        time_s: from activation to the end.
        brakes: times the command node braked: for want of a chunk, or to end it.
        began_ns: activation, wall clock of the operator's computer; 0: none.
        start_m: (3,) TCP at activation, base frame; None: no pose was received.
        recording: file name in the folder, empty: none.
        dropped: samples missing from it.
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
    """Parse ``y``, ``n`` or ``x`` with an optional note; None: neither of them."""
    word, _, note = line.strip().partition(" ")
    verdict = _VERDICTS.get(word.lower())
    return None if verdict is None else (verdict, note.strip())
