"""What a model worker publishes: action chunks, and a record of each inference for debugging."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vla_zenoh.types.arrays import float32_table
from vla_zenoh.types.checks import (
    MAX_CHUNK_NUMBERS,
    MAX_ENTRIES,
    MAX_TEXT,
    boolean,
    details,
    entries,
    integer,
    number,
    set_field,
    shown,
    text,
)


@dataclass(frozen=True, slots=True, eq=False)
class ActionChunk:
    """What a model asks for: `H` steps of `D` numbers whose meaning its spec declares.

    Args:
        worker: name of the worker.
        spec_hash: hash of the spec its steps are to be read with.
        episode: the episode (see `Task`) the policy was reset for.
        observation_stamp_ns: capture time of the observation, wall clock.
        observation_seq: its sequence number.
        valid_until_ns: after this wall time the chunk must not be started.
        steps: (H, D) float32.
        observed_ns: wall time at which the worker took the observation.
        inference_start_ns: wall time.
        inference_end_ns: wall time.
        done: the policy reports that its task is finished when these steps are.
    """

    worker: str
    spec_hash: str
    episode: int
    observation_stamp_ns: int
    observation_seq: int
    valid_until_ns: int
    steps: NDArray[np.float32]
    observed_ns: int
    inference_start_ns: int
    inference_end_ns: int
    done: bool = False

    def __post_init__(self) -> None:
        text("worker", self.worker, 128)
        text("spec_hash", self.spec_hash, 128)
        for name in (
            "episode",
            "observation_stamp_ns",
            "observation_seq",
            "valid_until_ns",
            "observed_ns",
            "inference_start_ns",
            "inference_end_ns",
        ):
            set_field(self, name, integer(name, getattr(self, name)))
        set_field(self, "done", boolean("done", self.done))
        set_field(self, "steps", float32_table("steps", self.steps, MAX_CHUNK_NUMBERS))


MAX_RAW_NUMBERS = 4096


@dataclass(frozen=True, slots=True, eq=False)
class InferenceDebug:
    """One inference, for debugging. Its images travel beside it, one key per camera.

    Args:
        worker: name of the worker.
        chunk_seq: number of the resulting chunk; the images have the same.
        spec_hash: what the steps are to be read with.
        episode: as in the chunk.
        observation_stamp_ns: capture time, wall clock; the images have the same.
        prompt: input of the model.
        steps: (H, D) float32, the final action.
        inference_ms: time the model took.
        raw: output before the steps: tokens, normalised action, whatever the model reports.
        done: the policy reports that its task is finished with these steps.
    """

    worker: str
    chunk_seq: int
    spec_hash: str
    episode: int
    observation_stamp_ns: int
    prompt: str
    steps: NDArray[np.float32]
    inference_ms: float
    raw: Mapping[str, Any] = field(default_factory=dict)
    done: bool = False

    def __post_init__(self) -> None:
        for name, limit in (("worker", 128), ("spec_hash", 128), ("prompt", MAX_TEXT)):
            text(name, getattr(self, name), limit)
        for name in ("chunk_seq", "episode", "observation_stamp_ns"):
            set_field(self, name, integer(name, getattr(self, name)))
        set_field(self, "inference_ms", number("inference_ms", self.inference_ms, 0.0))
        set_field(self, "steps", float32_table("steps", self.steps, MAX_CHUNK_NUMBERS))
        set_field(self, "raw", details("raw", entries("raw", self.raw)))


def plain_values(raw: Mapping[str, Any] | None) -> dict[str, Any]:
    """Raw output of a model as plain text, numbers and lists.

    Arrays of any library become lists; what is too large or has no such form is described.
    """
    return {str(name)[:256]: _plain(value, 2) for name, value in list((raw or {}).items())[:64]}


def _plain(value: Any, depth: int) -> Any:
    if value is None or isinstance(value, (bool, np.bool_, int, np.integer)):
        return bool(value) if isinstance(value, np.bool_) else value
    if isinstance(value, (float, np.floating)):
        return float(value) if math.isfinite(value) else str(float(value))
    if isinstance(value, str):
        return value[:MAX_TEXT].encode("utf-8", "replace").decode()
    if isinstance(value, Mapping) and depth:
        return {str(key)[:256]: _plain(item, depth - 1) for key, item in list(value.items())[:64]}
    try:
        array = np.asarray(value)
    except Exception:  # tensors of other devices raise anything
        return shown(value)
    if array.dtype.kind not in "biuf" or array.ndim > 2:
        return shown(value)
    if array.size > MAX_RAW_NUMBERS or max(array.shape, default=0) > MAX_ENTRIES:
        return f"{array.dtype} of shape {array.shape}"
    if array.dtype.kind == "f" and not np.isfinite(array).all():
        return shown(array.tolist())
    return array.tolist()
