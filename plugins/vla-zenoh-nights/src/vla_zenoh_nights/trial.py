"""The folder of an unattended trial: its plan, one `TrialFolder` for each task, and a journal."""

from __future__ import annotations

import json
import time
from contextlib import suppress
from datetime import datetime
from pathlib import Path
from typing import Any

from vla_zenoh_trial.folder import TrialFolder
from vla_zenoh_trial.plan import TrialPlan
from vla_zenoh_trial.score import TrialScore, score
from vla_zenoh_trial.verdict import END_WORDS, EpisodeVerdict

from vla_zenoh.errors import OutputError
from vla_zenoh.lab.durable import append_lines, page_template, whole_lines, write_whole, writing
from vla_zenoh_nights.operator import strip_path
from vla_zenoh_nights.plan import UnattendedPlan, UnattendedTask, checked_plan

TEMPLATE, PAGE = "page.html.j2", "index.html"


def write_page(trial: UnattendedTrial) -> None:
    """Write the page of a trial; a reader sees the old one or the new one, never half of one.

    Raises:
        OutputError: the page cannot be written.
    """
    tasks = [
        {
            "task": task,
            "score": score,
            "episodes": [_row(trial.trial(task)[0], each) for each in found],
        }
        for task, score, found in trial.scores()
    ]
    done, of = (sum(getattr(each["score"], name) for each in tasks) for name in ("done", "of"))
    journal = [{**line, "at": f"{_at(line['time_s']):%F %T}"} for line in trial.journal()]
    page = page_template("vla_zenoh_nights", TEMPLATE).render(
        title=trial.path.name,
        robot=trial.robot,
        plan=trial.plan,
        tasks=tasks,
        done=done,
        of=of,
        journal=journal,
    )
    file = trial.path / PAGE
    with writing(file, OutputError):
        write_whole(file, page)


def _row(folder: TrialFolder, each: EpisodeVerdict) -> dict[str, Any]:
    strip = strip_path(folder, each.setup, each.worker)
    has_strip = each.verdict != "void" and strip.exists()
    recorded = bool(each.recording) and (folder.path / each.recording).exists()
    return {
        "of": each,
        "end": END_WORDS[each.end],
        "at": f"{_at(each.began_ns / 1e9):%F %T}" if each.began_ns else "",
        "strip": f"{folder.path.name}/{strip.name}" if has_strip else "",
        "recording": f"{folder.path.name}/{each.recording}" if recorded else "",
    }


def _at(time_s: float) -> datetime:
    return datetime.fromtimestamp(time_s)


PLAN, JOURNAL = "unattended.json", "unattended.jsonl"


class UnattendedTrial:
    """An unattended trial and its folder.

    Args:
        plan: of a new trial or of the one in the folder; None: the one in the folder.

    Raises:
        OutputError: the folder has another plan, or none was given.
        RecordError: the folder's plan is not one.
    """

    def __init__(self, path: Path, plan: UnattendedPlan | None, robot: str) -> None:
        self.path, self.robot = path, robot
        file = path / PLAN
        known = checked_plan(json.loads(file.read_bytes()), str(file)) if file.exists() else None
        if known is not None and plan is not None and known != plan:
            names = [
                each
                for each in type(plan).model_fields
                if getattr(known, each) != getattr(plan, each)
            ]
            raise OutputError(
                f"{path} has another plan ({', '.join(names)} differ): name another --output, or "
                "give the plan it was begun with"
            )
        found = known or plan
        if found is None:
            raise OutputError(f"{path} holds no unattended trial yet")
        self.plan = found

    def begin(self) -> None:
        """Write the plan, and the start into the journal.

        Raises:
            OutputError: that cannot be written.
        """
        file = self.path / PLAN
        if not file.exists():
            with writing(file, OutputError):
                write_whole(file, self.plan.model_dump_json(indent=2) + "\n")
        self.note("begun")

    def trial(self, task: UnattendedTask) -> tuple[TrialFolder, TrialPlan]:
        """Folder and plan of a task."""
        return TrialFolder(self.path / task.name), self.plan.trial(task, self.robot)

    def episodes(self) -> list[EpisodeVerdict]:
        """Verdicts of all tasks, in the order in which they were given.

        Raises:
            RecordingError: a line cannot be read.
        """
        # Tasks are done one after the other.
        return [each for task in self.plan.tasks for each in self.trial(task)[0].episodes()]

    def scores(self) -> list[tuple[UnattendedTask, TrialScore, list[EpisodeVerdict]]]:
        """Score and verdicts of each task."""
        out = []
        for task in self.plan.tasks:
            folder, trial = self.trial(task)
            found = folder.episodes()
            out.append((task, score(trial, found), found))
        return out

    # -- journal ------------------------------------------------------------------------------
    def note(self, what: str, why: str = "") -> None:
        """Append to the journal of starts, stops and trouble, and sync it.

        Raises:
            OutputError: it cannot be written.
        """
        line = {"what": what, "why": why, "time_s": time.time(), "episodes": len(self.episodes())}
        file = self.path / JOURNAL
        with writing(file, OutputError):
            append_lines(file, [json.dumps(line)])

    def journal(self) -> list[dict[str, Any]]:
        """Lines of the journal; one that was cut off is none."""
        out: list[dict[str, Any]] = []
        for line in whole_lines(self.path / JOURNAL)[0]:
            with suppress(ValueError):
                out.append(json.loads(line))
        return out

    def since(self) -> tuple[float, int]:
        """When it was first started after the last stop by a rule or person, and with how many
        episodes; a crash in between is no start.
        """
        began: tuple[float, int] | None = None
        for line in self.journal():
            if line["what"] == "stopped":
                began = None
            elif line["what"] == "begun" and began is None:
                began = line["time_s"], line["episodes"]
        return began or (time.time(), len(self.episodes()))

    def due_to_stop(self) -> str:
        """Why it has to stop by its rules; empty: go on."""
        began_s, episodes = self.since()
        deadline_s = self.plan.stop.deadline(began_s)
        if deadline_s is not None and time.time() >= deadline_s:
            return f"at: {datetime.fromtimestamp(deadline_s):%H:%M}"
        return self.plan.stop.reason(self.episodes()[episodes:])
