"""Real-time chunking: the part of a worker's last chunk that is executed during inference.

A model that plans from scratch may choose another motion in each chunk, and the arm would jump from
one to the other. Real-time chunking conditions it on the steps in execution: the first ones can no
longer change (frozen), the later ones weigh less and less. See K. Black, M. Y. Galliker, S. Levine,
"Real-Time Execution of Action Chunking Flow Policies", NeurIPS 2025.

Models with ``takes_committed = True`` are called as ``infer(observation, committed=...)``. For all
others the command node aligns chunks by observation time and blends them.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vla_zenoh.errors import SpecError
from vla_zenoh.policy import ROTATION_SIZE, ActionSpec, ActionSteps, Observation, Policy

REMEMBERED_LATENCIES = 10
ALIGNED = 1e-3
"""An observation this close to a step's end (in steps) counts as at its end."""


@dataclass(frozen=True, slots=True, eq=False)
class Committed:
    """Steps in execution at the time of an observation, as the spec declares them.

    Args:
        steps: (K, D) float32; the first one starts at the observation, K < horizon.
        frozen: number of them that will have started when the next chunk arrives, at most K.
    """

    steps: NDArray[np.float32]
    frozen: int

    def weights(self, horizon: int) -> NDArray[np.float64]:
        """Weight (horizon,) of each committed step: the soft mask of equation 5 there.

        1 for frozen steps, then falling, 0 where nothing is committed.
        """
        index, overlap = np.arange(horizon), len(self.steps)
        falling = np.clip((overlap - index) / (overlap - self.frozen + 1), 0.0, 1.0)
        soft = falling * np.expm1(falling) / math.expm1(1.0)
        return np.where(index < self.frozen, 1.0, np.where(index < overlap, soft, 0.0))

    def padded(self, horizon: int) -> NDArray[np.float32]:
        """The steps padded with zeros to (horizon, D); the padding has weight 0."""
        out = np.zeros((horizon, self.steps.shape[1]), np.float32)
        out[: len(self.steps)] = self.steps[:horizon]
        return out


class ChunkPrefix:
    """Calls a model with the prefix of its next chunk, from its last chunk and its latency.

    Raises:
        SpecError: it takes the prefix, and its steps are relative to the start of their chunk.
    """

    def __init__(self, policy: Policy) -> None:
        self._policy, self._action = policy, policy.spec.action
        self._takes = bool(getattr(policy, "takes_committed", False))
        if self._takes and self._action.relative_to == "start":
            raise SpecError(
                "the steps in execution have another start than the next chunk, so a model that "
                "takes them cannot answer relative_to: start; let it answer relative_to: previous, "
                "or absolute poses"
            )
        self._latencies_s: deque[float] = deque(maxlen=REMEMBERED_LATENCIES)
        self._last: tuple[int, int, NDArray[np.float32]] | None = None

    def infer(self, observation: Observation) -> ActionSteps:
        """Infer, with the committed steps if the model takes them."""
        extra: Any = {"committed": self.committed(observation)} if self._takes else {}
        result = self._policy.infer(observation, **extra)
        return result if isinstance(result, ActionSteps) else ActionSteps(result)

    def published(
        self,
        observation: Observation,
        steps: NDArray[np.float32],
        published_ns: int,
        *,
        obeyed: bool,
    ) -> None:
        """Remember a published chunk.

        Args:
            observation: input of the inference.
            steps: (H, D).
            published_ns: wall clock.
            obeyed: the arm follows this worker; otherwise nothing is committed.
        """
        self._latencies_s.append((published_ns - observation.stamp_wall_ns) / 1e9)
        self._last = (
            (observation.task.episode, observation.stamp_wall_ns, steps) if obeyed else None
        )

    def committed(self, observation: Observation) -> Committed | None:
        """Steps in execution at this observation; None: none."""
        if self._last is None or self._last[0] != observation.task.episode:
            return None
        _, stamp_ns, steps = self._last
        # The command node starts the first step at once; see control/plan_timeline.py.
        passed_s = observation.task.speed * (observation.stamp_wall_ns - stamp_ns) / 1e9
        had = max(passed_s / self._action.dt_s, 1.0)
        left = rest_of(self._action, steps, had)
        if not len(left):
            return None
        late = observation.task.speed * max(self._latencies_s) / self._action.dt_s
        return Committed(left, min(math.ceil(late - ALIGNED), len(left)))


def rest_of(spec: ActionSpec, steps: NDArray[np.float32], had: float) -> NDArray[np.float32]:
    """The steps of a chunk that remain after `had` of them, which may be fractional.

    They follow the same path, resampled from the observation on: deltas are weighted sums of two
    neighbours, absolute poses interpolate between two. Rotations are interpolated as numbers, which
    is accurate for close neighbours. Absolute gripper numbers keep their current value.
    """
    whole = math.floor(had + ALIGNED)
    share = max(had - whole, 0.0)
    if share < ALIGNED:
        return steps[whole:].copy()
    first, second = steps[whole:-1].astype(np.float64), steps[whole + 1 :].astype(np.float64)
    turn = slice(3, 3 + ROTATION_SIZE[spec.rotation])
    turns = spec.space == "tcp"
    if turns and spec.rotation == "quaternion":
        near = np.sign(np.sum(first[:, turn] * second[:, turn], axis=1, keepdims=True))
        second[:, turn] *= np.where(near < 0, -1.0, 1.0)
    elif turns and spec.kind == "absolute":
        away = second[:, turn] - first[:, turn]
        second[:, turn] = first[:, turn] + (away + math.pi) % (2 * math.pi) - math.pi
    mixed = (1.0 - share) * first + share * second
    if turns and spec.rotation == "quaternion":
        mixed[:, turn] /= np.linalg.norm(mixed[:, turn], axis=1, keepdims=True)
    if spec.gripper not in ("none", "delta_m"):
        mixed[:, -1] = first[:, -1]
    return mixed.astype(np.float32)
