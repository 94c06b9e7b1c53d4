"""What a simulation knows of its world."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from vla_zenoh.errors import RecordError
from vla_zenoh.types.checks import (
    FloatArray,
    integer,
    numbers,
    set_field,
    text,
    texts,
    unit_quaternion,
    vector,
)


@dataclass(frozen=True, slots=True, eq=False)
class SceneState:
    """All generalised positions of a simulation, enough for a renderer to draw it.

    Args:
        scene: name of the scene.
        qpos: (nq,), the simulator's own order and units, then what it can place by hand.
        seed: of the last reset, which says how the scene looks where its look is varied; or None.
    """

    scene: str
    qpos: FloatArray
    seed: int | None = None

    def __post_init__(self) -> None:
        text("scene", self.scene, 512)
        set_field(self, "qpos", vector("qpos", self.qpos, None))
        if self.seed is not None:
            set_field(self, "seed", integer("seed", self.seed))


@dataclass(frozen=True, slots=True, eq=False)
class ObjectPoses:
    """True poses of a simulation's objects in the base frame.

    Args:
        names: one per object.
        position_m: (n, 3).
        quat_xyzw: (n, 4).
    """

    names: tuple[str, ...]
    position_m: FloatArray
    quat_xyzw: FloatArray

    def __post_init__(self) -> None:
        names = texts("names", self.names, 128)
        set_field(self, "names", names)
        for name, size in (("position_m", 3), ("quat_xyzw", 4)):
            rows = numbers(name, getattr(self, name))
            if not names and rows.size == 0:  # an empty list does not say how wide it is
                rows = rows.reshape(0, size)
            if rows.shape != (len(names), size):
                raise RecordError(f"{name} has shape {rows.shape}, wanted ({len(names)}, {size})")
            check = unit_quaternion if name == "quat_xyzw" else _point
            array = np.array([check(name, row) for row in rows]).reshape(len(names), size)
            array.setflags(write=False)
            set_field(self, name, array)


def _point(name: str, value: ArrayLike) -> FloatArray:
    return vector(name, value, 3)
