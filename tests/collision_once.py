"""Which links of an arm come near each other, found once for all tests of a process.

It takes a fifth of a second for a Panda, and hundreds of tests make one.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from vla_zenoh.kinematics.collision import CollisionModel
from vla_zenoh.kinematics.kinematics import Kinematics


def remember_distances() -> None:
    """From now on, of arms that are the same in every number."""
    for name in ("_at", "_comes_near"):
        setattr(CollisionModel, name, _once(getattr(CollisionModel, name)))


def _once(find: Callable[..., Any]) -> Callable[..., Any]:
    found: dict[Any, Any] = {}

    def once(self: Any, *asked: Any) -> Any:
        key = (*map(_bytes, asked), self._model.saveToString(), *_shapes(self))
        if key not in found:
            found[key] = find(self, *asked)
        return found[key]

    return once


def _bytes(asked: Any) -> bytes:
    if isinstance(asked, Kinematics):
        asked = (asked.lower_rad, asked.upper_rad)
    return np.asarray(asked).tobytes()


def _shapes(model: Any) -> Iterator[Any]:
    for shape in model._geometry.geometryObjects:
        points = getattr(shape.geometry, "points", list)()
        place = shape.placement.homogeneous.tobytes()
        yield shape.name, shape.parentJoint, place, _bytes(points)
