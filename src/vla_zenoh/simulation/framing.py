"""Where cameras are that see an arm of any size: one before it and one beside its hand."""

from __future__ import annotations

from itertools import product

import mujoco
import numpy as np
from numpy.typing import NDArray

from vla_zenoh.types import FloatArray

FREE = 0.06
"""Share of half a picture that is kept free beside what it shows."""
DISTANCES_M = (0.08, 0.11, 0.15, 0.2)
"""Of a camera from the axis of its hand, beside it and behind the TCP; the nearest that sees."""
RAYS = np.array(
    [(x, y, -1.0) for x in np.linspace(-0.6, 0.6, 7) for y in np.linspace(-0.6, 0.6, 7)]
)
"""(m, 3) directions of a picture in its camera's frame."""
COVERED, AT_MOST = 0.2, 0.35
"""m from a camera within which an arm covers its picture, and what share of it may be covered."""


def step_back(
    model: mujoco.MjModel, data: mujoco.MjData, camera: int, points_m: FloatArray
) -> None:
    """Move a camera of the world, turned as it is, to where a square picture just holds points.

    A side of the picture is a plane through the camera: the distance at which a point lies on it is
    linear in the camera's place across.
    """
    axes = data.cam_xmat[camera].reshape(3, 3)
    right, up, back = (points_m @ axes).T
    slope = float(np.tan(np.radians(model.cam_fovy[camera]) / 2.0)) * (1.0 - FREE)
    place = np.zeros(3)
    for axis, across in enumerate((right, up)):
        high, low = np.max(back + across / slope), np.max(back - across / slope)
        place[axis] = slope * (high - low) / 2.0
        place[2] = max(place[2], (high + low) / 2.0)
    model.cam_pos[camera] = axes @ place


def beside_hand(
    model: mujoco.MjModel,
    data: mujoco.MjData,
    camera: int,
    own: NDArray[np.bool_],
    ahead: FloatArray,
    across: FloatArray,
) -> None:
    """Put a camera of the TCP's body beside its hand, where the arm covers little of the picture.

    Args:
        own: which geoms are of the arm.
        ahead: (3,) where the hand points, in the frame of that body.
        across: (3,) a unit vector across that.
    """
    body = model.cam_bodyid[camera]
    place, turn = data.xpos[body], data.xmat[body].reshape(3, 3)
    other = np.cross(ahead, across)
    least = np.inf
    for out_m, side in product(DISTANCES_M, (across, other, -across, -other)):
        eye_m = out_m * (side - ahead)
        axes = axes_of(eye_m, 0.5 * out_m * ahead, side)
        geoms, way_m = np.full(len(RAYS), -1, np.int32), np.zeros(len(RAYS))
        rays = (RAYS @ (turn @ axes).T).ravel()
        at = place + turn @ eye_m
        mujoco.mj_multiRay(
            model, data, at, rays, None, True, -1, geoms, way_m, None, len(RAYS), COVERED
        )
        covered = float(np.mean(own[geoms] & (geoms >= 0)))
        if covered < least:
            least = covered
            model.cam_pos[camera] = eye_m
            mujoco.mju_mat2Quat(model.cam_quat[camera], axes.ravel())
        if least <= AT_MOST:
            return


def axes_of(eye_m: FloatArray, look_at_m: FloatArray, up: FloatArray) -> FloatArray:
    """(3, 3) axes of a camera as columns: right, up, and back, from what it looks at."""
    back = (eye_m - look_at_m) / np.linalg.norm(eye_m - look_at_m)
    right = np.cross(up, back)
    right /= np.linalg.norm(right)
    return np.column_stack([right, np.cross(back, right), back])
