"""Appearance of a scene, drawn from a seed: lights, colour of the table, pose of the front camera.

It changes images alone, so only a renderer uses it. Distractors are bodies; the world places them,
see `vla_zenoh.simulation.objects`.
"""

from __future__ import annotations

import math
from collections.abc import Collection
from typing import NamedTuple

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


class Appearance(NamedTuple):
    """Differences from the scene file, (3,) each; a reset applies those that are varied.

    Offset and rotation vectors are in the world frame.
    """

    ambient: FloatArray  # colour of the head light
    head: FloatArray  # its diffuse colour
    key: FloatArray  # diffuse colour of the scene's light
    key_turn_rad: FloatArray  # of the direction of that light
    table: FloatArray  # colour
    shift_m: FloatArray  # of the front camera
    turn_rad: FloatArray  # of the front camera


def draw_appearance(seed: int) -> Appearance:
    """The appearance of a reset with `seed`; offsets and rotations are uniform in a ball."""
    random = np.random.default_rng((_STREAM, seed))
    ambient, head, key = (_tinted(random, *bounds) for bounds in (AMBIENT, HEAD, KEY))
    key_turn_rad = _in_ball(random, MAX_LIGHT_TURN_RAD)
    table = random.uniform(*TABLE_BRIGHTNESS) * (1.0 - TABLE_SATURATION * random.uniform(size=3))
    shift_m, turn_rad = _in_ball(random, MAX_SHIFT_M), _in_ball(random, MAX_TURN_RAD)
    return Appearance(ambient, head, key, key_turn_rad, table, shift_m, turn_rad)


def check_variations(vary: Collection[str]) -> None:
    """Raise a `ResourceError` unless everything in `vary` is one of `VARIATIONS`."""
    unknown = sorted(set(vary) - set(VARIATIONS))
    if unknown:
        raise ResourceError(f"nothing called {unknown[0]!r} to vary; {', '.join(VARIATIONS)}")


class AppearanceSwitcher:
    """Applies appearances to a compiled scene, which it modifies, each in place of the last."""

    def __init__(self, model: mujoco.MjModel) -> None:
        self._model = model
        head = model.vis.headlight
        self._changed = (
            *(head.ambient, head.diffuse, model.light_diffuse, model.light_dir),
            *(model.mat_rgba, model.cam_pos, model.cam_quat),
        )
        self._original = tuple(np.array(values) for values in self._changed)

    def apply(self, seed: int | None, vary: Collection[str]) -> None:
        """Apply what `vary` names of the appearance of `seed`; None: that of the scene file.

        Raises:
            ResourceError: an unknown name in `vary`, or the scene lacks what it varies.
        """
        check_variations(vary)
        for values, original in zip(self._changed, self._original, strict=True):
            values[:] = original
        if seed is None:
            return
        model, look = self._model, draw_appearance(seed)
        if LIGHTS in vary:
            light = self._index("light", KEY_LIGHT)
            model.vis.headlight.ambient[:] = look.ambient
            model.vis.headlight.diffuse[:] = look.head
            model.light_diffuse[light] = look.key
            direction = model.light_dir[light].copy()
            mujoco.mju_rotVecQuat(model.light_dir[light], direction, _quat_wxyz(look.key_turn_rad))
        if TABLE in vary:
            model.mat_rgba[self._index("material", TABLE_MATERIAL), :3] = look.table
        if CAMERA in vary:
            camera = self._index("camera", FRONT_CAMERA)
            model.cam_pos[camera] += look.shift_m
            quat = model.cam_quat[camera].copy()
            mujoco.mju_mulQuat(model.cam_quat[camera], _quat_wxyz(look.turn_rad), quat)

    def _index(self, kind: str, name: str) -> int:
        try:
            return int(getattr(self._model, kind)(name).id)
        except KeyError as error:
            why = f"the scene has no {kind} {name!r} that could be varied"
            raise ResourceError(f"{why}; see sim/bricks/README.md") from error


def _tinted(random: np.random.Generator, low: float, high: float) -> FloatArray:
    return random.uniform(low, high) * (1.0 + MAX_TINT * random.uniform(-1.0, 1.0, 3))


def _in_ball(random: np.random.Generator, radius: float) -> FloatArray:
    direction = random.normal(size=3)
    return direction * radius * random.uniform() ** (1 / 3) / np.linalg.norm(direction)


def _quat_wxyz(rotvec: FloatArray) -> FloatArray:
    quat = np.array([1.0, 0.0, 0.0, 0.0])
    mujoco.mju_quatIntegrate(quat, rotvec, 1.0)
    return quat
