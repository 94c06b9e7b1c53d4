"""Runs an unattended trial: one `TrialFolder` for each task, until all is judged or a rule stops.

Whatever ends the process, the same command goes on: an episode counts once its verdict is on the
disk, and one without a verdict is repeated.
"""

from __future__ import annotations

import json
import os
import threading
import time
from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import asdict
from datetime import datetime
from pathlib import Path
from typing import Any

from vla_zenoh.bus.client import Client
from vla_zenoh.errors import NodeError, OutputError, RecordingError, SessionError
from vla_zenoh.lab.episode import Interrupted
from vla_zenoh.lab.trial.automatic_judge import make_judge
from vla_zenoh.lab.trial.folder import TrialFolder
from vla_zenoh.lab.trial.plan import TrialPlan
from vla_zenoh.lab.trial.runner import TrialRunner
from vla_zenoh.lab.trial.score import TrialScore, score
from vla_zenoh.lab.trial.unattended_operator import TrialStopped, UnattendedOperator
from vla_zenoh.lab.trial.unattended_page import write_page
from vla_zenoh.lab.trial.unattended_plan import UnattendedPlan, UnattendedTask, checked_plan
from vla_zenoh.lab.trial.verdict import EpisodeVerdict
from vla_zenoh.lab.trial.webhook import Webhook

PLAN, JOURNAL = "unattended.json", "unattended.jsonl"
RETRY_S, MAX_TROUBLE = 5.0, 20
"""Between two attempts after trouble, and how many without an episode in between."""


class UnattendedTrial:
    """An unattended trial and its folder.

    Args:
        path: of the folder.
        plan: of a new trial or of the one in the folder; None: the one in the folder.
        robot: its name.

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
            raise OutputError(f"{path} holds no unattended trial: give --unattended PLAN")
        self.plan = found

    def begin(self) -> None:
        """Write the plan, and the start into the journal.

        Raises:
            OutputError: that cannot be written.
        """
        file = self.path / PLAN
        try:
            if not file.exists():
                part = file.with_suffix(".part")
                with part.open("w", encoding="utf-8") as out:
                    out.write(self.plan.model_dump_json(indent=2) + "\n")
                    out.flush()
                    os.fsync(out.fileno())
                part.replace(file)
        except OSError as error:
            raise OutputError(f"{file} cannot be written: {error.strerror}") from error
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
        try:
            with file.open("ab") as out:
                # The line feed at the start ends a line that a power cut truncated.
                out.write(b"\n" + json.dumps(line).encode() + b"\n")
                out.flush()
                os.fsync(out.fileno())
        except OSError as error:
            raise OutputError(f"{file} cannot be written: {error.strerror}") from error

    def journal(self) -> list[dict[str, Any]]:
        """Lines of the journal; one that was cut off is none."""
        file, out = self.path / JOURNAL, []
        for line in file.read_bytes().splitlines() if file.exists() else []:
            try:
                out.append(json.loads(line))
            except ValueError:
                continue
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


def run_unattended(
    trial: UnattendedTrial,
    open_client: Callable[[], AbstractContextManager[Client]],
    plan_folder: Path,
    stop: threading.Event,
    warn: Callable[[str], None],
) -> str:
    """Run what is due; why it stopped, empty: every episode is judged.

    Args:
        trial: its folder is locked by this process.
        open_client: a client of the running robot; opened again after trouble.
        plan_folder: where a Python judge is looked for.
        stop: set by Ctrl-C.
        warn: called with warnings.

    Raises:
        NodeError, SessionError: trouble that does not end.
        Interrupted: Ctrl-C; the arm is at rest.
        RecordingError, OutputError: the disk is full or broken.
    """
    judge = make_judge(trial.plan.judge, plan_folder)
    hook = Webhook(trial.plan.webhook, warn)
    trial.begin()
    hook.tell("begun", _summary(trial))
    try:
        why = _run(trial, open_client, judge, stop, warn, hook)
        trial.note("stopped" if why else "finished", why)
        hook.tell("stopped" if why else "finished", {"why": why, **_summary(trial)})
        return why
    except (NodeError, SessionError, RecordingError, OutputError) as error:
        hook.tell("failed", {"why": str(error), **_summary(trial)})
        raise
    finally:
        write_page(trial)
        hook.close()


def _run(
    trial: UnattendedTrial,
    open_client: Callable[[], AbstractContextManager[Client]],
    judge: Any,
    stop: threading.Event,
    warn: Callable[[str], None],
    hook: Webhook,
) -> str:
    def due_to_stop() -> str:
        write_page(trial)
        return trial.due_to_stop()

    for task in trial.plan.tasks:
        folder, plan = trial.trial(task)
        folder.path.mkdir(exist_ok=True)
        if folder.plan() is None:
            folder.begin(plan)
        trouble, before = 0, -1
        while plan.next_due(folder.episodes()) is not None:
            if stop.is_set():
                raise Interrupted
            if why := trial.due_to_stop():
                return why
            try:
                with open_client() as client:
                    operator = UnattendedOperator(
                        client, trial.plan, task, plan, folder, judge, stop, due_to_stop, warn
                    )
                    try:
                        TrialRunner(client, plan, folder, operator, stop).run()
                    finally:
                        operator.close()
            except TrialStopped as stopped:
                return str(stopped)
            except (NodeError, SessionError) as error:
                judged = sum(each.verdict != "void" for each in folder.episodes())
                trouble, before = (1 if judged > before else trouble + 1), judged
                warn(f"trouble {trouble} of {MAX_TROUBLE}: {error}")
                trial.note("trouble", str(error)[:500])
                hook.tell("trouble", {"why": str(error)[:500], **_summary(trial)})
                if trouble >= MAX_TROUBLE:
                    raise
                if stop.wait(RETRY_S):
                    raise Interrupted from error
    return ""


def _summary(trial: UnattendedTrial) -> dict[str, Any]:
    return {
        "robot": trial.robot,
        "folder": str(trial.path),
        "tasks": {
            task.name: {
                "done": found.done,
                "of": found.of,
                "workers": {each.worker: asdict(each) for each in found.workers},
            }
            for task, found, _ in trial.scores()
        },
    }
