"""What lies about in a simulated scene: where it is, and how it is put somewhere else."""

from __future__ import annotations

import math

import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

from vla_zenoh.errors import ResourceError
from vla_zenoh.simulation.placement import draw_places, objects_of

FloatArray = NDArray[np.float64]


class SimulatedObjects:
    """Everything in a model that can be placed: free bodies, and those that are moved by hand.

    Args:
        model: the scene.
        data: its state.
    """

    def __init__(self, model: mujoco.MjModel, data: mujoco.MjData) -> None:
        self._model, self._data = model, data
        self._bodies = objects_of(model)

    def draw(self, seed: int, *, distractors: bool) -> None:
        """Place them at random in the scene's regions, the same for the same number."""
        for name, place in draw_places(self._model, seed, distractors=distractors).items():
            height_m = float(self._model.body_pos[self._bodies[name], 2])
            half_rad = place.yaw_rad / 2.0
            turn = (0.0, 0.0, math.sin(half_rad), math.cos(half_rad))
            self.put(name, (place.x_m, place.y_m, height_m), turn)

    def poses(self) -> dict[str, tuple[FloatArray, FloatArray]]:
        """Position (3,) and quaternion x, y, z, w (4,) of every object, copies."""
        data = self._data
        return {
            name: (data.xpos[body].copy(), np.roll(data.xquat[body], -1))
            for name, body in self._bodies.items()
        }

    def put(self, name: str, position_m: ArrayLike, quat_xyzw: ArrayLike) -> None:
        """Put one somewhere, at rest.

        Raises:
            ResourceError: the scene has no such object.
        """
        if name not in self._bodies:
            raise ResourceError(
                f"the scene has no object {name!r}; it has: {', '.join(self._bodies) or 'none'}"
            )
        model, data, body = self._model, self._data, self._bodies[name]
        quat_wxyz = np.roll(np.asarray(quat_xyzw, float), 1)
        mocap = model.body_mocapid[body]
        if mocap >= 0:
            data.mocap_pos[mocap], data.mocap_quat[mocap] = position_m, quat_wxyz
            return
        joint = model.body_jntadr[body]
        q, dof = model.jnt_qposadr[joint], model.jnt_dofadr[joint]
        data.qpos[q : q + 3], data.qpos[q + 3 : q + 7] = position_m, quat_wxyz
        data.qvel[dof : dof + 6] = 0.0
