"""What benchmarks with an environment of MuJoCo have in common. Needs MuJoCo, as they do."""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from vla_zenoh.policy import ActionSpec


def delta_action(unit_m: float, step_s: float, **more: Any) -> ActionSpec:
    """Steps of one displacement, `unit_m` to the unit, and a gripper that closes above 0."""
    return ActionSpec(
        horizon=1,
        dt_s=step_s,
        rotation="rotvec",
        position_scale_m=unit_m,
        gripper="binary",
        gripper_open_is_high=False,
        gripper_threshold=0.0,
        **more,
    )


def quat_xyzw(rotation: NDArray[np.float64]) -> NDArray[np.float64]:
    """(4,) of a rotation matrix as MuJoCo has it, (9,)."""
    quat_wxyz = np.zeros(4)
    mujoco.mju_mat2Quat(quat_wxyz, rotation)
    return np.roll(quat_wxyz, -1)


def draw_plainly(model: Any) -> None:
    """Leave out shadows and smooth edges; for renderers that are made afterwards."""
    model.vis.quality.shadowsize = 0
    model.vis.quality.offsamples = 0


class MujocoEnvironment:
    """State and images of `_env`, whose ``model`` and ``data`` are MuJoCo's.

    Attributes:
        size: width and height of its images, pixels.
    """

    size = (640, 480)
    _env: Any = None
    _renderer: Any = None

    def physics(self) -> NDArray[np.float64]:
        return np.concatenate([self._env.data.qpos, self._env.data.qvel])

    def close(self) -> None:
        if self._renderer is not None:
            self._renderer.close()
        self._renderer = None

    def draw(self, camera: str) -> NDArray[np.uint8]:
        """(H, W, 3) of a camera of the model; the renderer stays until `close`."""
        if self._renderer is None:
            width, height = self.size
            screen = self._env.model.vis.global_
            screen.offwidth = max(screen.offwidth, width)
            screen.offheight = max(screen.offheight, height)
            self._renderer = mujoco.Renderer(self._env.model, height, width)
        self._renderer.update_scene(self._env.data, camera)
        return self._renderer.render()
