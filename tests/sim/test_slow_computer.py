"""The simulated arm where the computer is slower than real time: it stays on its commands."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import islice

import numpy as np
import pytest
from motions import circle, make_world

from vla_zenoh.guard.arm_guard import ArmGuard, Measured
from vla_zenoh.kinematics.so3 import Pose, angle_between, quat_from_rotation
from vla_zenoh.profile import load_profile
from vla_zenoh.robots.sim_driver import in_world_time
from vla_zenoh.simulation.pace import CONTROL_STEPS, MAX_STEPS, STEP_NS, Pace
from vla_zenoh.simulation.world import STEP_S, World, build_world
from vla_zenoh.types import Header, PoseCommand, Stamped

COMMAND_NS = 4_000_000
UP_M, DURATION_S = 0.15, 0.8
"""At most 0.35 m/s and 1.3 m/s^2, well within the limits of the profile."""
FOLLOW_LIMIT_M, FOLLOW_LIMIT_RAD = 1e-3, 5e-3
LAG_M = 0.005
"""The arm is nearer to its command than this; ``limits.tracking_m`` is 0.05 m."""


@dataclass
class Rise:
    """A motion up as a command node streams it, as a function of real time."""

    home: Pose

    def at(self, time_s: float) -> PoseCommand:
        s = min(max(time_s / DURATION_S, 0.0), 1.0)
        way = UP_M * (10 * s**3 - 15 * s**4 + 6 * s**5)
        rate = UP_M * (30 * s**2 - 60 * s**3 + 30 * s**4) / DURATION_S
        change = UP_M * (60 * s - 180 * s**2 + 120 * s**3) / DURATION_S**2
        up, quat_xyzw = np.eye(6)[2], quat_from_rotation(self.home.rotation)
        at_m = self.home.position_m + way * up[:3]
        return PoseCommand(at_m, quat_xyzw, rate * up, change * up, at_m, quat_xyzw, "active")


def largest_lag_m(world: World, slowness: float, pauses_ns: dict[int, int]) -> float:
    """Distance of the arm from its command at most, where a step takes `slowness` times as long.

    `pauses_ns`: tick -> how long the process stands still in it.
    """
    profile = load_profile("panda_sim")

    def measure() -> Measured:
        state = world.joint_state()
        return Measured(Pose(*world.tcp()), state.position_rad, state.velocity_rad_s)

    guard = ArmGuard(
        profile, measure, world.joint_range_rad, np.full(7, np.inf), world.slides, 2 * STEP_S
    )
    rise, pace = Rise(Pose(*world.tcp())), Pace(0)
    now_ns, sent_ns, worst_m, seq = 0, 0, 0.0, 0
    while now_ns < 1.5e9:
        tick = pace.next(now_ns)
        now_ns += max(tick.wait_ns, 0)
        while sent_ns <= tick.time_ns:  # as `Arm` takes them
            header = Header(sent_ns, seq, "command#1")
            rejected = guard.offer(Stamped(header, rise.at(sent_ns / 1e9), sent_ns), tick.time_ns)
            assert rejected is None, rejected
            sent_ns, seq = sent_ns + COMMAND_NS, seq + 1
        reference = guard.tick(tick.time_ns, tick.period_s)
        world.tick(in_world_time(reference, tick.stretch, tick.steps), tick.steps)
        wanted_m = rise.at(tick.time_ns / 1e9).position_m
        worst_m = max(worst_m, float(np.linalg.norm(world.tcp()[0] - wanted_m)))
        now_ns += round(tick.steps * STEP_NS * slowness) + pauses_ns.pop(seq, 0)
    return worst_m


@pytest.mark.parametrize("slowness", [1.3, 2.5])
def test_an_arm_stays_on_its_command_where_the_world_is_slower_than_real_time(
    slowness: float,
) -> None:
    assert largest_lag_m(build_world(load_profile("panda_sim")), slowness, {}) < LAG_M


@pytest.mark.parametrize("slowness", [0.3, 1.5])
def test_it_stays_there_through_pauses_of_the_process(slowness: float) -> None:
    pauses_ns = {seq: 40_000_000 for seq in range(20, 200, 30)}
    assert largest_lag_m(build_world(load_profile("panda_sim")), slowness, pauses_ns) < LAG_M


@pytest.mark.parametrize("steps", [CONTROL_STEPS, MAX_STEPS])
def test_an_arm_follows_within_a_millimetre_with_control_computed_every_few_steps(
    steps: int,
) -> None:
    world = make_world()
    worst_m = worst_rad = 0.0
    for reference in islice(
        circle(world.hold_reference(), 0.08, 0.4, 3.0, 1.0), steps - 1, None, steps
    ):
        world.tick(in_world_time(reference, 1.0, steps), steps)
        position_m, rotation = world.tcp()
        worst_m = max(worst_m, float(np.linalg.norm(position_m - reference.position_m)))
        worst_rad = max(worst_rad, angle_between(rotation, reference.rotation))
    assert worst_m < FOLLOW_LIMIT_M
    assert worst_rad < FOLLOW_LIMIT_RAD
