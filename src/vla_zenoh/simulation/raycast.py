"""Renders by ray casting: no OpenGL, no driver, the same image on every machine.

One ray a pixel costs 110 ms at 640x480, so most of them are not cast. For a fixed camera only the
pixels that moving bodies can cover are, over a background cast once. For a moving camera a coarse
grid comes first; its cells that contain an edge are cast in full, the others interpolated. An
object that fits between the grid's rays, 4 pixels apart, may be missed.

Lighting is that of MuJoCo's OpenGL without shadows, textures and specular highlights::

    colour = rgb (sum of ambients + sum over lights of diffuse max(0, n . l))
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from vla_zenoh.opencv import cv2
from vla_zenoh.simulation.scene import MOVING_GROUP, STATIC_GROUP, box_corners
from vla_zenoh.types import FloatArray

Pixels = NDArray[np.uint8]

GRID_PX = 4
SMOOTH_COSINE = 0.97
FLAT_COSINE = 1.0 - 1e-9
"""Between the normals of one plane."""
FAR = 100.0
NEAR_M = 1e-3
GROUPS = 6
# MuJoCo's marker for a geom that takes the colour of its material.
NO_COLOUR = np.array([0.5, 0.5, 0.5, 1.0], dtype=np.float32)


class Hits(NamedTuple):
    """Hits of n rays: geom (n,) or -1, distance (n,) in ray lengths, normal (n, 3)."""

    geom: NDArray[np.int32]
    distance: FloatArray
    normal: FloatArray


class Background(NamedTuple):
    """What a fixed camera sees, (height, width, ...): colour and depth in m, or infinity."""

    rgb: Pixels
    distance: FloatArray


class Viewpoint(NamedTuple):
    """A camera's id and pose, with axes (3, 3), its focal length and its size in pixels."""

    camera: int
    position_m: FloatArray
    axes: FloatArray
    focal_px: float
    width: int
    height: int


