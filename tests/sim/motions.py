"""Smooth references for tests of the simulated arm."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
import pinocchio as pin

from vla_zenoh.simulation.impedance import ImpedanceGains
from vla_zenoh.simulation.robot_model import RobotModel
from vla_zenoh.simulation.world import STEP_S, World
from vla_zenoh.types import PoseReference

SCENE = "table"
# TCP at x 0.43, y 0, z 0.16 m, tool straight down; see test_world_home.py.
HOME_RAD = (0.0, -0.0439564754, 0.0, -2.6269994397, 0.0, 2.5830429643, 0.7853981634)


def make_world(
    gains: ImpedanceGains | None = None, friction_nm: float = 0.0, seed: int | None = None
) -> World:
    """The table with a Panda at home."""
    return World(
        SCENE,
        [RobotModel()],
        home_rad=[HOME_RAD],
        gains=gains,
        joint_friction_nm=friction_nm,
        seed=seed,
    )


def still(reference: PoseReference) -> PoseReference:
    """The same pose, at rest."""
    return reference._replace(twist=np.zeros(6), acceleration=np.zeros(6))


def line(start: PoseReference, by_m: Sequence[float], duration_s: float) -> Iterator[PoseReference]:
    """A straight move with a minimum-jerk profile, one reference a tick; ends at rest."""
    way, ticks = np.array(by_m, float), round(duration_s / STEP_S)
    for tick in range(1, ticks + 1):
        s = tick / ticks
        along = 10 * s**3 - 15 * s**4 + 6 * s**5
        speed = (30 * s**2 - 60 * s**3 + 30 * s**4) / duration_s
        acceleration = (60 * s - 180 * s**2 + 120 * s**3) / duration_s**2
        still_turning = np.zeros(3)
        yield PoseReference(
            start.position_m + along * way,
            start.rotation,
            np.concatenate([speed * way, still_turning]),
            np.concatenate([acceleration * way, still_turning]),
        )


def circle(
    start: PoseReference, radius_m: float, swing_rad: float, period_s: float, rounds: float
) -> Iterator[PoseReference]:
    """Rounds in a tilted plane while the tool swings about a slanted axis, from rest to rest.

    The phase follows a minimum-jerk profile, so nothing jumps at either end.
    """
    axis = np.array([1.0, 2.0, 2.0]) / 3.0
    ticks = round(rounds * period_s / STEP_S)
    duration, whole = ticks * STEP_S, 2 * np.pi * rounds
    for tick in range(1, ticks + 1):
        s = tick / ticks
        phase = whole * (10 * s**3 - 15 * s**4 + 6 * s**5)
        rate = whole * (30 * s**2 - 60 * s**3 + 30 * s**4) / duration
        change = whole * (60 * s - 180 * s**2 + 120 * s**3) / duration**2
        c, n = np.cos(phase), np.sin(phase)
        at = radius_m * np.array([c - 1.0, n, 0.5 * (1.0 - c)])
        first = radius_m * np.array([-n, c, 0.5 * n])
        second = radius_m * np.array([-c, -n, 0.5 * c])
        turn, turn_first, turn_second = swing_rad * (1 - c), swing_rad * n, swing_rad * c
        yield PoseReference(
            start.position_m + at,
            pin.exp3(axis * turn) @ start.rotation,
            np.concatenate([first * rate, axis * turn_first * rate]),
            np.concatenate(
                [
                    second * rate**2 + first * change,
                    axis * (turn_second * rate**2 + turn_first * change),
                ]
            ),
        )


def follow(world: World, references: Iterator[PoseReference]) -> tuple[PoseReference, float, float]:
    """Run; give the last reference and the largest errors in metres and radians."""
    reference, worst_m, worst_rad = world.hold_reference(), 0.0, 0.0
    for reference in references:
        world.tick(reference)
        position, rotation = world.tcp()
        worst_m = max(worst_m, float(np.linalg.norm(position - reference.position_m)))
        turn = pin.log3(reference.rotation @ rotation.T)
        worst_rad = max(worst_rad, float(np.linalg.norm(turn)))
    return still(reference), worst_m, worst_rad


def wait(world: World, reference: PoseReference, duration_s: float) -> None:
    """Hold `reference`."""
    for _ in range(round(duration_s / STEP_S)):
        world.tick(reference)
