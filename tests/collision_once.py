"""What an arm's collision shapes give, found once for all tests of a process.

It takes a fifth of a second for a Panda, and hundreds of tests make one.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from vla_zenoh.kinematics import collision
from vla_zenoh.kinematics.collision import CollisionModel
from vla_zenoh.kinematics.kinematics import Kinematics


def remember_distances() -> None:
    """From now on, of arms that are the same in every number."""
    collision._one_hull_a_link = _copied(_once(collision._one_hull_a_link, _arm))
    CollisionModel._at = _in_two(_once(CollisionModel._at, _shapes))
    CollisionModel._comes_near = _once(CollisionModel._comes_near, _shapes)


def _once(find: Callable[..., Any], of: Callable[[Any], Iterator[Any]]) -> Callable[..., Any]:
    found: dict[Any, Any] = {}

    def once(one: Any, *asked: Any) -> Any:
        key = (*map(_bytes, asked), *of(one))
        if key not in found:
            found[key] = find(one, *asked)
        return found[key]

    return once


def _copied(find: Callable[..., Any]) -> Callable[..., Any]:
    return lambda one: find(one).copy()


def _in_two(find: Callable[..., Any]) -> Callable[..., Any]:
    """The samples, which are the same for every home, and the home behind them."""

    def at(one: Any, samples_rad: Any, pairs: Any) -> Any:
        count = collision.SAMPLES
        parts = [part for part in (samples_rad[:count], samples_rad[count:]) if len(part)]
        return np.concatenate([find(one, part, pairs) for part in parts])

    return at


def _bytes(asked: Any) -> bytes:
    if isinstance(asked, Kinematics):
        asked = (asked.lower_rad, asked.upper_rad)
    return np.asarray(asked).tobytes()


def _arm(kinematics: Kinematics) -> Iterator[Any]:
    yield kinematics.urdf
    yield kinematics.urdf.read_bytes()
    yield kinematics.arm_joints
    yield kinematics.locked_position.tobytes()


def _shapes(model: Any) -> Iterator[Any]:
    yield model._model.saveToString()
    for shape in model._geometry.geometryObjects:
        points = getattr(shape.geometry, "points", list)()
        place = shape.placement.homogeneous.tobytes()
        yield shape.name, shape.parentJoint, place, _bytes(points)
