"""LeRobot's own Meta-World environment with smaller pictures, for ``lerobot-eval``.

    lerobot-eval --env.discover_packages_path=benchmarks.flywheel.lerobot_env \
        --env.type=small_metaworld --env.task=drawer-open-v3 --env.journal=cells.jsonl ...

Seeds, physics, camera, state and success are LeRobot's. Its pictures are always 480 x 480; these
are drawn in the size and the way of ``vla-zenoh bench sim metaworld --benchmark-set size=96
--benchmark-set plain=yes``. The journal says how each episode ended, which ``eval_info.json`` does
not tell step by step. Runs in LeRobot's environment.
"""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from lerobot.configs.types import FeatureType, PolicyFeature
from lerobot.envs.configs import EnvConfig
from lerobot.envs.configs import MetaworldEnv as MetaworldConfig
from lerobot.envs.metaworld import MetaworldEnv

SIZE = 96


class SmallMetaworld(MetaworldEnv):
    """LeRobot's environment, whose pictures are `size` x `size`, without shadows and smooth edges.

    Args:
        journal: file that a line is added to at the end of every episode; empty: none.
    """

    def __init__(self, task: str, size: int, journal: str, **more: Any) -> None:
        super().__init__(task, observation_width=size, observation_height=size, **more)
        self._size, self._journal = size, journal
        self._seed, self._steps = 0, 0

    def _ensure_env(self) -> None:
        made = self._env is not None
        super()._ensure_env()
        if made:
            return
        quality = self._env.model.vis.quality
        quality.shadowsize = quality.offsamples = 0
        renderer = self._env.mujoco_renderer  # makes its window at the first picture
        renderer.width = renderer.height = self._size

    def reset(self, seed: int | None = None, **more: Any) -> Any:
        self._end()
        if seed is not None:
            self._seed = seed
        return super().reset(seed=seed, **more)

    def step(self, action: np.ndarray) -> Any:
        self._steps += 1
        # At a success LeRobot resets the environment within the step: the journal has it before.
        return super().step(action)

    def close(self) -> None:
        self._end()
        super().close()

    def _end(self) -> None:
        """Write down the episode that ends now, if there is one."""
        if self._env is None or not self._steps:
            return
        data = self._env.data
        state = np.concatenate([data.qpos, data.qvel])
        end = hashlib.sha256(np.ascontiguousarray(state).tobytes()).hexdigest()[:16]
        line = {"task": self.task, "seed": self._seed, "steps": self._steps, "end": end}
        self._steps = 0
        if self._journal:
            with Path(self._journal).open("a") as file:
                file.write(json.dumps(line) + "\n")


@EnvConfig.register_subclass("small_metaworld")
@dataclass
class SmallMetaworldConfig(MetaworldConfig):
    """As LeRobot's ``metaworld``.

    Args:
        size: of the pictures, pixels.
        journal: see `SmallMetaworld`.
    """

    size: int = SIZE
    journal: str = ""

    def __post_init__(self) -> None:
        super().__post_init__()
        shape = (self.size, self.size, 3)
        self.features["pixels/top"] = PolicyFeature(type=FeatureType.VISUAL, shape=shape)

    def create_envs(self, n_envs: int, use_async_envs: bool = False) -> Any:
        from lerobot.envs.configs import _make_vec_env_cls

        kind = _make_vec_env_cls(use_async_envs, n_envs)
        make = partial(SmallMetaworld, self.task, self.size, self.journal, **self.gym_kwargs)
        return {self.task: {0: kind([make] * n_envs)}}
