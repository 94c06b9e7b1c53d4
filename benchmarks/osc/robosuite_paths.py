# /// script
# requires-python = ">=3.10,<3.12"
# dependencies = ["robosuite==1.4.0", "mujoco==2.3.7", "numpy<2", "termcolor"]
# ///
"""Plays action sequences through robosuite's own OSC_POSE on its Panda.

    uv run --script benchmarks/osc/robosuite_paths.py ACTIONS.npy PATHS.npz

ACTIONS: (n, steps, 6) in [-1, 1]. PATHS: ``position_m`` (n, steps + 1, 3) and ``rotation``
(n, steps + 1, 3, 3) of the site that the controller moves, in the base's axes, at the begin and
after each step; ``joints_rad`` (7,) at the begin.
"""

from __future__ import annotations

import sys

import numpy as np
import robosuite
from robosuite.controllers import load_controller_config


def main(actions_file: str, paths_file: str) -> None:
    """Play every sequence from the same start."""
    actions = np.load(actions_file)
    env = robosuite.make(
        "Lift",
        robots="Panda",
        controller_configs=load_controller_config(default_controller="OSC_POSE"),
        has_renderer=False,
        has_offscreen_renderer=False,
        use_camera_obs=False,
        use_object_obs=False,
        control_freq=20,
        horizon=10**6,
        initialization_noise=None,
        hard_reset=False,
    )
    positions, rotations = [], []
    for number, sequence in enumerate(actions):
        np.random.seed(0)
        env.reset()
        controller = env.robots[0].controller
        if number == 0:
            joints_rad = np.array(controller.joint_pos)
        place, turn = [], []
        for action in (None, *sequence):
            if action is not None:
                env.step(np.concatenate([action, [-1.0]]))
            controller.update(force=True)
            place.append(np.array(controller.ee_pos))
            turn.append(np.array(controller.ee_ori_mat))
        positions.append(place)
        rotations.append(turn)
        print(f"{number + 1}/{len(actions)}", end="\r", file=sys.stderr, flush=True)
    np.savez(
        paths_file,
        position_m=np.array(positions),
        rotation=np.array(rotations),
        joints_rad=joints_rad,
    )


if __name__ == "__main__":
    main(*sys.argv[1:])
