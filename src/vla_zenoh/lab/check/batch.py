"""Whether a model that answers several robots at once answers each as if it were alone."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from vla_zenoh.control.policy_check import Finding, error
from vla_zenoh.errors import SpecError
from vla_zenoh.lab.check.judge import Steps
from vla_zenoh.policy import ActionSpec, ActionSteps, Observation, Policy, check_steps

NEAR = 1e-3
"""Of the largest number of an answer: a batch is summed up in another order."""


def can(policy: Policy) -> bool:
    """Whether the model takes several observations at once."""
    return callable(getattr(policy, "infer_batch", None))


def ask(policy: Policy, observations: Sequence[Observation]) -> list[Any]:
    """What it answers, nothing of it being under way."""
    infer_batch: Any = getattr(policy, "infer_batch", None)
    committed = getattr(policy, "takes_committed", False)
    extra = {"committed": [None] * len(observations)} if committed else {}
    return list(infer_batch(list(observations), **extra))


def findings(action: ActionSpec, found: Sequence[Any], alone: Sequence[Any]) -> list[Finding]:
    """What differs.

    Args:
        action: of the spec.
        found: answers of ``infer_batch``.
        alone: (H, D) of ``infer`` for the same observations, in their order.
    """
    if len(found) != len(alone):
        said = f"infer_batch gave {len(found)} answers to {len(alone)} observations"
        return [error("batch", said)]
    out: list[Finding] = []
    for number, (answer, wanted) in enumerate(zip(found, alone, strict=True), 1):
        steps = answer.steps if isinstance(answer, ActionSteps) else answer
        try:
            given: Steps = check_steps(action, steps)
        except SpecError as fault:
            out.append(error("batch", f"answer {number} of infer_batch: {fault}"))
            continue
        if given.shape != wanted.shape or np.abs(given - wanted).max() > NEAR * _size(wanted):
            out.append(error("batch", f"answer {number} of infer_batch is not that of infer"))
    return out


def _size(steps: Steps) -> float:
    return max(float(np.abs(steps).max()), 1e-6)
