"""A trial on the disk: ``plan.json``, ``trials.jsonl`` with a line an episode, and recordings.

A line is on the disk when `TrialFolder.append` returns. One that was cut off by a crash never was:
its episode is done again.
"""

from __future__ import annotations

import fcntl
import json
import os
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict
from functools import cache
from pathlib import Path
from typing import Any

from pydantic import TypeAdapter, ValidationError

from vla_zenoh.errors import RecordingError
from vla_zenoh.lab.trial.plan import TrialPlan
from vla_zenoh.lab.trial.verdict import EpisodeVerdict

PLAN, TRIALS = "plan.json", "trials.jsonl"
_RECORDING = re.compile(r"episode-(\d+)\.mcap")


@cache
def _adapter(kind: type) -> TypeAdapter[Any]:
    return TypeAdapter(kind)


class TrialFolder:
    """See the module.

    Args:
        path: of the folder; made by `begin`.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.torn = False
        """`episodes` found a last line that was cut off."""

    # -- reading ------------------------------------------------------------------------------
    def plan(self) -> TrialPlan | None:
        """What the trial was begun with; None: there is no trial here.

        Raises:
            RecordingError: it cannot be read.
        """
        try:
            return self._parse(TrialPlan, (self.path / PLAN).read_bytes(), PLAN)
        except FileNotFoundError:
            if (self.path / TRIALS).exists():
                raise RecordingError(
                    f"{self.path / TRIALS} is there, and {PLAN}, which says what it is about, is "
                    "not; put it back, or give another --out"
                ) from None
            return None
        except OSError as error:
            raise RecordingError(f"{self.path / PLAN} cannot be read: {error.strerror}") from error

    def episodes(self) -> list[EpisodeVerdict]:
        """Every episode that has a verdict, in the order in which they were done.

        Raises:
            RecordingError: a line cannot be read.
        """
        try:
            whole, _, torn = (self.path / TRIALS).read_bytes().rpartition(b"\n")
        except FileNotFoundError:
            return []
        except OSError as error:
            raise RecordingError(
                f"{self.path / TRIALS} cannot be read: {error.strerror}"
            ) from error
        self.torn = bool(torn)
        lines = whole.split(b"\n") if whole else []
        return [
            self._parse(EpisodeVerdict, line, f"{TRIALS}, line {number}")
            for number, line in enumerate(lines, 1)
        ]

    def next_number(self, episodes: Sequence[EpisodeVerdict]) -> int:
        """Of the next attempt: recordings without a verdict keep theirs."""
        found = [_RECORDING.fullmatch(path.name) for path in self.path.glob("episode-*.mcap")]
        numbers = [int(match[1]) for match in found if match]
        return max([*numbers, *(each.number for each in episodes)], default=0) + 1

    def recording(self, number: int) -> Path:
        """Where that of an attempt is; nothing in its name tells the worker."""
        return self.path / f"episode-{number:04d}.mcap"

    def _parse(self, kind: type, data: bytes, where: str) -> Any:
        try:
            return _adapter(kind).validate_json(data, strict=True)
        except ValidationError as error:
            fault = error.errors()[0]
            at = ".".join(map(str, fault["loc"]))
            raise RecordingError(
                f"{self.path / where}: {at}{': ' if at else ''}{fault['msg']}; it is as "
                "`vla-zenoh trial` writes it, or another --out is to be given"
            ) from error

    # -- writing ------------------------------------------------------------------------------
    @contextmanager
    def alone(self) -> Iterator[None]:
        """Nobody else goes on with this trial while the block lasts.

        Raises:
            RecordingError: somebody does already, or the folder cannot be made.
        """
        try:
            self.path.mkdir(parents=True, exist_ok=True)
            folder = os.open(self.path, os.O_RDONLY)
        except OSError as error:
            raise self._cannot(self.path, error) from error
        try:
            try:
                fcntl.flock(folder, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except OSError as error:
                raise RecordingError(
                    f"another `vla-zenoh trial` is at work in {self.path}"
                ) from error
            yield
        finally:
            os.close(folder)

    def begin(self, plan: TrialPlan) -> None:
        """Write what the trial is begun with.

        Raises:
            RecordingError: it cannot be written.
        """
        path, part = self.path / PLAN, self.path / f"{PLAN}.part"
        try:
            with part.open("wb") as file:
                file.write((json.dumps(asdict(plan), indent=2) + "\n").encode())
                file.flush()
                os.fsync(file.fileno())
            part.replace(path)
            self._sync_folder()
        except OSError as error:
            raise self._cannot(path, error) from error

    def append(self, judged: EpisodeVerdict) -> None:
        """Write an episode, onto the disk itself.

        Raises:
            RecordingError: it cannot be written.
        """
        path = self.path / TRIALS
        line = (json.dumps(asdict(judged)) + "\n").encode()
        try:
            with path.open("ab+") as file:
                file.seek(0)
                file.truncate(file.read().rfind(b"\n") + 1)  # a line that was cut off
                file.seek(0, os.SEEK_END)
                file.write(line)
                file.flush()
                os.fsync(file.fileno())
            self._sync_folder()
        except OSError as error:
            raise self._cannot(path, error) from error

    def _sync_folder(self) -> None:
        folder = os.open(self.path, os.O_RDONLY)
        try:
            os.fsync(folder)
        finally:
            os.close(folder)

    @staticmethod
    def _cannot(path: Path, error: OSError) -> RecordingError:
        return RecordingError(f"{path} cannot be written: {error.strerror}")
