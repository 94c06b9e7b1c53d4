"""OpenVLA's ``dataset_statistics.json`` of a LeRobot dataset."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from vla_zenoh.errors import RecordingError, in_words
from vla_zenoh_dataset.features import ACTION, STATE, of_numbers
from vla_zenoh_dataset.lerobot import INFO

FIGURES = ("mean", "std", "max", "min", "q01", "q99")


def openvla_statistics(folder: Path, name: str) -> dict[str, Any]:
    """Figures of actions and state under `name`, as OpenVLA's fine-tuning writes and reads them.

    The mask marks the numbers that are scaled from [q01, q99] to [-1, 1]: all but the gripper's.

    Raises:
        RecordingError: the folder holds no such dataset.
    """
    info, columns = read_numbers(folder)
    content: dict[str, Any] = {}
    for part, column in (("action", ACTION), ("proprio", STATE)):
        if column in columns:
            names = info["features"][column]["names"] or []
            found = of_numbers(columns[column])
            content[part] = {figure: found[figure] for figure in FIGURES} | {
                "mask": ["gripper" not in str(each) for each in names]
            }
    content["num_transitions"] = info["total_frames"]
    content["num_trajectories"] = info["total_episodes"]
    return {name: content}


def read_numbers(folder: Path) -> tuple[dict[str, Any], dict[str, NDArray[np.float32]]]:
    """``info.json``, and actions and state of all frames: name -> (n, D).

    Raises:
        RecordingError: the folder holds no LeRobot dataset.
    """
    try:
        info = json.loads((folder / INFO).read_text("utf-8"))
        names = [name for name in (ACTION, STATE) if name in info["features"]]
        files = sorted((folder / "data").glob("*/*.parquet"))
        tables = [pq.read_table(file, columns=names) for file in files]
        table = pa.concat_tables(tables)
        columns = {name: np.array(table[name].to_pylist(), np.float32) for name in names}
    except (OSError, ValueError, TypeError, KeyError, pa.ArrowException) as error:
        raise RecordingError(
            f"{folder} is no LeRobot dataset that can be read: {in_words(error)}"
        ) from error
    if ACTION not in columns or not len(columns[ACTION]):
        raise RecordingError(f"{folder} holds no actions")
    return info, columns
