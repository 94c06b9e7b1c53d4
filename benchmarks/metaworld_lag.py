# /// script
# requires-python = ">=3.11"
# dependencies = ["metaworld==3.1.1", "packaging"]
# ///
"""Meta-World's experts in the package's own loop, every step executed some steps late.

    uv run benchmarks/metaworld_lag.py 4 0 1 2 3 4 6 8

The first number is the steps of a chunk, all as the expert decided for the first; the others are
lags in steps of 12.5 ms. Meanwhile the arm continues with the steps decided before. The 50 tasks,
each with its first goal. Needs nothing of vla-zenoh.
"""

from __future__ import annotations

import sys
import warnings
from collections import deque

import metaworld
import numpy as np
from metaworld.env_dict import ALL_V3_ENVIRONMENTS
from metaworld.policies import ENV_POLICY_MAP

GOAL_SEED, MAX_STEPS, STEP_MS = 42, 500, 12.5


def succeeds(name: str, repeat: int, lag: int) -> bool:
    """Whether the expert does the task's first goal."""
    env = ALL_V3_ENVIRONMENTS[name]()
    env.set_task(metaworld.MT1(name, seed=GOAL_SEED).train_tasks[0])
    seen, _ = env.reset()
    expert, late = ENV_POLICY_MAP[name](), deque([np.zeros(4)] * lag)
    for step in range(MAX_STEPS):
        if step % repeat == 0:
            action = np.clip(expert.get_action(seen.copy()), -1, 1).astype(np.float32)
        late.append(action)
        seen, _, _, _, info = env.step(late.popleft().astype(np.float64))
        if info["success"] > 0:
            return True
    return False


def main() -> None:
    """A line for each lag."""
    warnings.filterwarnings("ignore")
    repeat, *lags = map(int, sys.argv[1:])
    for lag in lags:
        done = sum(succeeds(name, repeat, lag) for name in ALL_V3_ENVIRONMENTS)
        print(f"{lag * STEP_MS:5.1f} ms late: {done} of {len(ALL_V3_ENVIRONMENTS)}", flush=True)


if __name__ == "__main__":
    main()
