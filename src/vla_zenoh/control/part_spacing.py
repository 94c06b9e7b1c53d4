"""Keeps the parts of a robot apart: both stand before the distance between them is too small.

Each tick the joints at which either arm would come to rest are computed, were it to brake one tick
later. No pair of places on the two ways there may be nearer than ``limits.reach.part_stop_m`` and
what the arms may stray from them: so it does not matter which of the two stops first, or whether
one of them stops at all. Otherwise both brake, on ways that the tick before found to be free. Once
they stand they go on when the first bit of the way towards their goals is free, for one arm alone
and for both. Below
``part_slow_m`` arms that come nearer are slowed down to sqrt(distance left / zone) of their speed.

Arms that begin too near to each other may only move apart.

That is computed for the commanded joints. The measured ones are monitored as in `JointMonitor`:
arms that are nearer than the stop by more than `PAST`, and come nearer, have to brake.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence

import numpy as np

from vla_zenoh.control.commanded_part import CommandedPart
from vla_zenoh.control.joint_space import check_ticks, first_bit
from vla_zenoh.control.limits import LimitHit, Slowdown, between, in_steps
from vla_zenoh.control.watchdog import BAND, PAST, PERIOD_NS
from vla_zenoh.kinematics.collision import Nearest, PlacedArm
from vla_zenoh.profile import Profile
from vla_zenoh.types import FloatArray, JointBound

NAME = "part_distance"
"""Of the limit."""
SPACED_M = 0.25
"""Arms this much further apart than they may come are looked at as often as joints alone."""
NOISE_M = 2e-5
"""Distances of the same joints differ by less: without it arms at the stop could not go on."""
LEAST_NEAR_PART = 0.05
"""Least share of the speed near the stop: the arms are held there, and have to come away again."""
STANDS = JointBound(2e-3, 6e-4)
"""Arms whose joints go on by less than this stand."""


class PartSpacing:
    """Distances between all parts of a robot.

    Args:
        profile: where the parts stand, and how near they may come.
        parts: with kinematics.
    """

    def __init__(self, profile: Profile, parts: Sequence[CommandedPart]) -> None:
        self._parts, self._profile = tuple(parts), profile
        limits = [part.profile.limits.reach for part in self._parts]
        self.place()
        self._stop_m = max(limit.part_stop_m for limit in limits)
        self._slow_m = max(limit.part_slow_m for limit in limits)
        self._within_m = max(self._slow_m, self._stop_m) + SPACED_M
        self.nearest = Nearest(self._within_m)
        """Distance of the commanded joints when last computed."""
        self._check_ticks = check_ticks(profile)
        self._skip = 0
        self._held = self._slower = False
        self._reached_m = -np.inf
        """Greatest distance since the arms move, as far as it counts."""
        self._edge_m, self._monitor_ns = np.inf, 0

    def place(self) -> None:
        """Take the shapes of all parts, with what their grippers hold."""
        placed: list[PlacedArm] = []
        stands: list[FloatArray] = []
        for part in self._parts:
            base, reach = self._profile.parts[part.name].base, part.reach
            assert reach is not None
            placed.append(PlacedArm(reach.kinematics, reach.barriers.collisions, base))
            stands.append(STANDS.of(reach.kinematics.slides))
        self._placed, self._stands = placed, stands

    def look(
        self, now_ns: int, ahead_s: float, *, moves: bool
    ) -> tuple[Slowdown | None, LimitHit | None]:
        """Why the parts are slower in the coming tick, and why all of them stand.

        Args:
            now_ns: time of this tick.
            ahead_s: until the next look.
            moves: the arms move to their goals; else they brake or stand.
        """
        if not moves:
            self._held = self._slower = False
            self._skip, self._reached_m = 0, -np.inf
            return None, None
        if self._skip > 0 and not self._held:
            self._skip -= 1
            return None, None
        here = [part.motion.joints_rad for part in self._parts]
        at = [joints_rad for joints_rad in here if joints_rad is not None]
        if len(at) < len(here):
            return None, None
        before, self.nearest = self.nearest, self._nearest(at)
        if self.nearest.distance_m >= self._within_m:  # which fast arms may need for their stops
            self._skip = self._check_ticks - 1
            ahead_s *= self._check_ticks
        spare_m = 2 * max(part.motion.strays_m for part in self._parts)
        floor_m = self._floor_m(self.nearest.distance_m, self._stop_m + spare_m)
        stops = [part.motion.stopping_rad(ahead_s) for part in self._parts]
        ahead = self._nearest(at, floor_m + NOISE_M, stops)
        # A brake that is given up and begun again would end further on.
        stand = all(
            (np.abs(end - here_rad) < stands).all()
            for here_rad, stop, stands in zip(at, stops, self._stands, strict=True)
            for end in stop
        )
        self._held = ahead.distance_m < floor_m or (
            self._held and not (stand and self._may_go_on(at, now_ns, floor_m))
        )
        if self._held:
            near = ahead if ahead.first else self.nearest
            return None, LimitHit(NAME, near.distance_m, self._stop_m, where=str(near))
        return self._slow(before), None

    def _floor_m(self, now_m: float, least_m: float) -> float:
        """The least distance allowed ahead, `least_m` or less, of arms that are `now_m` apart.

        Those that are too near to each other must not come nearer again: were each look compared
        with the one before it, slow arms would pass the stop by `NOISE_M` at a time.
        """
        if now_m < self._reached_m - NOISE_M:  # they came nearer in a brake, by what they lagged
            self._reached_m = now_m
        self._reached_m = max(self._reached_m, min(now_m, least_m))
        return min(least_m, max(now_m, self._reached_m) - NOISE_M)

    def _slow(self, before: Nearest) -> Slowdown | None:
        near = self.nearest
        if near.distance_m >= self._slow_m or self._slow_m <= self._stop_m:
            self._slower = False
            return None
        if near.distance_m < before.distance_m - NOISE_M:
            self._slower = True
        elif near.distance_m > before.distance_m + NOISE_M:
            self._slower = False
        if not self._slower:
            return None
        left = max(near.distance_m - self._stop_m, 0.0) / (self._slow_m - self._stop_m)
        share = in_steps(math.sqrt(left), LEAST_NEAR_PART)
        return Slowdown(NAME, share, near.distance_m, self._slow_m, str(near))

    def _may_go_on(self, at: Sequence[FloatArray], now_ns: int, floor_m: float) -> bool:
        """Whether the first bit of the way to the goals is free."""
        probes: list[list[FloatArray]] = []
        for part, here_rad in zip(self._parts, at, strict=True):
            wanted_rad = part.motion.wanted_rad(now_ns)
            way_rad = np.zeros(len(here_rad)) if wanted_rad is None else wanted_rad - here_rad
            assert part.reach is not None
            probe_rad = here_rad + first_bit(way_rad, part.reach.kinematics)
            probes.append(between(here_rad, probe_rad))
        return self._nearest(at, floor_m + NOISE_M, probes).distance_m >= floor_m

    def _nearest(
        self,
        at: Sequence[FloatArray],
        within_m: float | None = None,
        stops: Sequence[Sequence[FloatArray]] = (),
    ) -> Nearest:
        """The nearest links with each part at its joints (n,) or at any of its `stops`.

        Links further apart than `within_m` are not looked for.
        """
        found = Nearest(self._within_m if within_m is None else within_m)
        places = [
            [here_rad, *stop] for here_rad, stop in itertools.zip_longest(at, stops, fillvalue=())
        ]
        for i, j in itertools.combinations(range(len(places)), 2):
            near = self._placed[i].nearest(places[i], self._placed[j], places[j], found.distance_m)
            if near.distance_m < found.distance_m:
                names = self._parts[i].name, self._parts[j].name
                found = Nearest(
                    near.distance_m, f"{names[0]} {near.first}", f"{names[1]} {near.second}"
                )
        return found

    def monitor(self, now_ns: int) -> LimitHit | None:
        """Check the measured joints of all parts, every `PERIOD_NS`; returns why to brake."""
        late_ns = now_ns - self._monitor_ns
        if -PERIOD_NS <= late_ns < 0:
            return None
        found = [part.measured_rad for part in self._parts]
        measured_rad = [joints_rad for joints_rad in found if joints_rad is not None]
        if len(measured_rad) < len(found):
            return None
        begins = not 0 <= late_ns <= 2 * PERIOD_NS  # the arms did not move, or a clock was set
        self._monitor_ns, within_m = now_ns + PERIOD_NS, self._stop_m - PAST
        near = self._nearest(measured_rad, within_m)
        before_m = near.distance_m if begins else self._edge_m
        self._edge_m = min(max(before_m, near.distance_m), near.distance_m + BAND)
        if near.distance_m >= within_m or self._edge_m >= before_m:
            return None
        return LimitHit(NAME, near.distance_m, self._stop_m, where=str(near))
