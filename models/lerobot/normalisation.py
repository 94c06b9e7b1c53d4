"""Whether a LeRobot directory has the statistics that its numbers are scaled with.

LeRobot passes a feature through as it is where it finds no statistics under its name: a policy then
reads the robot's own numbers as if they were scaled, and its raw output moves the arm.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vla_zenoh.errors import WorkerError
from vla_zenoh.policy.options import read_json

IDENTITY = "IDENTITY"
FIGURES: Mapping[str, tuple[str, str]] = {
    "MEAN_STD": ("mean", "std"),
    "MIN_MAX": ("min", "max"),
    "QUANTILES": ("q01", "q99"),
    "QUANTILE10": ("q10", "q90"),
}
"""Mode of scaling -> the statistics that it needs."""

LEAST_SPREAD = 1e-6
"""Of a number that changed in the data; of one over 1 a share of its size. What is less is
rounding: scaled with it, a sensor's noise is a thousand times what the policy was trained on."""

Statistics = Mapping[str, Mapping[str, NDArray[Any]]]


@dataclass(frozen=True, slots=True)
class Scaled:
    """A feature that a pipeline scales.

    Args:
        name: of the feature.
        kind: LeRobot's type of it: STATE, ACTION or VISUAL.
        shape: that the statistics must have; of images the number of channels comes first.
        mode: of the scaling, as the policy's config says.
    """

    name: str
    kind: str
    shape: tuple[int, ...]
    mode: str


def check_statistics(pipeline: Path, wanted: list[Scaled]) -> None:
    """Check that a pipeline scales what the policy's config says, with statistics that can do it.

    Raises:
        WorkerError: names the feature, what it needs, and what there is.
    """
    wanted = [each for each in wanted if each.mode != IDENTITY]
    steps = [step for step in _steps(pipeline) if "normaliz" in step.get("registry_name", "")]
    if wanted and not steps:
        names = ", ".join(each.name for each in wanted)
        raise WorkerError(
            f"{pipeline} has no step that scales, and the policy's config says that {names} are "
            f"scaled by {wanted[0].mode}: save the policy with its statistics"
        )
    for step in steps:
        config = step.get("config") or {}
        modes, only = config.get("norm_map") or {}, config.get("normalize_observation_keys")
        found = _statistics(pipeline, step)
        for each in wanted:
            if only is not None and each.kind != "ACTION" and each.name not in only:
                continue  # told so by the pipeline itself
            mode = modes.get(each.kind)
            if mode != each.mode:
                raise WorkerError(
                    f"{pipeline}: {each.kind} is scaled by {mode or 'nothing'}, the policy's "
                    f"config says {each.mode}"
                )
            for why in faults(each, found):
                raise WorkerError(f"{pipeline}: {each.name} is scaled by {mode}, and {why}")


def _steps(pipeline: Path) -> list[dict[str, Any]]:
    return read_json(pipeline)["steps"]  # checked by `device_step`


def _statistics(pipeline: Path, step: Mapping[str, Any]) -> Statistics:
    """Feature -> its statistics; none without a file."""
    from safetensors import SafetensorError  # comes with LeRobot
    from safetensors.numpy import load_file

    name = step.get("state_file")
    if name is None:
        return {}
    out: dict[str, dict[str, NDArray[Any]]] = {}
    try:
        for key, values in load_file(str(pipeline.parent / str(name))).items():
            feature, _, figure = key.rpartition(".")
            out.setdefault(feature, {})[figure] = values
    except (SafetensorError, OSError) as error:
        raise WorkerError(f"{pipeline.parent / str(name)} cannot be read: {error}") from error
    return out


def faults(wanted: Scaled, found: Statistics) -> Iterator[str]:
    """Why statistics cannot scale a feature."""
    own = found.get(wanted.name)
    if own is None:
        there = ", ".join(sorted(found)) or "none"
        yield (
            f"there are no statistics of it; there are those of: {there}. Rename them, or save the "
            "policy with the statistics of its data set"
        )
        return
    if wanted.mode not in FIGURES:
        yield f"this way of scaling is not known here; known: {', '.join(FIGURES)}"
        return
    low_name, high_name = FIGURES[wanted.mode]
    missing = [name for name in (low_name, high_name) if name not in own]
    if missing:
        yield f"{' and '.join(missing)} of it are missing; there are: {', '.join(sorted(own))}"
        return
    for name in (low_name, high_name):
        if not _fits(own[name].shape, wanted):
            yield f"its {name} has the shape {own[name].shape}, wanted {wanted.shape}"
            return
        if not np.isfinite(own[name]).all():
            yield f"its {name} holds NaN or infinity"
            return
    low, high = (own[name].astype(np.float64).reshape(-1) for name in (low_name, high_name))
    spread = high if wanted.mode == "MEAN_STD" else high - low
    still = spread <= LEAST_SPREAD * np.maximum(np.abs(low), 1.0)
    if still.any():
        at = int(np.argmax(still))
        what = high_name if wanted.mode == "MEAN_STD" else f"{high_name} - {low_name}"
        yield (
            f"{what} of its number {at} is {spread[at]:g}: the number never changed in the data, "
            "so it cannot be scaled. Leave it out of the data, or give it a spread"
        )


def _fits(shape: tuple[int, ...], wanted: Scaled) -> bool:
    if wanted.kind != "VISUAL":
        return shape == wanted.shape
    channels = wanted.shape[0]
    return shape in ((channels,), (channels, 1, 1), wanted.shape)
