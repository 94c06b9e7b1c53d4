"""Bounds on what a model may ask for. Each says when it acted, with value and limit."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from vla_zenoh.control.so3 import Pose, exp3, log3, orthonormal
from vla_zenoh.profile import Limits
from vla_zenoh.types import FloatArray

REFUSE_FACTOR = 4.0
"""A step this many times over its limit is a mistake (a wrong unit), not a motion: refused."""


class LimitHit(NamedTuple):
    """A bound that acted.

    Args:
        name: ``step_m``, ``step_rad``, ``workspace``, ``lead_m``, ``lead_rad``.
        value: what was asked for.
        limit: what is allowed.
        fatal: too far off to be shortened.
    """

    name: str
    value: float
    limit: float
    fatal: bool = False


def bound_step(limits: Limits, before: Pose, asked: Pose) -> tuple[Pose, list[LimitHit]]:
    """Shorten the step from `before` to `asked` to its limits and the workspace.

    Returns:
        the bounded pose and what acted; with a fatal hit the pose must not be used.
    """
    hits: list[LimitHit] = []
    translation = asked.position_m - before.position_m
    rotvec = log3(asked.rotation @ before.rotation.T)
    translation, hit = _bound_norm("step_m", translation, limits.step_m)
    hits += hit
    rotvec, hit = _bound_norm("step_rad", rotvec, limits.step_rad)
    hits += hit
    position_m = before.position_m + translation
    inside, overshoot_m = into_workspace(limits, position_m)
    if overshoot_m > 0:
        hits.append(LimitHit("workspace", overshoot_m, 0.0))
    if not hits:
        return asked, hits
    return Pose(inside, orthonormal(exp3(rotvec) @ before.rotation)), hits


def _bound_norm(name: str, vector: FloatArray, limit: float) -> tuple[FloatArray, list[LimitHit]]:
    norm = float(np.linalg.norm(vector))
    if norm <= limit * (1 + 1e-6):  # float32 steps of exactly the limit are within it
        return vector, []
    return vector * (limit / norm), [LimitHit(name, norm, limit, norm > REFUSE_FACTOR * limit)]


def into_workspace(limits: Limits, position_m: FloatArray) -> tuple[FloatArray, float]:
    """The nearest position inside the workspace box, and how far that is (m)."""
    box = limits.workspace
    low = np.array([box.x_m[0], box.y_m[0], box.z_m[0]])
    high = np.array([box.x_m[1], box.y_m[1], box.z_m[1]])
    inside = np.clip(position_m, low, high)
    return inside, float(np.linalg.norm(position_m - inside))


def leash(limits: Limits, goal: Pose, commanded: Pose) -> tuple[Pose, list[LimitHit]]:
    """Keep the goal within reach of the commanded pose, so that no backlog builds up."""
    hits: list[LimitHit] = []
    ahead = goal.position_m - commanded.position_m
    turn = log3(goal.rotation @ commanded.rotation.T)
    for name, vector, limit in (
        ("lead_m", ahead, limits.lead_m),
        ("lead_rad", turn, limits.lead_rad),
    ):
        norm = float(np.linalg.norm(vector))
        if norm > limit:
            hits.append(LimitHit(name, norm, limit))
            vector *= limit / norm
    if not hits:
        return goal, hits
    return Pose(commanded.position_m + ahead, orthonormal(exp3(turn) @ commanded.rotation)), hits
