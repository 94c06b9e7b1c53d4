"""What the flywheel compares: episodes seed by seed, and a data set with its recordings."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq

from vla_zenoh.lab.recording.run import load_run
from vla_zenoh.lab.recording.verdict import FACT

ARM_AND_GRIPPER = [0, 1, 2, 6]
"""Columns of an expert's step without its rotation."""
_TOLD = re.compile(r"epch:(\S+) .*?l1_loss:(\S+)")
FIGURES = ("min", "max", "mean", "std")


def compare_cells(
    ours: Sequence[Mapping[str, Any]], theirs: Sequence[Mapping[str, Any]]
) -> dict[str, Any]:
    """How many episodes are alike in success and steps, and end in the same state bit by bit."""
    other = {each["seed"]: each for each in theirs}
    pairs = [(each, other[each["seed"]]) for each in ours]
    differing = [
        a["seed"] for a, b in pairs if (a["success"], a["steps"]) != (b["success"], b["steps"])
    ]
    return {
        "of": len(pairs),
        "same": len(pairs) - len(differing),
        "same_end": sum(a["end"] == b["end"] for a, b in pairs),
        "differing_seeds": differing,
    }


def statistics_differ(recordings: Path, dataset: Path) -> float:
    """The largest difference between a data set's statistics and those of its recordings.

    They are computed from the recorded messages of successful episodes, and not as the export does.
    """
    states, actions = list[Any](), list[Any]()
    for path in sorted(recordings.glob("*.mcap")):
        run = load_run(path)
        if (run.file.ended or {})[FACT]["verdict"] != "success":
            continue
        width_m = run.profile.robot.gripper.max_width_m
        for pose, gripper in zip(run.poses, run.grippers, strict=True):
            share = min(max(gripper.record.width_m / width_m, 0.0), 1.0)
            states.append([*pose.record.position_m, share])
        actions += [chunk.record.steps[0][ARM_AND_GRIPPER] for chunk in run.chunks]
    told = json.loads((dataset / "meta" / "stats.json").read_text("utf-8"))
    worst = 0.0
    for name, rows in (("observation.state", states), ("action", actions)):
        table = np.array(rows, np.float32).astype(np.float64)
        for figure in FIGURES:
            found = getattr(table, figure)(axis=0)
            if figure == "std":  # the export's rule for a number that never changed
                found = np.where(found == 0.0, 1.0, found)
            worst = max(worst, float(np.abs(found - told[name][figure]).max()))
    return worst


def mean_action(dataset: Path) -> list[float]:
    """The mean of a data set's actions."""
    told = json.loads((dataset / "meta" / "stats.json").read_text("utf-8"))
    return told["action"]["mean"]


def led_frames(dataset: Path) -> int:
    """Frames of a data set in which the policy had been taken over."""
    files = sorted((dataset / "data").rglob("*.parquet"))
    return sum(sum(pq.read_table(file)["intervention"].to_pylist()) for file in files)


def losses(log: Path) -> list[tuple[float, float]]:
    """Epoch and mean L1 of normalized actions, as ``lerobot-train`` tells them."""
    found = _TOLD.findall(log.read_text("utf-8", "replace"))
    return [(float(epoch), float(loss)) for epoch, loss in found]