class RaycastCanvas:
    """Renders one model, whose geoms `build_model` has sorted into groups, by ray casting."""

    def __init__(self, model: mujoco.MjModel) -> None:
        self._model = model
        moving = np.flatnonzero(model.geom_group == MOVING_GROUP)
        self._outlines = {int(geom): _outline(model, int(geom)) for geom in moving}
        self._rays: dict[tuple[float, int, int, int], FloatArray] = {}
        self._backgrounds: dict[tuple[int, int, int], Background] = {}
        self.refresh()

    def refresh(self) -> None:
        """Read colours from the model, and discard the backgrounds that were cast with others."""
        model = self._model
        own = (model.geom_rgba != NO_COLOUR).any(axis=1) | (model.geom_matid < 0)
        self._rgb = np.where(own[:, None], model.geom_rgba, model.mat_rgba[model.geom_matid])[:, :3]
        self._backgrounds.clear()

    def draw(self, data: mujoco.MjData, camera: str, width: int, height: int) -> Pixels:
        """Image of `camera`, (height, width, 3) RGB."""
        view = self._view(data, camera, width, height)
        if self._stands(view.camera):
            return self._over_background(data, view).rgb
        return self._coarse_to_fine(data, view)

    def draw_depth(self, data: mujoco.MjData, camera: str, width: int, height: int) -> FloatArray:
        """Distance along the optical axis in m, (height, width); infinite where nothing is."""
        view = self._view(data, camera, width, height)
        if self._stands(view.camera):
            return self._over_background(data, view).distance
        return self._depth_coarse_to_fine(data, view)

    def _view(self, data: mujoco.MjData, camera: str, width: int, height: int) -> Viewpoint:
        index = self._model.camera(camera).id
        focal_px = height / 2.0 / math.tan(math.radians(self._model.cam_fovy[index]) / 2.0)
        axes = data.cam_xmat[index].reshape(3, 3)
        return Viewpoint(index, data.cam_xpos[index], axes, focal_px, width, height)

    def _stands(self, camera: int) -> bool:
        body = self._model.cam_bodyid[camera]
        return self._model.body_weldid[body] == 0 and self._model.body_mocapid[body] < 0

    def close(self) -> None:
        """Nothing to free."""

    def _over_background(self, data: mujoco.MjData, view: Viewpoint) -> Background:
        key = view.camera, view.width, view.height
        if key not in self._backgrounds:
            rays = self._directions(view).reshape(-1, 3)
            hits = self._cast(data, view, rays, {STATIC_GROUP})
            rgb = self._shade(data, view, rays, hits).reshape(view.height, view.width, 3)
            distance = np.where(hits.geom < 0, np.inf, hits.distance)
            self._backgrounds[key] = Background(rgb, distance.reshape(rgb.shape[:2]))
        background = self._backgrounds[key]
        image, distance = background.rgb.copy(), background.distance.copy()
        rows, columns = np.nonzero(self._covered(data, view))
        rays = self._directions(view)[rows, columns]
        hits = self._cast(data, view, rays, {MOVING_GROUP})
        seen = (hits.geom >= 0) & (hits.distance < distance[rows, columns])
        front = Hits(hits.geom[seen], hits.distance[seen], hits.normal[seen])
        pixels = rows[seen], columns[seen]
        image[pixels] = self._shade(data, view, rays[seen], front)
        distance[pixels] = front.distance
        return Background(image, distance)

    def _cast_grid(
        self, data: mujoco.MjData, view: Viewpoint, cosine: float
    ) -> tuple[FloatArray, Hits, NDArray[np.bool_]]:
        """Rays of the coarse grid, their hits, and the pixels (height, width) to cast in full."""
        coarse = self._directions(view, GRID_PX)
        hits = self._cast(data, view, coarse.reshape(-1, 3), {STATIC_GROUP, MOVING_GROUP})
        smooth = _smooth_cells(
            hits.geom.reshape(coarse.shape[:2]), hits.normal.reshape(coarse.shape), cosine
        )
        rough = np.kron(~smooth, np.ones((GRID_PX, GRID_PX), dtype=bool))
        return coarse, hits, rough[: view.height, : view.width]

    def _coarse_to_fine(self, data: mujoco.MjData, view: Viewpoint) -> Pixels:
        coarse, hits, rough = self._cast_grid(data, view, SMOOTH_COSINE)
        colour = self._shade(data, view, coarse.reshape(-1, 3), hits).reshape(coarse.shape)
        image = _between(colour, view)
        rays = self._directions(view)[rough]
        fine = self._cast(data, view, rays, {STATIC_GROUP, MOVING_GROUP})
        image[rough] = self._shade(data, view, rays, fine)
        return np.asarray(image, np.uint8)

    def _depth_coarse_to_fine(self, data: mujoco.MjData, view: Viewpoint) -> FloatArray:
        coarse, hits, rough = self._cast_grid(data, view, FLAT_COSINE)
        # One over the depth of a plane is linear in the image: nothing is lost between the rays.
        inverse = np.where(hits.geom < 0, 0.0, 1.0 / np.where(hits.geom < 0, 1.0, hits.distance))
        with np.errstate(divide="ignore"):
            depth_m = 1.0 / _between(inverse.reshape(coarse.shape[:2]), view)
        rays = self._directions(view)[rough]
        fine = self._cast(data, view, rays, {STATIC_GROUP, MOVING_GROUP})
        depth_m[rough] = np.where(fine.geom < 0, np.inf, fine.distance)
        return depth_m

    def _directions(self, view: Viewpoint, step_px: int = 1) -> FloatArray:
        """(rows, columns, 3) rays through every `step_px`-th pixel, in the camera's own axes.

        They are one unit deep. A coarse grid reaches over the image's edge, so that every pixel
        lies in one of its cells.
        """
        key = (view.focal_px, view.width, view.height, step_px)
        if key not in self._rays:
            beyond = 0 if step_px == 1 else 1
            column = np.arange(-(-view.width // step_px) + beyond) * step_px
            row = np.arange(-(-view.height // step_px) + beyond) * step_px
            rays = np.empty((len(row), len(column), 3))
            rays[..., 0] = (column + 0.5 - view.width / 2.0) / view.focal_px
            rays[..., 1] = ((view.height / 2.0 - row - 0.5) / view.focal_px)[:, None]
            rays[..., 2] = -1.0
            self._rays[key] = rays
        return self._rays[key]

    def _cast(
        self, data: mujoco.MjData, view: Viewpoint, rays: FloatArray, groups: set[int]
    ) -> Hits:
        count = len(rays)
        geom = np.full(count, -1, np.int32)
        distance, normal = np.zeros(count), np.zeros((count, 3))
        if count:
            wanted = np.array([group in groups for group in range(GROUPS)], np.uint8)
            world = np.ascontiguousarray(rays @ view.axes.T)
            rays_in = (view.position_m, world.reshape(-1), wanted, True, -1)
            hits_out = (geom, distance, normal.reshape(-1))
            mujoco.mj_multiRay(self._model, data, *rays_in, *hits_out, count, FAR)
        return Hits(geom, distance, normal)

    def _shade(self, data: mujoco.MjData, view: Viewpoint, rays: FloatArray, hits: Hits) -> Pixels:
        """(n, 3) colours; black where a ray hit nothing, as in OpenGL."""
        model, head = self._model, self._model.vis.headlight
        normal = hits.normal
        light = np.zeros((len(rays), 3))
        if head.active:
            light += head.ambient
            light += np.maximum(normal @ view.axes[:, 2], 0.0)[:, None] * head.diffuse
        for index in np.flatnonzero(model.light_active):
            if model.light_type[index] == mujoco.mjtLightType.mjLIGHT_DIRECTIONAL:
                towards = -data.light_xdir[index]
                cosine = normal @ towards
            else:
                point = view.position_m + hits.distance[:, None] * (rays @ view.axes.T)
                towards = data.light_xpos[index] - point
                towards /= np.linalg.norm(towards, axis=1, keepdims=True)
                cosine = np.einsum("ij,ij->i", normal, towards)
            light += model.light_ambient[index]
            light += np.maximum(cosine, 0.0)[:, None] * model.light_diffuse[index]
        colour = np.minimum(self._rgb[hits.geom] * light, 1.0) * 255.0 + 0.5
        return np.where(hits.geom[:, None] < 0, 0, colour).astype(np.uint8)

    def _covered(self, data: mujoco.MjData, view: Viewpoint) -> NDArray[np.bool_]:
        """(height, width) mask of the pixels that moving geoms may cover."""
        mask = np.zeros((view.height, view.width), np.uint8)
        centre = np.array([view.width / 2.0, view.height / 2.0])
        for geom, points in self._outlines.items():
            world = points @ data.geom_xmat[geom].reshape(3, 3).T + data.geom_xpos[geom]
            local = (world - view.position_m) @ view.axes
            depth = -local[:, 2]
            if depth.max() < NEAR_M:
                continue
            if depth.min() < NEAR_M:
                return np.ones_like(mask, dtype=bool)
            pixel = centre + view.focal_px * local[:, :2] * (1.0, -1.0) / depth[:, None]
            hull = cv2.convexHull(np.clip(np.rint(pixel), -10_000, 10_000).astype(np.int32))
            cv2.fillConvexPoly(mask, hull, 1)
            cv2.polylines(mask, [hull], True, 1, 2)  # makes up for the rounding
        return mask.astype(bool)


def _outline(model: mujoco.MjModel, geom: int) -> FloatArray:
    """(n, 3) points in the geom's frame whose convex hull contains it."""
    mesh = model.geom_dataid[geom]
    if model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_MESH and mesh >= 0:
        first = model.mesh_vertadr[mesh]
        return model.mesh_vert[first : first + model.mesh_vertnum[mesh]].astype(float)
    return box_corners(model, geom)


def _between(grid: NDArray[Any], view: Viewpoint) -> NDArray[Any]:
    """Values at every pixel, linear between those of a grid of every `GRID_PX`-th one."""
    return cv2.warpAffine(
        grid,
        np.array([[1.0 / GRID_PX, 0.0, 0.0], [0.0, 1.0 / GRID_PX, 0.0]]),
        (view.width, view.height),
        flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
    )


def _smooth_cells(geom: NDArray[np.int32], normal: FloatArray, cosine: float) -> NDArray[np.bool_]:
    """Cells of a grid of rays whose corners lie on one geom without an edge between them."""
    first = (slice(None, -1), slice(None, -1))
    smooth = np.ones((geom.shape[0] - 1, geom.shape[1] - 1), dtype=bool)
    for row, column in ((0, 1), (1, 0), (1, 1)):
        other = (slice(row, geom.shape[0] - 1 + row), slice(column, geom.shape[1] - 1 + column))
        turn = np.einsum("ijk,ijk->ij", normal[first], normal[other])
        smooth &= (geom[first] == geom[other]) & ((turn > cosine) | (geom[first] < 0))
    return smooth
