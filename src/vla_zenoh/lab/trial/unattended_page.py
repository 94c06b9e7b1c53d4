"""The page of an unattended trial: one HTML file beside film strips and recordings."""

from __future__ import annotations

import os
from datetime import datetime
from importlib.resources import files
from typing import TYPE_CHECKING, Any

from vla_zenoh.errors import MissingExtraError, OutputError
from vla_zenoh.lab.trial.unattended_operator import strip_path
from vla_zenoh.lab.trial.verdict import END_WORDS, EpisodeVerdict

if TYPE_CHECKING:
    from vla_zenoh.lab.trial.folder import TrialFolder
    from vla_zenoh.lab.trial.unattended import UnattendedTrial

TEMPLATE, PAGE = "unattended.html.j2", "index.html"


def write_page(trial: UnattendedTrial) -> None:
    """Write the page of a trial; a reader sees the old one or the new one, never half of one.

    Raises:
        MissingExtraError: jinja2 is not installed.
        OutputError: the page cannot be written.
    """
    try:
        from jinja2 import Environment
    except ImportError as error:
        raise MissingExtraError("jinja2", "record") from error
    text = files("vla_zenoh.lab.trial").joinpath(TEMPLATE).read_text("utf-8")
    language = Environment(autoescape=True, trim_blocks=True, lstrip_blocks=True)
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
    page = language.from_string(text).render(
        title=trial.path.name,
        robot=trial.robot,
        plan=trial.plan,
        tasks=tasks,
        done=done,
        of=of,
        journal=journal,
    )
    file = trial.path / PAGE
    part = file.with_suffix(".part")
    try:
        with part.open("w", encoding="utf-8") as out:
            out.write(page)
            out.flush()
            os.fsync(out.fileno())
        part.replace(file)
    except OSError as error:
        raise OutputError(f"{file} cannot be written: {error.strerror}") from error


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
