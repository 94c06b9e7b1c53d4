"""Axes that are told targets in motion: where their plans go, and how far beyond a target."""

from __future__ import annotations

import random
from copy import copy

import numpy as np
import pytest

from vla_zenoh.control.axis_smoothing import AxisSmoother
from vla_zenoh.control.limits import Shares
from vla_zenoh.types import FloatArray

DT_S = 0.004
BOX = (0.5, 2.0, 20.0)
"""m/s, m/s^2, m/s^3 of every axis."""
FAR_M, RANGE_M = 0.05, 0.1
ROUNDING_M = 2e-6
TURN_M = {1.0: 1e-4, 0.1: 1e-3}
"""Beyond where it would have turned on its way, by how fast it may be when it is told again."""
MOST_TICKS = 30_000
SPEEDS = (1.0, 0.5, 0.1, 0.01)


def axes(count: int, within: float | None = None) -> AxisSmoother:
    box = np.array([[limit] * count for limit in BOX])
    ends = None if within is None else (np.full(count, -within), np.full(count, within))
    return AxisSmoother(np.zeros(count), DT_S, box, within=ends)


def at_speed(speed: float, velocity: float = 1.0) -> Shares:
    """As the speed override gives them, and less velocity."""
    return Shares(speed * velocity, speed**2, speed**3)


def retargeted(rng: random.Random, motion: AxisSmoother, speed: float, many: int) -> None:
    """Told some targets on the way to each other."""
    for _ in range(many):
        motion.move_to(place(rng, motion), at_speed(speed))
        for _ in range(rng.randint(1, int(60 / speed))):
            motion.advance(1.0)


def place(rng: random.Random, motion: AxisSmoother) -> FloatArray:
    return np.array([rng.uniform(-FAR_M, FAR_M) for _ in motion.state.position])


def bounds(motion: AxisSmoother) -> tuple[FloatArray, FloatArray]:
    """Least and greatest positions until it rests."""
    alone, places = copy(motion), [motion.state.position]
    while alone.advance(1.0):
        places.append(alone.state.position)
    return np.min(places, axis=0), np.max(places, axis=0)


@pytest.mark.parametrize("first", range(0, 400, 50))
def test_a_plan_knows_the_least_and_greatest_positions_on_its_way(first: int) -> None:
    for seed in range(first, first + 50):
        rng = random.Random(seed)
        motion = axes(rng.choice([1, 3]))
        retargeted(rng, motion, rng.choice(SPEEDS[:3]), 2)
        # Of odd seeds it has to slow down first.
        motion.move_to(place(rng, motion), at_speed(0.3 if seed % 2 else 1.0))
        plan = motion._plan  # pyright: ignore[reportPrivateUsage]
        assert plan is not None
        low, high = plan.extrema()
        times_s = np.linspace(0.0, plan.duration_s, 200)
        places = np.array([plan.at(float(time_s)).position for time_s in times_s])
        assert (low - ROUNDING_M <= places.min(axis=0)).all()
        assert (places.max(axis=0) <= high + ROUNDING_M).all()


@pytest.mark.parametrize("seed", [114, 365, 854, 943, 1281, 1379])
@pytest.mark.parametrize("velocity", TURN_M)
def test_a_motion_that_is_told_its_target_again_goes_no_further(seed: int, velocity: float) -> None:
    """Some axes were planned with more jerk than their share; so they stop in time."""
    rng = random.Random(seed)
    speed = rng.choice(SPEEDS)
    motion = axes(rng.choice([1, 3]))
    retargeted(rng, motion, speed, rng.randint(1, 4))
    target = place(rng, motion)
    motion.move_to(target, at_speed(speed))
    low, high = bounds(motion)
    again = rng.randint(1, 60)
    beyond_m = 0.0
    for tick in range(MOST_TICKS):
        if tick % int(again / speed) == 0:
            motion.move_to(target, at_speed(speed, velocity))
        if not motion.advance(1.0):
            break
        here = motion.state.position
        beyond_m = max(beyond_m, float(np.maximum(low - here, here - high).max()))
    assert beyond_m <= TURN_M[velocity]


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_fast_axis_that_gets_less_acceleration_stops_before_either_end_of_its_range(
    sign: float,
) -> None:
    motion = axes(1, within=2 * RANGE_M)
    motion.move_to(np.array([sign * 2 * RANGE_M]))
    for _ in range(70):
        motion.advance(1.0)
    motion.move_to(np.array([sign * 1.5 * RANGE_M]), Shares(0.5, 0.2, 0.2))
    while motion.advance(1.0):
        assert abs(motion.state.position[0]) <= 2 * RANGE_M + ROUNDING_M
    assert motion.state.position[0] == pytest.approx(sign * 1.5 * RANGE_M)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_an_axis_outside_its_range_comes_in_within_its_share_of_the_limits(sign: float) -> None:
    motion, share = axes(1, within=RANGE_M), 0.3
    motion.stand(np.array([sign * 2 * RANGE_M]))
    motion.move_to(np.zeros(1), Shares(share, share, share))
    while motion.advance(1.0):
        for most, value in zip(BOX, motion.state[1:], strict=False):
            assert abs(value[0]) <= share * most * (1 + 1e-6)
    assert motion.state.position[0] == pytest.approx(0.0)


@pytest.mark.parametrize("all_to_stop", [True, False])
def test_a_motion_tells_whether_its_shares_suffice_to_stop_at_its_target(all_to_stop: bool) -> None:
    for target_m, enough in ((0.3, True), (0.1, False)):
        motion = axes(1)
        assert motion.move_to(np.array([1.0]))
        for _ in range(100):
            motion.advance(1.0)
        target = motion.state.position + target_m
        assert motion.move_to(target, Shares(1.0, 0.5, 0.5), all_to_stop=all_to_stop) == enough


def test_halfway_to_rest_is_ahead_of_a_stop_that_is_nearly_over() -> None:
    motion = axes(1)
    motion.move_to(np.array([1.0]))
    for _ in range(100):
        motion.advance(1.0)
    (end_m,) = motion.braked()
    while motion.state.velocity[0] > 0.1 * BOX[0]:
        motion.advance(1.0)
    assert motion.state.position[0] < motion.halfway_to_rest()[0] < end_m


def test_axes_stay_in_their_range_whatever_they_are_told_on_their_way() -> None:
    for seed in range(800, 840):
        rng = random.Random(seed)
        speed = rng.choice(SPEEDS[:3])
        motion = axes(rng.choice([1, 3]), within=RANGE_M)
        for _ in range(rng.randint(2, 8)):
            target = 2 * place(rng, motion)
            motion.move_to(target, at_speed(speed, rng.choice([1.0, 0.3])))
            for _ in range(rng.randint(1, int(60 / speed))):
                motion.advance(1.0)
                assert np.abs(motion.state.position).max() <= RANGE_M + ROUNDING_M


def test_a_motion_about_to_start_does_not_rest_and_one_stopped_before_its_target_does() -> None:
    motion = axes(1)
    motion.move_to(np.array([1.0]))
    assert not motion.at_rest
    for _ in range(100):
        motion.advance(1.0)
    motion.brake()
    assert not motion.at_rest
    while motion.advance(1.0):
        pass
    assert motion.at_rest
