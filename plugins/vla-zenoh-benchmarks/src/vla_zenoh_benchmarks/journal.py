"""The folder of a benchmark run: what was planned, and every episode that has ended.

A run that was killed goes on where it was: an episode counts once its line is on the disk.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from vla_zenoh.errors import OutputError, RecordError, in_words
from vla_zenoh.lab.durable import append_lines, whole_lines
from vla_zenoh_benchmarks.episode import EpisodeOutcome, EpisodeRequest

PLAN, EPISODES, ACTIONS = "run.json", "episodes.jsonl", "actions"


class RunJournal:
    """Outcomes of a run, in a folder or, without one, in memory.

    Args:
        folder: of a new run or of one to go on with; None: nothing is kept.
        plan: what is run, under which conditions, with which versions.

    Raises:
        OutputError: the folder has another run, or something else.
    """

    def __init__(self, folder: Path | None, plan: Mapping[str, Any]) -> None:
        self.folder, self.plan = folder, dict(plan)
        self.ended: dict[str, EpisodeOutcome] = {}
        if folder is None:
            return
        file = folder / PLAN
        if file.exists():
            _require_same(folder, read_json(file), json.loads(json.dumps(self.plan)))
            self.ended = read_episodes(folder)
            return
        if folder.exists() and any(folder.iterdir()):
            raise OutputError(f"{folder} is not empty and has no {PLAN}; name a new folder")
        (folder / ACTIONS).mkdir(parents=True, exist_ok=True)
        file.write_text(json.dumps(self.plan, indent=2) + "\n", "utf-8")

    def add(self, request: EpisodeRequest, outcome: EpisodeOutcome) -> None:
        """Keep an outcome; the second one of an episode is dropped."""
        if request.key in self.ended:
            return
        self.ended[request.key] = outcome
        if self.folder is None:
            return
        with actions_file(self.folder, request).open("wb") as file:
            np.save(file, np.asarray(outcome.actions, np.float64))
        append_lines(self.folder / EPISODES, [json.dumps(outcome.to_dict())])


def actions_file(folder: Path, request: EpisodeRequest) -> Path:
    """Where the steps of an episode are kept, (n, D)."""
    return folder / ACTIONS / f"{request.key.replace('/', '.')}.npy"


def read_episodes(folder: Path) -> dict[str, EpisodeOutcome]:
    """Episodes of a run that have ended; a last line that was cut off is not one."""
    ended: dict[str, EpisodeOutcome] = {}
    for line in whole_lines(folder / EPISODES)[0]:
        with suppress(ValueError, TypeError):
            found = EpisodeOutcome(**json.loads(line))
            found.ask_ms = (found.ask_ms[0], found.ask_ms[1])
            ended.setdefault(f"{found.suite}/{found.task}/{found.episode}", found)
    return ended


def read_json(file: Path) -> Any:
    """The content of a JSON file. Raises RecordError: it is none."""
    try:
        return json.loads(file.read_bytes())
    except (OSError, ValueError) as error:
        raise RecordError(f"{file} cannot be read: {in_words(error)}") from error


def _require_same(folder: Path, old: Mapping[str, Any], new: Mapping[str, Any]) -> None:
    """More or fewer tasks and episodes may be asked for; all else has to be the same."""
    free = ("tasks", "episodes", "first")
    differing = [
        f"{name} was {old.get(name)!r} and is {new.get(name)!r}"
        for name in {**old, **new}
        if name not in free and old.get(name) != new.get(name)
    ]
    if differing:
        raise OutputError(
            f"{folder} has another run: {'; '.join(differing)}. Name a new folder, or repeat the "
            "command as it was"
        )
