"""Packages that a policy needs besides LeRobot itself, by the type in its config."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path

from vla_zenoh.errors import VlaZenohError, WorkerError
from vla_zenoh.policy.options import checkpoint_folder, refuse_dead_link

CONFIG, MODEL = "config.json", "pretrained_model"
"""Config of a policy, and its folder in a checkpoint of a training."""

LEROBOT = "0.6.1"
EXTRAS: Mapping[str, str] = {
    "act": "",
    "diffusion": "diffusion",
    "eo1": "eo1",
    "evo1": "evo1",
    "fastwam": "fastwam",
    "gaussian_actor": "hilserl",
    "groot": "groot",
    "lingbot_va": "lingbot-va",
    "molmoact2": "molmoact2",
    "multi_task_dit": "multi-task-dit",
    "pi0": "pi",
    "pi05": "pi",
    "pi0_fast": "pi",
    "smolvla": "smolvla",
    "tdmpc": "",
    "vla_jepa": "vla-jepa",
    "vqbet": "",
    "wall_x": "wallx",
    "xvla": "xvla",
}
"""Type of every policy of LeRobot 0.6.1 -> the extra of LeRobot that it needs, or none."""


def policy_folder(folder: Path) -> Path:
    """Folder of the policy: `folder`, or ``pretrained_model`` below a checkpoint, of the last one.

    Raises:
        WorkerError: there is no policy, or a link leads nowhere.
    """
    for below in ("", MODEL, f"last/{MODEL}", f"checkpoints/last/{MODEL}"):
        found = folder / below
        refuse_dead_link(found)
        if (found / CONFIG).is_file():
            return found
    raise WorkerError(
        f"{folder} has no {CONFIG}: it is no policy that LeRobot saved, and no output of a "
        f"training (checkpoints/NUMBER/{MODEL})"
    )


def requirement(kind: str) -> str:
    """What to install for a policy of this type; of a plug-in's type LeRobot alone."""
    extra = EXTRAS.get(kind, "")
    return f"lerobot[{extra}]=={LEROBOT}" if extra else f"lerobot=={LEROBOT}"


def dependencies(options: Mapping[str, str]) -> list[str]:
    """Requirements of the policy that the options name; `model.py` reports what is wrong there."""
    try:
        folder = policy_folder(checkpoint_folder(options["checkpoint"]))
        kind = json.loads((folder / CONFIG).read_bytes())["type"]
    except (VlaZenohError, OSError, ValueError, LookupError, TypeError):
        return []
    return [requirement(kind)] if isinstance(kind, str) else []
