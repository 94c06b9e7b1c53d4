"""Objects of a simulated scene, and repeatable random places for them.

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
    entries = [model.numeric(index) for index in range(model.nnumeric)]
    for entry in (entry for entry in entries if entry.name.startswith(prefix)):
        name = entry.name.removeprefix(prefix)
        if name not in known:
            can = ", ".join(known) or "nothing"
            raise ResourceError(f"the scene places {name!r}, but can only place: {can}")
        data = entry.data.tolist()
        if len(data) != 6 or not all(data[i] <= data[i + 1] for i in (0, 2, 4)):
            wanted = "x_min x_max y_min y_max yaw_min yaw_max"
            raise ResourceError(f"{entry.name} is {data}, wanted {wanted}")
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
            if all(
                math.hypot(a.x_m - b.x_m, a.y_m - b.y_m) >= radii[one] + radii[other] + gap_m
                for (one, a), (other, b) in combinations((beside | drawn).items(), 2)
            ):
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
