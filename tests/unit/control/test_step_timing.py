"""Steps in time: no stop and no rush between them, and one path at every speed."""

from __future__ import annotations

import itertools
import random
from collections import deque
from dataclasses import dataclass, field
from functools import cache

import numpy as np
import pytest
from command_rig import MS, OFTEN, Rig, profile
from hypothesis import given, settings
from hypothesis import strategies as st

from vla_zenoh.control.limits import motion_limits
from vla_zenoh.control.plan_timeline import Goal, Plan
from vla_zenoh.control.step_timing import Arrivals, StepTiming
from vla_zenoh.kinematics.so3 import Pose, norm3
from vla_zenoh.policy.plan_clock import idle_time
from vla_zenoh.types import Cause

RIPPLE = 0.3
"""(max - min) / mean of the commanded speed over the middle of the way; of a model that cannot
answer as often as it is asked, and answers unevenly, `UNEVEN_RIPPLE`."""
UNEVEN_RIPPLE = 0.5
STOP_AND_GO = 1.5
AT_GOAL_M = 1e-6
STEP_M, STEPS = 0.01, 24
SPEED_M_S, ONE_TICK_M = 0.03, 0.03 * 0.012
PICTURE_NS, CAMERA_NS = 33_333_333, 15 * MS
PATH_M = 1e-5
LIMIT = 1 + 1e-6


@dataclass
class Worker:
    """A model that answers in its own time, with steps along z on what it asked for before."""

    rig: Rig
    rate_hz: float
    horizon: int
    dt_s: float
    inference_s: float = 0.14
    jitter: float = 0.3
    seed: int = 0
    done: bool = False
    ends: list[float] = field(default_factory=list)
    """Steps asked for before the last chunk, and after each of its steps."""

    def __post_init__(self) -> None:
        self._random = random.Random(self.seed)
        self._begun_ns = self._due_ns = self._free_ns = self.rig.now_ns
        self._last_ns = self._over_ns = 0.0
        self._on_the_way: deque[tuple[int, int, list[list[float]]]] = deque()

    @property
    def speed(self) -> float:
        return self.rig.commander.task.speed_percent / 100.0

    def tick(self) -> None:
        now_ns, rig = self.rig.now_ns, self.rig
        seen_ns = now_ns - CAMERA_NS
        fresh = (now_ns - self._begun_ns) % PICTURE_NS < rig.period_ns
        if not self.done and fresh and now_ns >= self._due_ns and seen_ns >= self._free_ns:
            self._infer(now_ns, seen_ns)
        chunks = []
        while self._on_the_way and self._on_the_way[0][0] <= now_ns:
            published_ns, observed_ns, steps = self._on_the_way.popleft()
            late_s = (now_ns + rig.period_ns - published_ns) / 1e9
            chunks.append(
                rig.chunk(steps, observation_stamp_ns=observed_ns, published_ago_s=late_s)
            )
        rig.tick(chunks=chunks)

    def _infer(self, now_ns: int, seen_ns: int) -> None:
        begun = self._asked_until(seen_ns)
        if begun >= STEPS - 1e-6:
            self.done = True
            return
        ends = [min(begun + step, STEPS) for step in range(1, self.horizon + 1)]
        self.ends = [begun, ends[0], *(b for a, b in itertools.pairwise(ends) if b > a + 1e-6)]
        ways = np.diff(self.ends) * STEP_M
        steps = [[0.0, 0.0, way, 0.0, 0.0, 0.0, 0.0] for way in ways]
        takes_s = self.inference_s * (1 + self.jitter * self._random.uniform(-1, 1))
        self._free_ns = now_ns + round(takes_s * 1e9)
        self._last_ns = seen_ns + idle_time(seen_ns, self._free_ns, [(0, self._over_ns)])
        self._over_ns = self._last_ns + len(steps) * self.dt_s * 1e9 / self.speed
        self._due_ns = max(self._due_ns + round(1e9 / self.rate_hz / self.speed), self._free_ns)
        self._on_the_way.append((self._free_ns, seen_ns, steps))

    def _asked_until(self, seen_ns: int) -> float:
        if not self.ends:
            return 0.0
        had = (seen_ns - self._last_ns) * self.speed / 1e9 / self.dt_s
        least = 1.0 if len(self.ends) == 2 else 0.0
        return float(np.interp(max(had, least), np.arange(len(self.ends)), self.ends))

    @property
    def arrived(self) -> bool:
        return self.done and not self._on_the_way and self.rig.commander.at_rest


