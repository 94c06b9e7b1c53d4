"""What came of an episode; needs no library, unlike reading one."""

from __future__ import annotations

from enum import StrEnum


class EpisodeLabel(StrEnum):
    """The word in a dataset for what came of an episode; a person called a discarded one void."""

    SUCCESS = "success"
    FAILURE = "failure"
    UNKNOWN = "unknown"
    DISCARDED = "discarded"
