"""Poses from which a camera is calibrated: around the arm's present one, or from a file."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import yaml

from vla_zenoh.kinematics.so3 import exp3
from vla_zenoh.types import FloatArray
from vla_zenoh_calibrate.errors import CalibrationError
from vla_zenoh_calibrate.hand_eye import Eye
from vla_zenoh_calibrate.view import placed

GOLDEN_RAD = np.pi * (3.0 - np.sqrt(5.0))
MAX_TILT_RAD, MAX_ROLL_RAD, MAX_AWAY = 0.45, 1.2, 0.15
MAX_SHIFT_M = {"in-hand": 0.06, "to-hand": 0.12}
MAX_FILE_BYTES, MAX_POSES = 1_000_000, 1000


def tour(start: FloatArray, eye: Eye, ahead_m: float, count: int) -> list[FloatArray]:
    """Poses (4, 4) of the TCP around `start`; where the arm cannot go is found out on the way.

    With the eye in the hand the TCP goes around a point ahead of it, where the board is, and rolls.
    Else the board in the hand turns where it is. Neighbours in the list are near each other.

    Args:
        ahead_m: from the TCP along its z axis to the board.
    """
    rotation, place = start[:3, :3], start[:3, 3]
    pivot_m = ahead_m if eye == "in-hand" else 0.0
    centre = place + pivot_m * rotation[:, 2]
    out: list[FloatArray] = []
    for index in range(count):
        share = np.sqrt((index + 0.5) / count)
        way = index * GOLDEN_RAD
        side = np.array([np.cos(way), np.sin(way), 0.0])
        roll = MAX_ROLL_RAD * np.cos(2.0 * np.pi * index * 0.382)
        turn = exp3(MAX_TILT_RAD * share * side) @ exp3(np.array([0.0, 0.0, roll]))
        turned = rotation @ turn
        away_m = pivot_m * (1.0 + MAX_AWAY * np.sin(3.0 * way))
        shift = MAX_SHIFT_M[eye] * share * np.array([np.cos(2 * way), np.sin(2 * way), 0.0])
        out.append(placed(turned, centre - away_m * turned[:, 2] + rotation @ shift))
    return _in_order(start, out)


def _in_order(start: FloatArray, poses: list[FloatArray]) -> list[FloatArray]:
    """The nearest next, so that the arm does not go to and fro."""
    left, here, out = list(poses), start, list[FloatArray]()
    while left:
        nearest = min(range(len(left)), key=lambda index: _distance(here, left[index]))
        here = left.pop(nearest)
        out.append(here)
    return out


def _distance(a: FloatArray, b: FloatArray) -> float:
    turned = float(np.trace(a[:3, :3].T @ b[:3, :3]))
    angle = np.arccos(np.clip((turned - 1.0) / 2.0, -1.0, 1.0))
    return float(np.linalg.norm(a[:3, 3] - b[:3, 3]) + 0.3 * angle)


def read_joints(path: Path, count: int) -> list[tuple[float, ...]]:
    """Joint positions of a tour: a YAML list of lists, each with all joints of the profile, rad.

    Raises:
        CalibrationError: the file cannot be read, or is something else.
    """
    try:
        with path.open("rb") as file:
            data = yaml.safe_load(file.read(MAX_FILE_BYTES))
    except OSError as error:
        raise CalibrationError(f"{path} cannot be read: {error.strerror}") from error
    except (yaml.YAMLError, UnicodeDecodeError, RecursionError) as error:
        raise CalibrationError(f"{path} is not YAML: {error}") from error
    if not isinstance(data, list) or not 0 < len(data) <= MAX_POSES:
        raise CalibrationError(f"{path}: wants a list of 1 to {MAX_POSES} joint positions")
    out: list[tuple[float, ...]] = []
    for number, row in enumerate(data, 1):
        numbers = isinstance(row, list) and all(type(value) in (int, float) for value in row)
        if not numbers or len(row) != count or not np.isfinite(np.array(row, float)).all():
            raise CalibrationError(f"{path}: entry {number} is no list of {count} joints in rad")
        out.append(tuple(float(value) for value in row))
    return out
