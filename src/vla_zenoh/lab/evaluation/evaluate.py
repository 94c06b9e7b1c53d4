"""Evaluates files and folders, and combines the runs into one."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import fields
from fnmatch import fnmatch
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from vla_zenoh.errors import RecordingError
from vla_zenoh.lab.evaluation.result import STAGES, Evaluation

MCAP, SEGMENTS = ".mcap", "segment-*.mcap"
EMPTY = "{} holds no recording (.mcap)"
COMBINED = "ALL"
"""``record_id`` of all runs together."""
_IDENTITY, _SERIES = {"name", "path"}, {"request_t_s", "width_m", "width_t_s"}
_OF_ONE_RUN = (
    _IDENTITY
    | _SERIES
    | {*("problems", "measured", "commanded", "marks", "views"), *("about", "film")}
)
_OF_A_ROBOT = {"requests", "executed", "seconds", "refusals", "skipped", "verdicts"}


def recordings(paths: Iterable[Path]) -> Iterator[Path]:
    """The given files, and the recordings below given folders in the order of their names.

    A folder with a saved rolling record is one recording. One that is given twice, by itself and by
    its folder or a link, counts once.
    """
    known = set[Path]()
    for path in paths:
        found = {path}
        if path.is_dir():
            files = path.rglob(f"*{MCAP}")
            found = {file.parent if fnmatch(file.name, SEGMENTS) else file for file in files}
        for each in sorted(found):
            if each.resolve() not in known:
                known.add(each.resolve())
                yield each


class _Held(NamedTuple):
    """What a recording holds: the processes that commanded the robot, and the time (ns)."""

    path: Path
    commanders: set[str]
    began_ns: int
    ended_ns: int

    def overlaps(self, other: _Held) -> bool:
        """Whether both are of one robot at one time: of two recorders, or two saves of one."""
        together = self.began_ns < other.ended_ns and other.began_ns < self.ended_ns
        return together and not self.commanders.isdisjoint(other.commanders)


def evaluate(
    paths: Sequence[Path],
    *,
    pictures: int = 0,
    evaluated: Callable[[Path], None] = lambda path: None,
) -> tuple[list[Evaluation], dict[str, str]]:
    """Evaluate every file, and in every folder the recordings, in the order of their names.

    A robot of parts has an evaluation for each part.

    Args:
        evaluated: called after each file.

    Returns:
        Evaluations, and the reason for each file that has none.
    """
    # They need the libraries of MCAP.
    from vla_zenoh.lab.evaluation.mcap_file import evaluate_parts
    from vla_zenoh.lab.recording.run import load_run

    runs: list[Evaluation] = []
    faults: dict[str, str] = {}
    held: list[_Held] = []
    for path in paths:
        found = list(recordings([path]))
        if not found:
            faults[str(path)] = EMPTY.format(path)
        for file in found:
            try:
                run = load_run(file)
                own = _Held(file, run.commanders, run.began_ns, run.ended_ns)
                run.problems += [
                    f"it overlaps with {other.path}: what both hold counts twice in {COMBINED}"
                    for other in held
                    if own.overlaps(other)
                ]
                held.append(own)
                runs += evaluate_parts(run, pictures=pictures)
            except RecordingError as error:
                faults[str(file)] = str(error)
            evaluated(file)
    return runs, faults


def combined(runs: Sequence[Evaluation]) -> Evaluation:
    """All runs as one: values of all requests together, lengths and counts added up.

    What the parts of a robot have in common counts once.
    """
    out = Evaluation(COMBINED)
    robots = list({run.path or id(run): run for run in reversed(runs)}.values())[::-1]
    for each in fields(Evaluation):
        if each.name not in _OF_ONE_RUN and each.name != "stages_ms":
            of = robots if each.name in _OF_A_ROBOT else runs
            setattr(out, each.name, _joined([getattr(run, each.name) for run in of]))
    if any(run.executed is None for run in runs):
        out.executed = None
    out.prompts = list(dict.fromkeys(out.prompts))
    out.stages_ms = {
        stage: _joined([run.stages_ms[stage] for run in robots if stage in run.stages_ms])
        for stage in STAGES
        if any(stage in run.stages_ms for run in runs)
    }
    units = {run.jerk_unit for run in runs if len(run.jerk)}
    out.jerk_unit = next(iter(units), "m_s3")
    if len(units) > 1:
        out.jerk = np.zeros(0)
    return out


def _joined(values: Sequence[Any]) -> Any:
    """Arrays and lists one after the other, counters and numbers added up without None."""
    known = [value for value in values if value is not None]
    if not known:
        return None
    if isinstance(known[0], np.ndarray):
        return np.concatenate(known)
    if isinstance(known[0], Counter):
        return sum(known, Counter())
    if isinstance(known[0], list):
        return [each for value in known for each in value]
    return sum(known) if isinstance(known[0], (int, float)) else None


def to_mapping(runs: Sequence[Evaluation], faults: Mapping[str, str]) -> dict[str, Any]:
    """All runs and faults, ready for JSON."""
    return {
        "runs": [run.to_dict() for run in runs],
        "overall": combined(runs).to_dict() if runs else None,
        "faults": dict(faults),
    }
