"""What the end of a recording says of an episode: the verdict of a person."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal, get_args

Verdict = Literal["success", "failure", "void"]
"""A void episode does not count, and is repeated."""
FACT = "trial"
"""Name of the verdict in the metadata at the end of a recording."""
TRIALS = "trials.jsonl"
"""File of all verdicts of a trial, in the folder of its recordings."""


def verdict_in(metadata: Mapping[str, Any] | None, worker: str) -> Verdict | None:
    """The verdict on `worker` in the metadata at the end of a recording; None: there is none.

    Args:
        metadata: None: the recording was cut off.
    """
    fact = (metadata or {}).get(FACT)
    if not isinstance(fact, Mapping) or fact.get("worker") != worker:
        return None
    return next((each for each in get_args(Verdict) if each == fact.get("verdict")), None)
