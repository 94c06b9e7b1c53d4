"""Objects of a simulated scene: where they are, and repeatable random places for them.

A scene declares in its MJCF where an object may stand::

    <custom>
      <numeric name="place/brick" data="x_min x_max y_min y_max yaw_min yaw_max"/>
      <numeric name="place_gap_m" data="0.05"/>
    </custom>

``distract/NAME`` is the same for a distractor, which is placed only on request.
"""

from __future__ import annotations

import math
from itertools import combinations
from typing import NamedTuple

import mujoco
import numpy as np
from numpy.typing import ArrayLike

from vla_zenoh.errors import ResourceError
from vla_zenoh.types import FloatArray

REGION_PREFIX = "place/"
DISTRACTOR_PREFIX = "distract/"
GAP = "place_gap_m"
MAX_DRAWS = 1000


class Place(NamedTuple):
    """Where an object stands, in the base frame, and its turn about the vertical."""

    x_m: float
    y_m: float
    yaw_rad: float


class Region(NamedTuple):
    """Bounds of the places of an object."""

    low: Place
    high: Place


class SimulatedObjects:
    """Every object of a model that can be placed, see `objects_of`."""

    def __init__(self, model: mujoco.MjModel, data: mujoco.MjData) -> None:
        self._model, self._data = model, data
        self._bodies = objects_of(model)

    def draw(self, seed: int, *, distractors: bool) -> None:
        """Place them at random in the scene's regions; the same seed gives the same places."""
        for name, place in draw_places(self._model, seed, distractors=distractors).items():
            height_m = float(self._model.body_pos[self._bodies[name], 2])
            half_rad = place.yaw_rad / 2.0
            turn = (0.0, 0.0, math.sin(half_rad), math.cos(half_rad))
            self.place(name, (place.x_m, place.y_m, height_m), turn)

    def poses(self) -> dict[str, tuple[FloatArray, FloatArray]]:
        """Position (3,) and quaternion x, y, z, w (4,) of every object, copies."""
        data = self._data
        return {
            name: (data.xpos[body].copy(), np.roll(data.xquat[body], -1))
            for name, body in self._bodies.items()
        }

    def place(self, name: str, position_m: ArrayLike, quat_xyzw: ArrayLike) -> None:
        """Put one at a pose, at rest.

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


def objects_of(model: mujoco.MjModel) -> dict[str, int]:
    """Name -> body id of every object that can be placed: free bodies and mocap bodies."""
    free = model.jnt_bodyid[model.jnt_type == mujoco.mjtJoint.mjJNT_FREE].tolist()
    placed = np.flatnonzero(model.body_mocapid >= 0).tolist()
    return {model.body(i).name: i for i in sorted(free + placed)}


def regions_of(model: mujoco.MjModel, prefix: str = REGION_PREFIX) -> dict[str, Region]:
    """Regions by name of the object, from the entries that begin with `prefix`.

    Raises:
        ResourceError: a region is malformed, or of an object the scene does not have.
    """
    known = objects_of(model)
    regions: dict[str, Region] = {}
    for index in range(model.nnumeric):
        entry = model.numeric(index)
        if not entry.name.startswith(prefix):
            continue
        name = entry.name.removeprefix(prefix)
        if name not in known:
            raise ResourceError(
                f"the scene places {name!r}, but can only place: {', '.join(known) or 'nothing'}"
            )
        data = entry.data.tolist()
        if len(data) != 6 or not all(data[i] <= data[i + 1] for i in (0, 2, 4)):
            raise ResourceError(
                f"{entry.name} is {data}, wanted x_min x_max y_min y_max yaw_min yaw_max"
            )
        regions[name] = Region(Place(*data[0::2]), Place(*data[1::2]))
    return regions


def footprint_m(model: mujoco.MjModel, body: int) -> float:
    """Radius of the upright cylinder about the body's origin that holds all its geoms."""
    radius = 0.0
    for geom in np.flatnonzero(model.geom_bodyid == body):
        rotation = np.empty(9)
        mujoco.mju_quat2Mat(rotation, model.geom_quat[geom])
        corners = box_corners(model, int(geom)) @ rotation.reshape(3, 3).T + model.geom_pos[geom]
        radius = max(radius, float(np.hypot(corners[:, 0], corners[:, 1]).max()))
    return radius


def box_corners(model: mujoco.MjModel, geom: int) -> FloatArray:
    """(8, 3) corners of a geom's bounding box, in the geom's frame."""
    centre, half = model.geom_aabb[geom, :3], model.geom_aabb[geom, 3:]
    signs = np.array(np.meshgrid(*[(-1.0, 1.0)] * 3)).reshape(3, -1).T
    return centre + signs * half


def draw_places(model: mujoco.MjModel, seed: int, *, distractors: bool = False) -> dict[str, Place]:
    """Draw a place without overlaps for every object that has a region.

    Objects without a region stay where the scene file has them, and the drawn ones keep clear of
    them. Distractors do not change the places of the other objects.

    Raises:
        ResourceError: the regions are too small for the objects.
    """
    random = np.random.default_rng(seed)
    regions, bodies = regions_of(model), objects_of(model)
    radii = {name: footprint_m(model, body) for name, body in bodies.items()}
    has_gap = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_NUMERIC, GAP) >= 0
    gap_m = float(model.numeric(GAP).data[0]) if has_gap else 0.0
    fixed = {
        name: Place(float(model.body_pos[body, 0]), float(model.body_pos[body, 1]), 0.0)
        for name, body in bodies.items()
        if name not in regions
    }

    def draw(wanted: dict[str, Region], beside: dict[str, Place]) -> dict[str, Place]:
        for _ in range(MAX_DRAWS):
            drawn = {
                name: Place(*random.uniform(region.low, region.high).tolist())
                for name, region in wanted.items()
            }
            if _apart(beside | drawn, radii, gap_m):
                return drawn
        raise ResourceError(
            f"no room for {', '.join(wanted)} in their regions with {gap_m:g} m between them; "
            f"make the regions of the scene larger or {GAP} smaller"
        )

    places = draw(regions, fixed)
    if distractors:
        for name, region in regions_of(model, DISTRACTOR_PREFIX).items():
            del fixed[name]
            places |= draw({name: region}, fixed | places)
    return places


def _apart(places: dict[str, Place], radii: dict[str, float], gap_m: float) -> bool:
    return all(
        math.hypot(a.x_m - b.x_m, a.y_m - b.y_m) >= radii[one] + radii[other] + gap_m
        for (one, a), (other, b) in combinations(places.items(), 2)
    )
