"""Bounds on what a model may ask for. Each says when it acted, with value and limit."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from vla_zenoh.kinematics.so3 import Pose, exp3, log3, norm3, orthonormal
from vla_zenoh.profile import REJECT_FACTOR, Limits
from vla_zenoh.types import FloatArray


class JointMotionLimits(NamedTuple):
    """(n,) each: rad/s, rad/s^2, rad/s^3."""

    velocity_rad_s: FloatArray
    acceleration_rad_s2: FloatArray
    jerk_rad_s3: FloatArray


class LimitHit(NamedTuple):
    """A bound that acted.

    Args:
        name: ``step_m``, ``step_rad``, ``workspace``, ``lead_m``, ``lead_rad``; from the arm's
            kinematics ``reach``, ``joint_limit``, ``joint_velocity``, ``singularity``,
            ``self_collision``, ``table_distance``.
        value: what was asked for.
        limit: what is allowed.
        fatal: too far off to be shortened.
        where: the joint, the two links, or the link over the table; empty for the whole arm.
    """

    name: str
    value: float
    limit: float
    fatal: bool = False
    where: str = ""


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
    inside, overshoot_m = into_workspace(limits, before.position_m + translation, before.position_m)
    if overshoot_m > 0:
        hits.append(LimitHit("workspace", overshoot_m, 0.0))
    if not hits:
        return Pose(inside, asked.rotation), hits
    return Pose(inside, orthonormal(exp3(rotvec) @ before.rotation)), hits


def _bound_norm(name: str, vector: FloatArray, limit: float) -> tuple[FloatArray, list[LimitHit]]:
    norm = norm3(vector)
    if norm <= limit * (1 + 1e-6):  # float32 steps of exactly the limit are within it
        return vector, []
    if not math.isfinite(norm):  # a product of numbers that were finite each
        return np.zeros(3), [LimitHit(name, math.inf, limit, fatal=True)]
    return vector * (limit / norm), [LimitHit(name, norm, limit, norm > REJECT_FACTOR * limit)]


def workspace_corners(limits: Limits) -> tuple[FloatArray, FloatArray]:
    """Lower and upper corner (3,) m of the workspace box."""
    box = limits.workspace
    low, high = np.array([box.x_m, box.y_m, box.z_m]).T
    return low, high


def into_workspace(
    limits: Limits, position_m: FloatArray, before_m: FloatArray | None = None
) -> tuple[FloatArray, float]:
    """The nearest position inside the workspace box, and how far that is (m).

    Args:
        limits: the box.
        position_m: (3,) in the base frame.
        before_m: (3,) where the step to it begins. From outside the box it may come back or stay,
            and goes no further out.
    """
    box = limits.workspace
    x, y, z = position_m.tolist()
    (x_low, x_high), (y_low, y_high), (z_low, z_high) = box.x_m, box.y_m, box.z_m
    if before_m is not None:
        x0, y0, z0 = before_m.tolist()
        x_low, y_low, z_low = min(x_low, x0), min(y_low, y0), min(z_low, z0)
        x_high, y_high, z_high = max(x_high, x0), max(y_high, y0), max(z_high, z0)
    if x_low <= x <= x_high and y_low <= y <= y_high and z_low <= z <= z_high:
        return position_m, 0.0
    inside = np.array(
        [min(max(x, x_low), x_high), min(max(y, y_low), y_high), min(max(z, z_low), z_high)]
    )
    return inside, norm3(position_m - inside)


def leash(limits: Limits, goal: Pose, commanded: Pose) -> tuple[Pose, list[LimitHit]]:
    """Keep the goal within reach of the commanded pose, so that no backlog builds up."""
    hits: list[LimitHit] = []
    ahead = goal.position_m - commanded.position_m
    turn = log3(goal.rotation @ commanded.rotation.T)
    for name, vector, limit in (
        ("lead_m", ahead, limits.lead_m),
        ("lead_rad", turn, limits.lead_rad),
    ):
        norm = norm3(vector)
        if norm > limit:
            hits.append(LimitHit(name, norm, limit))
            vector *= limit / norm
    if not hits:
        return goal, hits
    return Pose(commanded.position_m + ahead, orthonormal(exp3(turn) @ commanded.rotation)), hits
