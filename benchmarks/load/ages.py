"""How old chunks are: when they come, and while a robot has nothing newer."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vla_zenoh.errors import NodeError

STEP_S = 0.005
"""Between the moments at which the age of what a robot has is looked at."""

Came = Sequence[Sequence[tuple[float, float]]]
"""Of each robot (image taken, chunk came), in s on one clock."""


def age_row(came: Came, took_s: float, oldest_s: float) -> dict[str, Any]:
    """Ages on arrival of all chunks and of each robot, the rate of the robot that gets least, the
    share that a command node would reject as older than `oldest_s`, and the age of the newest image
    that a robot has a chunk of, at any time.

    Raises:
        NodeError: a robot had less than two chunks.
    """
    least = min(map(len, came))
    if least < 2:
        raise NodeError(f"a robot had {least} chunks in {took_s:g} s: measure longer (--seconds)")
    robots = [np.asarray(one) for one in came]
    ages = [1e3 * (one[:, 1] - one[:, 0]) for one in robots]
    every, held = np.concatenate(ages), 1e3 * np.concatenate([held_s(one) for one in robots])
    of_robot = [[round(float(age), 1) for age in np.percentile(one, [50, 95])] for one in ages]
    return {
        "age_p50_ms": round(float(np.percentile(every, 50)), 1),
        "age_p95_ms": round(float(np.percentile(every, 95)), 1),
        "worst_robot_p95_ms": max(p95 for _, p95 in of_robot),
        "held_p50_ms": round(float(np.percentile(held, 50)), 1),
        "held_p95_ms": round(float(np.percentile(held, 95)), 1),
        "robots_p50_p95_ms": of_robot,
        "chunks": len(every),
        "chunks_hz": round(least / took_s, 2),
        "too_old": round(float(np.mean(every > 1e3 * oldest_s)), 3),
    }


def held_s(came: NDArray[np.float64]) -> NDArray[np.float64]:
    """Age of the newest image that one robot has a chunk of, from its first chunk to its last, at
    moments that are `STEP_S` apart."""
    arrivals, newest = came[:, 1], np.maximum.accumulate(came[:, 0])
    at_s = np.arange(arrivals[0], arrivals[-1], STEP_S)
    return at_s - newest[np.searchsorted(arrivals, at_s, side="right") - 1]
