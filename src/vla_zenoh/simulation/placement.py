"""Random but repeatable places for the objects of a scene.

A scene says in its MJCF where an object may stand::

    <custom>
      <numeric name="place/brick" data="x_min x_max y_min y_max yaw_min yaw_max"/>
      <numeric name="place_gap_m" data="0.05"/>
    </custom>

``distract/NAME`` is the same for a distractor, which has a place only where one asks for it.
"""

from __future__ import annotations

import math
from collections.abc import Collection
from typing import NamedTuple

import mujoco
import numpy as np

from vla_zenoh.errors import ResourceError

REGION_PREFIX = "place/"
DISTRACTOR_PREFIX = "distract/"
GAP = "place_gap_m"
MAX_DRAWS = 1000


class Place(NamedTuple):
    """Where an object stands: metres in the base frame and a turn about the vertical."""

    x_m: float
    y_m: float
    yaw_rad: float


class Region(NamedTuple):
    """Where an object may stand."""

    low: Place
    high: Place


def objects_of(model: mujoco.MjModel) -> dict[str, int]:
    """Name -> body id of everything that can be placed: bodies with a free joint, mocap bodies."""
    free = model.jnt_bodyid[model.jnt_type == mujoco.mjtJoint.mjJNT_FREE].tolist()
    placed = np.flatnonzero(model.body_mocapid >= 0).tolist()
    return {model.body(i).name: i for i in sorted(free + placed)}


def regions_of(model: mujoco.MjModel, prefix: str = REGION_PREFIX) -> dict[str, Region]:
    """Regions by name of the object, of the entries that begin with `prefix`.

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
        centre, half = model.geom_aabb[geom, :3], model.geom_aabb[geom, 3:]
        rotation = np.empty(9)
        mujoco.mju_quat2Mat(rotation, model.geom_quat[geom])
        signs = np.array(np.meshgrid(*[(-1.0, 1.0)] * 3)).reshape(3, -1).T  # (8, 3)
        corners = (centre + signs * half) @ rotation.reshape(3, 3).T + model.geom_pos[geom]
        radius = max(radius, float(np.hypot(corners[:, 0], corners[:, 1]).max()))
    return radius


def draw_places(model: mujoco.MjModel, seed: int, *, distractors: bool = False) -> dict[str, Place]:
    """Draw a place for every object that has a region; nothing overlaps anything.

    Objects without a region stay where the scene puts them and are kept clear of. With or without
    distractors, the other objects have the same places.

    Raises:
        ResourceError: the regions are too small for the objects.
    """
    random = np.random.default_rng(seed)
    regions, bodies = regions_of(model), objects_of(model)
    radii = {name: footprint_m(model, body) for name, body in bodies.items()}
    gap = float(model.numeric(GAP).data[0]) if _has_numeric(model, GAP) else 0.0
    fixed = {
        name: Place(float(model.body_pos[body, 0]), float(model.body_pos[body, 1]), 0.0)
        for name, body in bodies.items()
        if name not in regions
    }
    for _ in range(MAX_DRAWS):
        drawn = {
            name: Place(*random.uniform(region.low, region.high).tolist())
            for name, region in regions.items()
        }
        if _apart(fixed | drawn, radii, gap):
            break
    else:
        raise _no_room(regions, gap)
    if distractors:
        for name, region in regions_of(model, DISTRACTOR_PREFIX).items():
            del fixed[name]
            for _ in range(MAX_DRAWS):
                place = Place(*random.uniform(region.low, region.high).tolist())
                if _apart(fixed | drawn | {name: place}, radii, gap):
                    break
            else:
                raise _no_room([name], gap)
            drawn[name] = place
    return drawn


def _no_room(names: Collection[str], gap_m: float) -> ResourceError:
    return ResourceError(
        f"no room for {', '.join(names)} in their regions with {gap_m:g} m between them; "
        f"make the regions of the scene larger or {GAP} smaller"
    )


def _apart(places: dict[str, Place], radii: dict[str, float], gap_m: float) -> bool:
    names = list(places)
    for index, name in enumerate(names):
        for other in names[:index]:
            a, b = places[name], places[other]
            if math.hypot(a.x_m - b.x_m, a.y_m - b.y_m) < radii[name] + radii[other] + gap_m:
                return False
    return True


def _has_numeric(model: mujoco.MjModel, name: str) -> bool:
    return mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_NUMERIC, name) >= 0
