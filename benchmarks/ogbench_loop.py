# /// script
# requires-python = ">=3.11"
# dependencies = ["ogbench==1.2.2"]
# ///
"""OGBench's cube oracle in the package's own loop, beside a run of ``vla-zenoh bench sim``.

    vla-zenoh bench sim ogbench -n 10 --worker ogbench_expert -o runs/ogbench
    uv run benchmarks/ogbench_loop.py runs/ogbench

Needs nothing of vla-zenoh. Exits with 1 if an episode differs.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

import gymnasium
import numpy as np
import ogbench.manipspace  # noqa: F401 # registers its environments
from ogbench.manipspace.oracles.markov.cube_markov import CubeMarkovOracle

MAX_STEPS = {"cube-single-v0": 200, "cube-double-v0": 500, "cube-triple-v0": 1000}


def main() -> int:
    """Compare every episode of the run."""
    lines = (Path(sys.argv[1]) / "episodes.jsonl").read_text("utf-8").splitlines()
    cells = [json.loads(line) for line in lines]
    alike = 0
    for name, most in MAX_STEPS.items():
        env = gymnasium.make(name, terminate_at_goal=False, mode="data_collection").unwrapped
        oracle = CubeMarkovOracle(env=env, min_norm=0.4)
        for cell in (each for each in cells if each["task"] == name):
            seen, info = env.reset(seed=cell["episode"])
            oracle.reset(seen, info)
            steps, done = 0, False
            while steps < most and not done:
                action = np.clip(np.asarray(oracle.select_action(seen, info)), -1, 1)
                seen, _, _, _, info = env.step(action)
                steps, done = steps + 1, bool(info["success"])
            same = (done, steps) == (cell["success"], cell["steps"])
            alike += same
            word = "alike" if same else f"the run: {cell['success']}, {cell['steps']}"
            print(f"{name} {cell['episode']:3}: {done}, {steps} steps; {word}", flush=True)
    print(f"{alike} of {len(cells)} episodes alike in success and steps")
    return 0 if alike == len(cells) else 1


if __name__ == "__main__":
    sys.exit(main())
