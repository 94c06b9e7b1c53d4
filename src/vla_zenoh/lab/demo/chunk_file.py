"""The chunks of a run as a file for the model `replay`."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from vla_zenoh.policy import ModelSpec


def write_chunks(path: Path, spec: ModelSpec, chunks: Sequence[np.ndarray]) -> None:
    """Write a chunk file for ``vla-zenoh worker replay``: spec, steps (N, H, D), length (N,)."""
    horizon, dimension = spec.action.horizon, spec.action.dimension
    steps = np.zeros((len(chunks), horizon, dimension), np.float32)
    for index, chunk in enumerate(chunks):
        steps[index, : len(chunk)] = chunk
    length = np.array([len(chunk) for chunk in chunks], np.int32)
    np.savez_compressed(path, spec=json.dumps(spec.to_dict()), steps=steps, length=length)
