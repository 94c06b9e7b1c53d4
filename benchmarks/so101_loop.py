# /// script
# requires-python = ">=3.12,<3.14"
# dependencies = ["lerobot-env-so101==0.4.0"]
# ///
"""The controller of lerobot-env-so101 in the package's own loop, beside ``vla-zenoh bench sim``.

    vla-zenoh bench sim so101 -n 50 --worker so101_expert -o runs/so101
    uv run benchmarks/so101_loop.py runs/so101

Needs nothing of vla-zenoh. Exits with 1 if an episode differs in success or steps.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

from lerobot_env_so101 import SO101PickPlaceGymEnv
from lerobot_env_so101.policy import DEFAULT_ACTION_SCALE
from lerobot_env_so101.scripted.pick_place import PickPlaceController

MAX_STEPS = 300


def main() -> int:
    """Compare every episode of the run."""
    env = SO101PickPlaceGymEnv(random_block_position=True, action_scale=DEFAULT_ACTION_SCALE)
    lines = (Path(sys.argv[1]) / "episodes.jsonl").read_text("utf-8").splitlines()
    theirs = differing = 0
    for each in map(json.loads, lines):
        env.reset(seed=each["episode"])
        controller, steps, done = PickPlaceController(), 0, False
        while steps < MAX_STEPS and not done:
            block = env.data.sensor("block_pos").data
            action = controller.act(env.ik_point_pos, block, env.goal_pos)
            _, _, _, _, info = env.step(action)
            steps, done = steps + 1, bool(info["succeed"])
        theirs += done
        differing += (done, steps) != (each["success"], each["steps"])
    print(f"{theirs} of {len(lines)} in the package's loop, {differing} episodes differ")
    return 1 if differing else 0


if __name__ == "__main__":
    sys.exit(main())
