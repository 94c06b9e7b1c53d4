# /// script
# requires-python = ">=3.11"
# dependencies = ["metaworld==3.1.1", "packaging"]
# ///
"""Meta-World's experts in the package's own loop, beside a run of ``vla-zenoh bench sim``.

    vla-zenoh bench sim metaworld -n 10 --worker metaworld_expert -o runs/metaworld
    uv run benchmarks/metaworld_loop.py runs/metaworld

Needs nothing of vla-zenoh. Actions are given in the type of the environment's action space,
float32; --float64 gives them as the experts compute them. Exits with 1 if a cell differs.
"""

from __future__ import annotations

import json
import sys
import warnings
from collections.abc import Iterator
from pathlib import Path

import metaworld
import numpy as np
from metaworld.env_dict import ALL_V3_ENVIRONMENTS
from metaworld.policies import ENV_POLICY_MAP

GOAL_SEED, MAX_STEPS = 42, 500


def loop(name: str, episodes: list[int], dtype: type) -> Iterator[tuple[int, bool, int]]:
    """Index, success and steps of each episode."""
    goals = metaworld.MT1(name, seed=GOAL_SEED).train_tasks
    env = ALL_V3_ENVIRONMENTS[name]()
    for episode in episodes:
        env.set_task(goals[episode])
        seen, _ = env.reset()
        expert, steps, done = ENV_POLICY_MAP[name](), 0, False
        while steps < MAX_STEPS and not done:
            action = np.clip(expert.get_action(seen), -1, 1).astype(dtype)
            seen, _, _, _, info = env.step(action.astype(np.float64))
            steps, done = steps + 1, bool(info["success"] > 0)
        yield episode, done, steps


def main() -> int:
    """Compare every episode of the run."""
    warnings.filterwarnings("ignore")
    dtype = np.float64 if "--float64" in sys.argv else np.float32
    lines = (Path(sys.argv[1]) / "episodes.jsonl").read_text("utf-8").splitlines()
    ours: dict[str, dict[int, tuple[bool, int]]] = {}
    for each in map(json.loads, lines):
        ours.setdefault(each["task"], {})[each["episode"]] = each["success"], each["steps"]
    differing = 0
    print("task, successes in the package's loop, in the run, of")
    for name, cells in ours.items():
        found = {i: (done, steps) for i, done, steps in loop(name, sorted(cells), dtype)}
        wrong = [i for i in cells if found[i] != cells[i]]
        differing += len(wrong)
        counts = [sum(done for done, _ in each.values()) for each in (found, cells)]
        note = f"  differs in episodes {wrong} (success, steps)" if wrong else ""
        print(f"{name:32} {counts[0]:3} {counts[1]:3} {len(cells):3}{note}", flush=True)
    total = sum(len(cells) for cells in ours.values())
    print(f"{total - differing} of {total} episodes alike in success and steps")
    return 1 if differing else 0


if __name__ == "__main__":
    sys.exit(main())
