"""Which files are evaluated, and by whom."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from vla_zenoh.errors import RecordingError
from vla_zenoh.lab.evaluation.csv_file import evaluate_csv, has_our_columns
from vla_zenoh.lab.evaluation.result import Evaluation

MCAP, CSV = ".mcap", ".csv"


def evaluate(
    paths: Sequence[Path], first: int | None = None, *, pictures: int = 0
) -> tuple[list[Evaluation], dict[str, str]]:
    """Every file, and of every folder the recordings in it, in the order of their names.

    Args:
        paths: files and folders.
        first: only so many requests of each.
        pictures: moments to show of each camera.

    Returns:
        Evaluations, and for each file that has none, why.
    """
    runs: list[Evaluation] = []
    faults: dict[str, str] = {}
    for path in paths:
        found = _inside(path) if path.is_dir() else [path]
        if not found:
            faults[str(path)] = f"{path} holds neither recordings (.mcap) nor the thesis's CSV"
        for file in found:
            try:
                runs.append(_evaluate(file, first, pictures))
            except RecordingError as error:
                faults[str(file)] = str(error)
    return runs, faults


def _inside(folder: Path) -> list[Path]:
    """Recordings below a folder. Tables of something else, which lie beside them, are left out."""
    files = sorted(path for path in folder.rglob("*") if path.suffix.lower() in (MCAP, CSV))
    return [path for path in files if path.suffix.lower() == MCAP or _is_table(path)]


def _is_table(path: Path) -> bool:
    return path.stat().st_size == 0 or has_our_columns(path)


def _evaluate(path: Path, first: int | None, pictures: int) -> Evaluation:
    if path.suffix.lower() == CSV:
        return evaluate_csv(path, first)
    # Whoever evaluates CSV alone needs no MCAP library.
    from vla_zenoh.lab.evaluation.mcap_file import evaluate_run

    return evaluate_run(path, first, pictures=pictures)
