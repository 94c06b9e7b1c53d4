"""What of a worker's last chunk will be carried out while it thinks about the next one.

A model that plans afresh at every look may change its mind between two chunks, and the arm would
jump from one plan to the other. Real-time chunking gives it the steps that are under way: the first
ones cannot be changed any more and come back as they are (frozen), the later ones pull less and
less. See K. Black, M. Y. Galliker, S. Levine, "Real-Time Execution of Action Chunking Flow
Policies", NeurIPS 2025.

Models that say ``takes_committed = True`` are called as ``infer(observation, committed=...)``. For
all others the command node's alignment by observation time and its blend have to do.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vla_zenoh.policy import ROTATION_SIZE, ActionSpec, ActionSteps, Observation, Policy

REMEMBERED_LATENCIES = 10
ALIGNED = 1e-3
"""An observation this near to a step's end (in steps) is taken to be there."""


@dataclass(frozen=True, slots=True, eq=False)
class Committed:
    """Steps under way at the time of an observation, in the form the spec declares.

    Args:
        steps: (K, D) float32; the first one begins at the observation, K less than the horizon.
        frozen: so many of them will have begun when the next chunk arrives, K at most.
    """

    steps: NDArray[np.float32]
    frozen: int

    def weights(self, horizon: int) -> NDArray[np.float64]:
        """(horizon,) how much each step is to be as committed: the soft mask of equation 5 there.

        1 for those that are frozen, then falling, 0 where nothing is committed.
        """
        index, overlap = np.arange(horizon), len(self.steps)
        falling = np.clip((overlap - index) / (overlap - self.frozen + 1), 0.0, 1.0)
        soft = falling * np.expm1(falling) / math.expm1(1.0)
        return np.where(index < self.frozen, 1.0, np.where(index < overlap, soft, 0.0))

    def padded(self, horizon: int) -> NDArray[np.float32]:
        """(horizon, D) the steps, zeros behind them where their weight is 0 anyway."""
        out = np.zeros((horizon, self.steps.shape[1]), np.float32)
        out[: len(self.steps)] = self.steps[:horizon]
        return out


class ChunkPrefix:
    """Knows a worker's last chunk, and how long its chunks are on their way.

    Args:
        policy: the model.
    """

    def __init__(self, policy: Policy) -> None:
        self._policy, self._action = policy, policy.spec.action
        self._takes = bool(getattr(policy, "takes_committed", False))
        self._latencies_s: deque[float] = deque(maxlen=REMEMBERED_LATENCIES)
        self._last: tuple[int, int, NDArray[np.float32]] | None = None

    def infer(self, observation: Observation) -> ActionSteps:
        """What the model answers, told what is under way where it takes that."""
        if self._takes:
            committed = self.committed(observation)
            result = self._policy.infer(observation, committed=committed)  # pyright: ignore
        else:
            result = self._policy.infer(observation)
        return result if isinstance(result, ActionSteps) else ActionSteps(result)

    def published(
        self,
        observation: Observation,
        steps: NDArray[np.float32],
        published_ns: int,
        *,
        obeyed: bool,
    ) -> None:
        """A chunk is out.

        Args:
            observation: it was made of.
            steps: (H, D).
            published_ns: wall clock.
            obeyed: the arm follows this worker; what nobody carries out commits to nothing.
        """
        self._latencies_s.append((published_ns - observation.stamp_wall_ns) / 1e9)
        self._last = (
            (observation.task.episode, observation.stamp_wall_ns, steps) if obeyed else None
        )

    def committed(self, observation: Observation) -> Committed | None:
        """What is under way at this observation; None: nothing."""
        if self._last is None or self._last[0] != observation.task.episode:
            return None
        _, stamp_ns, steps = self._last
        # The command node counts the first step as asked for at once; see control/plan_timeline.py.
        passed_s = observation.task.speed * (observation.stamp_wall_ns - stamp_ns) / 1e9
        had = max(passed_s / self._action.dt_s, 1.0)
        left = rest_of(self._action, steps, had)
        if not len(left):
            return None
        late = observation.task.speed * max(self._latencies_s) / self._action.dt_s
        return Committed(left, min(math.ceil(late - ALIGNED), len(left)))


def rest_of(spec: ActionSpec, steps: NDArray[np.float32], had: float) -> NDArray[np.float32]:
    """The steps of a chunk that are left after `had` of them, part of one included.

    They lie on the same path, cut anew where the observation cuts it: deltas are shares of two
    neighbours, absolute poses lie between two. Rotations are mixed as numbers, which holds for
    neighbours that are near each other. Gripper numbers that are no deltas are those in force.
    """
    whole = math.floor(had + ALIGNED)
    share = max(had - whole, 0.0)
    if share < ALIGNED:
        return steps[whole:].copy()
    first, second = steps[whole:-1].astype(np.float64), steps[whole + 1 :].astype(np.float64)
    turn = slice(3, 3 + ROTATION_SIZE[spec.rotation])
    if spec.rotation == "quaternion":
        near = np.sign(np.sum(first[:, turn] * second[:, turn], axis=1, keepdims=True))
        second[:, turn] *= np.where(near < 0, -1.0, 1.0)
    elif spec.kind == "absolute":
        away = second[:, turn] - first[:, turn]
        second[:, turn] = first[:, turn] + (away + math.pi) % (2 * math.pi) - math.pi
    mixed = (1.0 - share) * first + share * second
    if spec.rotation == "quaternion":
        mixed[:, turn] /= np.linalg.norm(mixed[:, turn], axis=1, keepdims=True)
    if spec.gripper not in ("none", "delta_m"):
        mixed[:, -1] = first[:, -1]
    return mixed.astype(np.float32)
