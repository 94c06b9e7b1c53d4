"""What every server of another system in these tests does.

The policy goes up or down by one step, as the prompt says, and stands for any other prompt; the
last word of a prompt may ask for a fault: ``nan``, ``short``, ``raise``, ``slow``.
"""

from __future__ import annotations

import argparse
import math
import time
from typing import Any

import numpy as np

STEP_M = 0.01
HORIZON = 4
SLOW_S = 1.0


class Refused(Exception):
    """The policy was asked to fail."""


def actions(prompt: str) -> np.ndarray[Any, Any]:
    """(HORIZON, 7) of float32: dx dy dz, three turns, gripper 1 (open)."""
    words = prompt.split()
    fault = words[-1] if words else ""
    if fault == "raise":
        raise Refused("the policy was told to fail")
    if fault == "slow":
        time.sleep(SLOW_S)
    out = np.zeros((HORIZON, 7), np.float32)
    out[:, 2] = {"up": STEP_M, "down": -STEP_M}.get(words[0] if words else "", 0.0)
    out[:, 6] = 1.0
    if fault == "nan":
        out[0, 0] = math.nan
    return out[:, :6] if fault == "short" else out


def arguments() -> argparse.Namespace:
    """What each of the servers is told."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--port", type=int, required=True)
    parser.add_argument("--variant", default="")
    return parser.parse_args()
