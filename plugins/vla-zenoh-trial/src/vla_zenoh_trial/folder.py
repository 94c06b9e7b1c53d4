"""Folder of a trial: ``plan.json``, ``trials.jsonl`` with a line per episode, and recordings.

A line is on the disk when `TrialFolder.append` returns. The episode of a line that a crash
truncated is repeated.
"""

from __future__ import annotations

import json
import os
import re
import secrets
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict
from functools import cache
from pathlib import Path
from typing import Any

from pydantic import TypeAdapter, ValidationError

from vla_zenoh.errors import RecordingError, describe_faults
from vla_zenoh.lab.durable import append_lines, lock_folder, whole_lines, write_whole, writing
from vla_zenoh.lab.recording.verdict import TRIALS
from vla_zenoh_trial.plan import TrialPlan
from vla_zenoh_trial.verdict import EpisodeVerdict

EPISODES, SECONDS = 20, 60.0
"""Of a plan that does not say them."""
PLAN = "plan.json"
_RECORDING = re.compile(r"episode-(\d+)\.mcap")


@cache
def _adapter(kind: type) -> TypeAdapter[Any]:
    return TypeAdapter(kind)


class TrialFolder:
    """Folder of a trial."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.truncated = False
        """The last line that `episodes` read was truncated."""

    # -- reading ------------------------------------------------------------------------------
    def begun(self) -> bool:
        """The folder has files of a trial."""
        return any((self.path / name).exists() for name in (PLAN, TRIALS))

    def plan(self) -> TrialPlan | None:
        """The plan of the trial; None: the folder has no trial.

        Raises:
            RecordingError: it cannot be read.
        """
        try:
            return self._parse(TrialPlan, (self.path / PLAN).read_bytes(), PLAN)
        except FileNotFoundError:
            if (self.path / TRIALS).exists():
                raise RecordingError(
                    f"{self.path / TRIALS} exists without its {PLAN}; restore that file, or give "
                    "another --output"
                ) from None
            return None
        except OSError as error:
            raise RecordingError(f"{self.path / PLAN} cannot be read: {error.strerror}") from error

    def agreed(self, asked: Mapping[str, Any]) -> TrialPlan:
        """The plan of the trial; where the folder has none, a new one is written.

        Args:
            asked: fields of a plan; those that are None are as the folder has them, or usual ones.

        Raises:
            RecordingError: the folder has another plan, or cannot be read or written.
            RecordError: a value is not allowed.
        """
        plan = self.plan()
        if plan is not None:
            if others := plan.differences(asked):
                raise RecordingError(
                    f"{self.path} has another plan: {'; '.join(others)}. Leave that out to "
                    "continue it, or give another --output"
                )
            return plan
        usual = {
            "setups": ("",) * EPISODES,
            "seconds": SECONDS,
            "seed": secrets.randbelow(2**32),
            "blind": True,
        }
        given = {name: value for name, value in asked.items() if value is not None}
        plan = TrialPlan(**{**usual, **given})
        self.begin(plan)
        return plan

    def episodes(self) -> list[EpisodeVerdict]:
        """Verdicts in the order of the episodes. Raises RecordingError: a line cannot be read."""
        path = self.path / TRIALS
        try:
            lines, self.truncated = whole_lines(path)
        except OSError as error:
            raise RecordingError(f"{path} cannot be read: {error.strerror}") from error
        return [
            self._parse(EpisodeVerdict, line, f"{TRIALS}, line {number}")
            for number, line in enumerate(lines, 1)
        ]

    def next_number(self, episodes: Sequence[EpisodeVerdict]) -> int:
        """Number of the next attempt; recordings without a verdict keep theirs."""
        found = [_RECORDING.fullmatch(path.name) for path in self.path.glob("episode-*.mcap")]
        numbers = [int(match[1]) for match in found if match]
        return max([*numbers, *(each.number for each in episodes)], default=0) + 1

    def recording(self, number: int) -> Path:
        """Path of the recording of an attempt; the name does not reveal the worker."""
        return self.path / f"episode-{number:04d}.mcap"

    def _parse(self, kind: type, data: bytes, where: str) -> Any:
        try:
            return _adapter(kind).validate_json(data, strict=True)
        except ValidationError as error:
            why = describe_faults(error, "", most=1)
            raise RecordingError(
                f"{self.path / where}: {why}; restore it as `vla-zenoh trial` wrote it, or give "
                "another --output"
            ) from error

    # -- writing ------------------------------------------------------------------------------
    @contextmanager
    def lock(self) -> Iterator[None]:
        """Keep other processes from this trial inside the block.

        Raises:
            RecordingError: another process holds it, or the folder cannot be created.
        """
        with writing(self.path, RecordingError):
            self.path.mkdir(exist_ok=True)
            folder = lock_folder(self.path)
        if folder is None:
            raise RecordingError(f"another `vla-zenoh trial` is at work in {self.path}")
        try:
            yield
        finally:
            os.close(folder)

    def begin(self, plan: TrialPlan) -> None:
        """Write the plan. Raises RecordingError: it cannot be written."""
        path = self.path / PLAN
        with writing(path, RecordingError):
            write_whole(path, json.dumps(asdict(plan), indent=2) + "\n")

    def append(self, verdict: EpisodeVerdict) -> None:
        """Append a verdict and sync it to the disk. Raises RecordingError: it cannot be written."""
        path = self.path / TRIALS
        with writing(path, RecordingError):
            append_lines(path, [json.dumps(asdict(verdict))])
