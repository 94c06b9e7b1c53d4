"""Appearance of a scene, drawn from a seed: lights, colour of the table, pose of the front camera.

It changes images alone, so only a renderer uses it. Distractors are bodies; the world places them,
see `vla_zenoh.simulation.objects`.
"""

from __future__ import annotations

import math
from collections.abc import Collection
from dataclasses import dataclass

import mujoco
import numpy as np

from vla_zenoh.errors import ResourceError
from vla_zenoh.types import FloatArray

LIGHTS, TABLE, CAMERA, DISTRACTORS = "lights", "table", "camera", "distractors"
VARIATIONS = (LIGHTS, TABLE, CAMERA, DISTRACTORS)

KEY_LIGHT, TABLE_MATERIAL, FRONT_CAMERA = "key", "table", "front"
MAX_SHIFT_M = 0.03
MAX_TURN_RAD = math.radians(5.0)
AMBIENT, HEAD, KEY = (0.24, 0.44), (0.15, 0.38), (0.25, 0.65)
MAX_TINT = 0.12
MAX_LIGHT_TURN_RAD = 0.8
TABLE_BRIGHTNESS, TABLE_SATURATION = (0.35, 0.95), 0.35
_STREAM = 0x100C
"""Second seed of the random generator: appearance and places of objects are independent."""


@dataclass(frozen=True, slots=True)
class Appearance:
    """Differences from the scene file; None: as in the file.

    Args:
        ambient: (3,) ambient colour of the head light.
        head: (3,) diffuse colour of the head light.
        key: (3,) diffuse colour of the scene's light.
        key_turn_rad: rotation vector (3,) of the direction of that light, world frame.
        table: (3,) colour of the table.
        shift_m: (3,) offset of the front camera, world frame.
        turn_rad: (3,) rotation vector of the front camera, world frame.
    """

    ambient: FloatArray | None = None
    head: FloatArray | None = None
    key: FloatArray | None = None
    key_turn_rad: FloatArray | None = None
    table: FloatArray | None = None
    shift_m: FloatArray | None = None
    turn_rad: FloatArray | None = None


def draw_appearance(seed: int, vary: Collection[str]) -> Appearance:
    """The appearance of `seed`; each part is the same whatever else is varied.

    Args:
        seed: of the reset.
        vary: names of `VARIATIONS`; ``camera`` shifts by at most 3 cm and rotates by at most 5
            degrees, each uniform in a ball.

    Raises:
        ResourceError: an unknown name.
    """
    unknown = sorted(set(vary) - set(VARIATIONS))
    if unknown:
        raise ResourceError(f"nothing called {unknown[0]!r} to vary; {', '.join(VARIATIONS)}")
    random = np.random.default_rng((_STREAM, seed))
    ambient, head, key = (_tinted(random, *bounds) for bounds in (AMBIENT, HEAD, KEY))
    key_turn_rad = _in_ball(random, MAX_LIGHT_TURN_RAD)
    table = random.uniform(*TABLE_BRIGHTNESS) * (1.0 - TABLE_SATURATION * random.uniform(size=3))
    shift_m, turn_rad = _in_ball(random, MAX_SHIFT_M), _in_ball(random, MAX_TURN_RAD)
    return Appearance(
        **({"ambient": ambient, "head": head, "key": key} if LIGHTS in vary else {}),
        key_turn_rad=key_turn_rad if LIGHTS in vary else None,
        table=table if TABLE in vary else None,
        shift_m=shift_m if CAMERA in vary else None,
        turn_rad=turn_rad if CAMERA in vary else None,
    )


class AppearanceSwitcher:
    """Applies appearances to one model, each in place of the last.

    Args:
        model: a compiled scene; it is modified.
    """

    def __init__(self, model: mujoco.MjModel) -> None:
        self._model = model
        head = model.vis.headlight
        self._ambient, self._head = np.array(head.ambient), np.array(head.diffuse)
        self._diffuse, self._dir = model.light_diffuse.copy(), model.light_dir.copy()
        self._rgba = model.mat_rgba.copy()
        self._cam_pos, self._cam_quat = model.cam_pos.copy(), model.cam_quat.copy()

    def apply(self, look: Appearance) -> None:
        """Apply `look`; the caller recomputes the positions in its data.

        Raises:
            ResourceError: the scene lacks what this appearance changes.
        """
        model, head = self._model, self._model.vis.headlight
        head.ambient[:] = self._ambient if look.ambient is None else look.ambient
        head.diffuse[:] = self._head if look.head is None else look.head
        model.light_diffuse[:], model.light_dir[:] = self._diffuse, self._dir
        model.mat_rgba[:] = self._rgba
        model.cam_pos[:], model.cam_quat[:] = self._cam_pos, self._cam_quat
        if look.key is not None:
            model.light_diffuse[self._index("light", KEY_LIGHT)] = look.key
        if look.key_turn_rad is not None:
            light = self._index("light", KEY_LIGHT)
            turned = np.empty(3)
            mujoco.mju_rotVecQuat(turned, self._dir[light], _quat_wxyz(look.key_turn_rad))
            model.light_dir[light] = turned
        if look.table is not None:
            model.mat_rgba[self._index("material", TABLE_MATERIAL), :3] = look.table
        if look.shift_m is not None:
            model.cam_pos[self._index("camera", FRONT_CAMERA)] += look.shift_m
        if look.turn_rad is not None:
            camera = self._index("camera", FRONT_CAMERA)
            turned = np.empty(4)
            mujoco.mju_mulQuat(turned, _quat_wxyz(look.turn_rad), self._cam_quat[camera])
            model.cam_quat[camera] = turned

    def _index(self, kind: str, name: str) -> int:
        try:
            return int(getattr(self._model, kind)(name).id)
        except KeyError as error:
            raise ResourceError(
                f"the scene has no {kind} {name!r} that could be varied; see sim/bricks/README.md"
            ) from error


def _tinted(random: np.random.Generator, low: float, high: float) -> FloatArray:
    return random.uniform(low, high) * (1.0 + MAX_TINT * random.uniform(-1.0, 1.0, 3))


def _in_ball(random: np.random.Generator, radius: float) -> FloatArray:
    direction = random.normal(size=3)
    return direction * radius * random.uniform() ** (1 / 3) / np.linalg.norm(direction)


def _quat_wxyz(rotation_vector: FloatArray) -> FloatArray:
    angle = float(np.linalg.norm(rotation_vector))
    axis = rotation_vector / angle if angle > 0.0 else np.array([1.0, 0.0, 0.0])
    quat_wxyz = np.empty(4)
    mujoco.mju_axisAngle2Quat(quat_wxyz, axis, angle)
    return quat_wxyz
