"""What the data set of a training says about its numbers, as options of the worker."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from vla_zenoh_policy_servers.presets import LEROBOT, LEROBOT_STATE

from vla_zenoh.errors import WorkerError
from vla_zenoh.policy.options import read_json

TRAINING, INFO, OURS = "train_config.json", "meta/info.json", "meta/vla_zenoh.json"
PLUGIN = "vla_zenoh"
"""Robot type of data sets that LeRobot recorded through `lerobot_robot_vla_zenoh`."""


def dataset_options(policy: Path, told: str) -> dict[str, str]:
    """Options that the data set of a policy sets: meaning of the actions, ``state`` and ``parts``.

    It is a data set of ``vla-zenoh dataset export``, which says them itself, or one that LeRobot
    recorded through our plug-in. Of any other nothing is known.

    Args:
        policy: its folder.
        told: folder of the data set; empty: the one that the training names, if it is there.

    Raises:
        WorkerError: `told` is none of these.
    """
    folder = Path(told).expanduser() if told else _of_training(policy)
    if folder is None:
        return {}
    options = _options(folder)
    if told and not options:
        raise WorkerError(
            f"{folder} is no data set of `vla-zenoh dataset export` or of the plug-in "
            "lerobot_robot_vla_zenoh with one meaning of its numbers: leave dataset out and say "
            "what they mean with the other options"
        )
    return options


def _of_training(policy: Path) -> Path | None:
    try:
        root = json.loads((policy / TRAINING).read_bytes())["dataset"]["root"]
    except (OSError, ValueError, LookupError, TypeError):
        return None
    return Path(root) if isinstance(root, str) else None


def _options(folder: Path) -> Mapping[str, str]:
    if (folder / OURS).is_file():
        content = read_json(folder / OURS)
        options = dict(content.get("options") or {})
        references = content.get("rotation_reference") or {}
        if options and len(set(map(tuple, references.values()))) == 1:
            reference = next(iter(references.values()))
            options["rotation_reference"] = ",".join(map(repr, reference))
        return options
    if not (folder / INFO).is_file():
        return {}
    info: dict[str, Any] = read_json(folder / INFO)
    if info.get("robot_type") != PLUGIN:
        return {}
    return {**LEROBOT, "dt_s": repr(1 / info["fps"]), "state": LEROBOT_STATE}
