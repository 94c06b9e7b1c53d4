"""One flat vector with every pose of a simulated world, to be copied from process to process."""

from __future__ import annotations

import mujoco
import numpy as np
from numpy.typing import NDArray

from vla_zenoh.errors import RecordError

FloatArray = NDArray[np.float64]


def pose_vector_size(model: mujoco.MjModel) -> int:
    """Length of the vector: joint coordinates, then 7 numbers per body that is merely placed."""
    return model.nq + 7 * model.nmocap


def read_pose_vector(model: mujoco.MjModel, data: mujoco.MjData) -> FloatArray:
    """Copy the poses out of `data`, ``(pose_vector_size(model),)``."""
    return np.concatenate([data.qpos, data.mocap_pos.ravel(), data.mocap_quat.ravel()])


def write_pose_vector(model: mujoco.MjModel, data: mujoco.MjData, vector: FloatArray) -> None:
    """Copy the poses into `data`; positions that depend on them are not computed yet.

    Raises:
        RecordError: `vector` is of another model, or not finite.
    """
    size = pose_vector_size(model)
    if vector.shape != (size,):
        raise RecordError(f"a pose vector of this scene has shape ({size},), got {vector.shape}")
    if not np.isfinite(vector).all():
        raise RecordError("the pose vector is not finite")
    split = model.nq + 3 * model.nmocap
    data.qpos[:] = vector[: model.nq]
    data.mocap_pos[:] = vector[model.nq : split].reshape(-1, 3)
    data.mocap_quat[:] = vector[split:].reshape(-1, 4)