def carried_out(worker: Worker) -> np.ndarray:
    """Speeds (n,) m/s of the stream, from the first chunk until the arm stands."""
    rig = worker.rig
    begun = len(rig.commands)
    for _ in range(30_000):
        worker.tick()
        if worker.arrived:
            break
    assert worker.arrived
    rig.run(0.02)
    return np.array([norm3(command.twist[:3]) for command in rig.commands[begun:]])


def ripple(speeds: np.ndarray) -> float:
    way = np.cumsum(speeds) / speeds.sum()
    middle = speeds[(way > 0.2) & (way < 0.8)]
    return float((middle.max() - middle.min()) / middle.mean())


def ready(rate_hz: float, horizon: int, dt_s: float, **action: str) -> Rig:
    rig = Rig(profile(), horizon=horizon, dt_s=dt_s, **action)
    rig.activate()
    rig.put("rate", rate_hz)
    return rig


@pytest.mark.parametrize(
    ("rate_hz", "horizon", "dt_s", "most"),
    [
        (2.0, 4, 0.1, RIPPLE),
        (5.0, 1, 0.2, RIPPLE),
        (5.0, 4, 0.1, RIPPLE),
        (10.0, 1, 0.1, UNEVEN_RIPPLE),
        (10.0, 8, 0.1, RIPPLE),
    ],
)
def test_between_steps_that_come_in_time_the_arm_neither_stops_nor_rushes(
    rate_hz: float, horizon: int, dt_s: float, most: float
) -> None:
    rig = ready(rate_hz, horizon, dt_s)
    begun_m = rig.position_m
    speeds = carried_out(Worker(rig, rate_hz, horizon, dt_s))
    assert ripple(speeds) < most
    np.testing.assert_allclose(rig.position_m - begun_m, [0, 0, STEPS * STEP_M], atol=AT_GOAL_M)
    rig.assert_smooth()


def test_a_spec_may_ask_for_each_goal_as_soon_as_possible() -> None:
    rig = ready(5.0, 1, 0.2, pace="soonest")
    assert ripple(carried_out(Worker(rig, 5.0, 1, 0.2))) > STOP_AND_GO


def test_a_step_that_nothing_follows_ends_at_its_goal_before_the_watchdog_brakes() -> None:
    rig = ready(1.0, 1, 0.1)
    begun_m = rig.position_m
    rig.send([[0.03, 0.0, 0.0, 0, 0, 0, 0]])
    while rig.state == "active":
        assert not rig.commander.at_rest or rig.position_m[0] > begun_m[0] + 0.03 - AT_GOAL_M
        rig.tick()
    assert rig.state == "holding"
    np.testing.assert_allclose(rig.position_m - begun_m, [0.03, 0.0, 0.0], atol=AT_GOAL_M)


@settings(max_examples=15)
@given(
    st.sampled_from(["delta", "velocity"]),
    st.sampled_from([100.0, 30.0]),
    st.lists(st.integers(2, 24), min_size=30, max_size=30),
)
def test_the_speed_a_model_asks_for_does_not_depend_on_how_often_it_is_asked(
    kind: str, percent: float, ticks: list[int]
) -> None:
    rig = Rig(profile(timing=OFTEN), horizon=8, dt_s=0.1, kind=kind, rotation="rotvec")
    rig.activate()
    rig.put("speed", percent)
    per_step = SPEED_M_S * (1.0 if kind == "velocity" else 0.1)
    begun_m = rig.position_m
    for count in ticks:
        rig.send([[per_step, 0, 0, 0, 0, 0, 0]] * 8)
        rig.run(count * rig.period_ns / 1e9)
    asked_s = (sum(ticks) + len(ticks)) * rig.period_ns / 1e9 * percent / 100.0
    goal_m = rig.commander.parts[0].motion.timeline.at(rig.now_ns).pose.position_m
    np.testing.assert_allclose(goal_m - begun_m, [SPEED_M_S * asked_s, 0, 0], atol=ONE_TICK_M)
    rig.assert_smooth()


# -- the speed override -----------------------------------------------------------------------
def curve() -> list[list[float]]:
    """Steps around a corner and back, of one chunk."""
    ways = [[0.02, 0, 0]] * 4 + [[0, 0.02, 0.005]] * 4 + [[-0.01, 0.01, 0]] * 4
    return [[*way, 0, 0, 0.02, 0] for way in ways]


@cache
def path_at(percent: float) -> np.ndarray:
    """Positions (n, 3) m of the commands that carry the curve out."""
    timing = {"max_open_loop_s": 60.0, "watchdog_s": 5.0, "max_observation_age_s": 10.0, **OFTEN}
    rig = Rig(profile(timing=timing), horizon=12, dt_s=0.1)
    rig.activate()
    rig.put("speed", percent)
    begun = len(rig.commands)
    rig.send(curve())
    rig.run(3.0 * 100.0 / percent)
    assert rig.commander.at_rest
    rig.assert_smooth()
    return np.array([command.position_m for command in rig.commands[begun:]])


