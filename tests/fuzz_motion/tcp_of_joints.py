"""How far the TCP exceeds the limits of poses where joints are commanded.

    PYTHONPATH=tests python tests/fuzz_motion/tcp_of_joints.py --runs 8 --ticks 3000

Runs of the family ``seven joints`` of the motion fuzz. Velocity, acceleration and jerk of the TCP
are differences of the commanded joints' poses, per axis, as multiples of ``limits.translation``;
99 % of the ticks are below the second figure. There is no verdict: `fuzz_motion` judges that joints
keep their own limits.
"""

from __future__ import annotations

import argparse

import numpy as np
from motion_case import make_case
from motion_rig import Rig
from numpy.typing import NDArray

FAMILY = "seven joints"


def ratios(seed: int, ticks: int) -> list[NDArray[np.float64]]:
    """Of one run: velocity, acceleration and jerk of the TCP over their limits, in each tick."""
    case = make_case(FAMILY, seed)
    limits = case.profile.limits.translation
    most = (limits.velocity_m_s, limits.acceleration_m_s2, limits.jerk_m_s3)
    period_s = 1.0 / case.profile.timing.command_hz
    streamed = [tick for tick in Rig(case).run(ticks).ticks if tick.record is not None]
    at_s = np.array([tick.time_ns for tick in streamed]) / 1e9
    changed = np.array([case.arm.forward(tick.record.position_rad).position_m for tick in streamed])
    even = np.abs(np.diff(at_s) - period_s) < 1e-6
    out: list[NDArray[np.float64]] = []
    for limit in most:
        changed = np.diff(changed, axis=0) / period_s
        out.append(np.abs(changed).max(axis=1)[even] / limit)
        even = even[1:] & even[:-1]
    return out


def main() -> None:
    """See the module."""
    parser = argparse.ArgumentParser(description="TCP motion where joints are commanded.")
    parser.add_argument("--runs", type=int, default=8)
    parser.add_argument("--ticks", type=int, default=3000, help="of one run")
    options = parser.parse_args()
    runs = [ratios(seed, options.ticks) for seed in range(1, options.runs + 1)]
    names = ("velocity", "acceleration", "jerk")
    for name, parts in zip(names, zip(*runs, strict=True), strict=True):
        found = np.concatenate(parts)
        high = np.percentile(found, 99)
        print(f"{name}: at most {found.max():.2f} times the limit, 99 %: {high:.2f}, {len(found)}")


if __name__ == "__main__":
    main()
