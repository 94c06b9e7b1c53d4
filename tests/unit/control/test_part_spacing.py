"""Measured arms that come too near to each other brake, whatever happens to the clock."""

from __future__ import annotations

from functools import cache
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from command_rig import Rig

from vla_zenoh.control.commander import Commander
from vla_zenoh.control.joint_space import JointBounds, JointPath
from vla_zenoh.control.limits import LimitHit
from vla_zenoh.control.part_spacing import NAME, PartSpacing
from vla_zenoh.control.plan_timeline import Goal, joint_goal
from vla_zenoh.control.reachability import ReachabilityFilter
from vla_zenoh.control.watchdog import PERIOD_NS
from vla_zenoh.kinematics.so3 import Pose
from vla_zenoh.profile import Profile, load_profile, override
from vla_zenoh.types import FloatArray

NOON_NS = 1_700_000_000_000_000_000
HOUR_NS = 3_600_000_000_000
LEAN = np.array([0.0, 0.5, 0.0, 0.5, 0.0, 0.0, 0.0])
"""From home towards the other arm."""
AT_STOP, STEP = 1.55, 0.01
"""Multiples of that: where the arms are at their stop, and how they come nearer."""
LATE_NS = 1_000_000
"""A look comes with a tick, that is later than a period after the one before."""


@cache
def pair() -> Profile:
    return load_profile("two_pandas_sim")


@cache
def reach() -> ReachabilityFilter:
    return ReachabilityFilter(pair().of_part("left"))


def leaning(share: float) -> FloatArray:
    return np.array(pair().robot.home_rad) + share * LEAN


class Arms:
    """Two arms that are measured where a test says."""

    def __init__(self) -> None:
        self.parts: list[Any] = [
            SimpleNamespace(name=name, profile=pair().of_part(name), reach=reach())
            for name in pair().part_names
        ]
        self.spacing = PartSpacing(pair(), cast("Any", self.parts))

    def come_nearer(self, since_ns: int) -> list[str]:
        """The limits found on the way from the stop to each other."""
        found: list[str] = []
        for number in range(8):
            for part in self.parts:
                part.measured_rad = leaning(AT_STOP + STEP * number)
            hit = self.spacing.monitor(since_ns + number * (PERIOD_NS + LATE_NS))
            found += [] if hit is None else [hit.name]
        return found

    def stand(self, share: float, ahead: float | None = None) -> tuple[float, bool]:
        """Share of the speed of arms that lean so far and are to lean as far as `ahead`.

        And whether they are stopped.
        """
        end = leaning(share if ahead is None else ahead)
        for part in self.parts:
            part.motion = SimpleNamespace(
                joints_rad=leaning(share),
                strays_m=JointPath.strays_m,
                stopping_rad=lambda _: [end],
                wanted_rad=lambda _: leaning(2.0),
            )
        slowdown, hit = self.spacing.look(NOON_NS, 0.004, moves=True)
        return 1.0 if slowdown is None else slowdown.share, hit is not None


@pytest.mark.parametrize("set_by_ns", [0, HOUR_NS, -HOUR_NS], ids=["kept", "forward", "back"])
def test_measured_arms_that_come_too_near_are_found_though_the_clock_was_set(
    set_by_ns: int,
) -> None:
    arms = Arms()
    assert arms.come_nearer(NOON_NS)
    assert arms.come_nearer(NOON_NS + 10**9 + set_by_ns)


