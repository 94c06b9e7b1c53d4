"""The targets that every contestant gets: 25 a second, late by up to a third, not quite continuous.

A smooth path, as from a policy that infers every eight steps: each chunk is a few millimetres off
the one before. Needs numpy only; every contestant's environment has that.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

RATE_HZ, CHUNK = 25.0, 8
DURATION_S = 20.0
LATE_SHARE = 0.3
OFF_M = 0.003
"""Standard deviation of a chunk's offset, per axis."""
RAMP_S = 2.0


def offsets(seed: int = 1) -> Iterator[np.ndarray]:
    """Where the TCP should be, from where it began (m): (3,) each, without end."""
    rng, off, number = np.random.default_rng(seed), np.zeros(3), 0
    while True:
        time_s = number / RATE_HZ
        if number % CHUNK == 0:
            off = rng.normal(0.0, OFF_M, 3)
        share = min(1.0, time_s / RAMP_S)
        yield share * (smooth(time_s) + off)
        number += 1


def smooth(time_s: float) -> np.ndarray:
    """The path without the offsets of the chunks."""
    turn = 2 * math.pi * time_s
    return np.array([0.0, 0.06 * math.sin(turn / 4.0), 0.03 * math.sin(turn / 2.5)])


def lateness_s(seed: int = 2) -> Iterator[float]:
    """How late each target comes."""
    rng = np.random.default_rng(seed)
    while True:
        yield float(rng.uniform(0.0, LATE_SHARE / RATE_HZ))


def play(give: Callable[[np.ndarray], Any], ended: Callable[[], bool]) -> tuple[float, float]:
    """Give the targets in time, until `DURATION_S` is over or the motion has ended.

    Returns:
        When it began and ended, on the monotonic clock.
    """
    began_s = time.monotonic()
    for number, (offset, late_s) in enumerate(zip(offsets(), lateness_s(), strict=False)):
        due_s = began_s + number / RATE_HZ + late_s
        time.sleep(max(0.0, due_s - time.monotonic()))
        if ended() or number / RATE_HZ > DURATION_S:
            return began_s, time.monotonic()
        give(offset)
    raise AssertionError("the targets never end")
