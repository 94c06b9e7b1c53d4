"""What a model answers."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vla_zenoh.errors import RecordError
from vla_zenoh.types.checks import (
    MAX_CHUNK_NUMBERS,
    boolean,
    integer,
    numbers,
    set_field,
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
        done: the policy says its task is finished when these steps are.
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
        steps = numbers("steps", self.steps)
        if steps.ndim != 2 or 0 in steps.shape:
            raise RecordError(f"steps has shape {steps.shape}, wanted (H, D)")
        if steps.size > MAX_CHUNK_NUMBERS:
            raise RecordError(f"steps has {steps.size} numbers, at most {MAX_CHUNK_NUMBERS}")
        with np.errstate(over="ignore"):  # what float32 cannot hold becomes infinite, seen below
            steps = np.array(steps, dtype=np.float32, order="C")
        if not np.isfinite(steps).all():
            raise RecordError("steps holds NaN or infinity")
        steps.setflags(write=False)
        set_field(self, "steps", steps)