def apart_m(path: np.ndarray, other: np.ndarray) -> float:
    """How far the points of one path are from the other, at most."""
    starts, ways = other[:-1], np.diff(other, axis=0)
    worst = 0.0
    for point in path:
        share = ((point - starts) * ways).sum(axis=1) / np.maximum((ways**2).sum(axis=1), 1e-18)
        nearest = starts + np.clip(share, 0, 1)[:, None] * ways
        worst = max(worst, float(np.linalg.norm(point - nearest, axis=1).min()))
    return worst


def test_at_any_speed_the_path_is_the_same() -> None:
    # A tick comes at another place of the path: goals change some millimetres apart at full speed.
    assert apart_m(path_at(40.0)[::2], path_at(100.0)) < 1e-3


@pytest.mark.parametrize(("horizon", "percent"), [(1, 100.0), (4, 50.0)])
def test_at_any_speed_the_steps_add_up_exactly(percent: float, horizon: int) -> None:
    rig = ready(5.0, horizon, 0.2)
    rig.put("speed", percent)
    begun_m = rig.position_m
    speeds = carried_out(Worker(rig, 5.0, horizon, 0.2, inference_s=0.05))
    np.testing.assert_allclose(rig.position_m - begun_m, [0, 0, STEPS * STEP_M], atol=AT_GOAL_M)
    assert speeds.max() < 1.5 * percent / 100 * STEP_M / 0.2


def test_a_lower_speed_is_taken_at_once_and_held() -> None:
    rig = ready(10.0, 16, 0.1)
    for _ in range(12):
        rig.send([[0.05, 0.0, 0.0, 0, 0, 0, 0]] * 16)
        rig.run(0.096)
        rig.send([[-0.05, 0.0, 0.0, 0, 0, 0, 0]] * 16)
        rig.run(0.046)
    rig.put("speed", 10.0)
    rig.run(0.35)
    slow = len(rig.commands)
    for _ in range(10):
        rig.send([[0.0, 0.05, 0.0, 0, 0, 0, 0]] * 16)
        rig.run(0.096)
    limit_m_s = 0.1 * rig.profile.limits.translation.velocity_m_s
    speeds = np.abs([command.twist[:3] for command in rig.commands[slow:]])
    assert speeds.max() <= limit_m_s * (1 + 1e-3)
    rig.assert_smooth()


def test_at_speed_zero_the_arm_stands_and_stays_active_and_goes_on_to_the_same_goal() -> None:
    timing = {"watchdog_s": 5.0, "max_open_loop_s": 60.0, "max_observation_age_s": 5.0}
    rig = Rig(profile(timing=timing), horizon=16, dt_s=0.1)
    rig.activate()
    begun_m = rig.position_m
    rig.send([[0.02, 0.0, 0.0, 0, 0, 0, 0]] * 10)
    rig.run(0.5)
    rig.put("speed", 0.0)
    rig.run(0.5)
    stood_m = rig.position_m
    rig.run(1.0)
    assert rig.state == "active"
    np.testing.assert_array_equal(rig.position_m, stood_m)
    rig.put("speed", 100.0)
    rig.run(2.0)
    np.testing.assert_allclose(rig.position_m - begun_m, [0.2, 0.0, 0.0], atol=AT_GOAL_M)
    rig.assert_smooth()


def test_of_chunks_that_come_evenly_the_next_is_expected_a_period_later_and_hardly_any_spared() -> (
    None
):
    arrivals = Arrivals()
    for number in range(60):
        due_ns, spare_ns = arrivals.arrived(number * 100 * MS, 150 * MS)
    assert due_ns == pytest.approx(60 * 100 * MS, abs=MS)
    assert 0 <= spare_ns < MS


def test_an_arm_that_chunks_reach_evenly_does_not_get_slower_and_slower() -> None:
    timing = StepTiming(motion_limits(profile().limits).box)
    goal = Goal(Pose(np.zeros(3), np.eye(3)), 0.0)
    cause = Cause("scripted", 0, 0, 0, 0, 0, 0, 0)
    way, shares = np.array([0.01, 0, 0, 0, 0, 0]), list[float]()
    for number in range(60):
        now_ns = 10**18 + number * 100 * MS
        plan = Plan(now_ns, now_ns, 50 * MS, [goal] * 4, cause)
        shares.append(timing.share(plan, 0, now_ns, 0.1, 10.0, way, np.zeros(6)))
    assert min(shares[20:]) > 0.999 * max(shares[20:])
    assert max(shares[20:]) < 1.0
