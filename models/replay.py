# /// script
# requires-python = ">=3.11"
# dependencies = ["numpy"]
# ///
"""Plays a recorded chunk file: a model whose answers are known in advance.

The file is what ``vla-zenoh demo`` writes as ``chunks.npz``::

    spec     the ModelSpec as JSON text
    steps    (N, H, D) float32, one chunk after the other
    length   (N,) steps in each chunk, the rest of H is not used

Run it with ``vla-zenoh worker replay --set file=runs/.../chunks.npz``.
"""

from __future__ import annotations

import json
import zipfile
from pathlib import Path

import numpy as np

from vla_zenoh.errors import SpecError, in_words
from vla_zenoh.policy import ActionSteps, ModelSpec, Observation, check_steps, standing_step


class Replay:
    """Plays recorded chunks; see the module.

    Args:
        file: the recorded chunks.
    """

    def __init__(self, file: str) -> None:
        path = Path(file).expanduser()
        try:
            with path.open("rb") as opened, np.load(opened, allow_pickle=False) as data:
                spec = ModelSpec.from_dict(json.loads(str(data["spec"])))
                steps, length = np.array(data["steps"], np.float32), data["length"].astype(int)
        except (OSError, KeyError, ValueError, TypeError, zipfile.BadZipFile) as error:
            raise SpecError(f"{path} is not a chunk file: {in_words(error)}") from error
        if steps.ndim != 3 or length.shape != steps.shape[:1]:
            raise SpecError(f"{path}: steps {steps.shape} and length {length.shape} do not fit")
        self.spec = spec.model_copy(update={"name": "replay"})
        self._chunks = [
            check_steps(spec.action, chunk[: int(n)])
            for chunk, n in zip(steps, length, strict=True)
        ]
        if not self._chunks:
            raise SpecError(f"{path} holds no chunk")
        self.reset()

    def reset(self) -> None:
        """Begin with the first chunk."""
        self._next = 0

    def infer(self, observation: Observation) -> ActionSteps:
        """The next recorded chunk; after the last one, stand still."""
        if self._next >= len(self._chunks):
            last = self._chunks[-1][-1]
            return ActionSteps(standing_step(self.spec.action, last)[None], done=True)
        chunk = self._chunks[self._next]
        if observation.task.active:
            self._next += 1
        return ActionSteps(chunk, self._next >= len(self._chunks))