def test_measured_arms_are_looked_at_once_a_period() -> None:
    arms = Arms()
    looks: list[int] = []
    nearest = arms.spacing._nearest
    arms.spacing._nearest = lambda *given: (looks.append(1), nearest(*given))[1]  # type: ignore[method-assign]
    for part in arms.parts:
        part.measured_rad = leaning(1.0)
    for late_ns in range(0, 10 * PERIOD_NS, PERIOD_NS // 10):
        arms.spacing.monitor(NOON_NS + late_ns)
    assert len(looks) == 10


@pytest.mark.parametrize("share_s", [2e-3, 2e-2, 0.2])
def test_arms_stand_before_their_stop_however_slowly_they_come_nearer(share_s: float) -> None:
    """Both lean towards each other, by a share of `LEAN` a second, and brake at once."""
    arms, tick_s, share = Arms(), 0.004, 1.54
    for number in range(round(0.015 / share_s / tick_s)):
        ahead = leaning(share + 2 * tick_s * share_s)
        for part in arms.parts:
            part.motion = SimpleNamespace(
                joints_rad=leaning(share),
                strays_m=JointPath.strays_m,
                stopping_rad=lambda _, end=ahead: [end],
                wanted_rad=lambda _: leaning(2.0),
            )
        _, hit = arms.spacing.look(NOON_NS + number, tick_s, moves=True)
        share += 0.0 if hit else tick_s * share_s
    assert arms.spacing.nearest.distance_m > pair().limits.reach.part_stop_m


def test_arms_near_each_other_are_slow_while_they_come_nearer_and_not_as_they_part() -> None:
    """From 0.14 m apart, which is far enough, to 0.08 m and back; their stop is at 0.03 m."""
    arms = Arms()
    on_their_way = [arms.stand(share)[0] for share in (1.2, 1.3, 1.4, 1.3, 1.4, 1.2)]
    assert on_their_way == pytest.approx([1.0, 0.95, 0.75, 1.0, 0.75, 1.0])


def test_arms_that_begin_too_near_to_each_other_may_move_apart_and_no_nearer() -> None:
    assert not Arms().stand(1.57, ahead=1.56)[1]
    assert Arms().stand(1.57, ahead=1.58)[1]


def test_arms_that_stand_before_each_other_say_so_once_each_time() -> None:
    rig, seen = Rig(), list[LimitHit]()
    near = LimitHit(NAME, 0.02, 0.03, where="left hand and right hand")
    rig.commander.spacing = cast(
        "Any",
        SimpleNamespace(
            monitor=lambda _: None, look=lambda *_, moves: (None, seen[0] if seen else None)
        ),
    )
    rig.activate()
    for _ in range(2):
        seen[:] = [near]
        rig.run(0.1)
        seen.clear()
        rig.run(0.1)
    told = [event.why for event in rig.events if event.what == NAME]
    assert told == ["stand at left hand and right hand"] * 2


def test_a_robot_is_at_rest_when_all_its_arms_are() -> None:
    commander = Commander(pair(), reach=dict.fromkeys(pair().part_names, reach()))
    assert commander.at_rest
    for part in commander.parts:
        path = part.motion._poses
        stands = path.motion.pose
        path.go_to(Goal(Pose(stands.position_m + 0.05, stands.rotation), 0.08))
        assert not commander.at_rest
        path.reset(stands)
        assert commander.at_rest


def test_fast_arms_that_brake_gently_stand_before_their_stop() -> None:
    """From 1 m apart towards each other: their stops are longer than they are near then."""
    fast = {
        "translation": {"velocity_m_s": 1.5, "acceleration_m_s2": 4.0},
        "joint": {"velocity_rad_s": 2.0, "acceleration_rad_s2": 1.0},
    }
    of = override(pair().of_part("left"), {"robot": {"command": "joint"}, "limits": fast})
    arms, kinematics = Arms(), reach().kinematics
    paths = [JointPath(of, JointBounds(of, kinematics, reach().barriers)) for _ in arms.parts]
    for part, path in zip(arms.parts, paths, strict=True):
        path.stand(leaning(-1.5))
        goal = joint_goal(kinematics, leaning(2.0), 0.0)
        path.go_to(goal, path.shares(goal))
        part.motion = path
    hit: LimitHit | None = None
    for number in range(1000):
        _, hit = arms.spacing.look(NOON_NS + number, 0.004, moves=True)
        if hit is not None:
            break
        for path in paths:
            path.tick()
    assert hit is not None
    assert hit.where.startswith("left ")
    apart_m = arms.spacing._nearest([path.braked() for path in paths]).distance_m
    assert 0.0 < apart_m - pair().limits.reach.part_stop_m < 0.03
