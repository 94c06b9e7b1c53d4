"""Depth, wrench, effort and a history in lockstep: as a worker on the bus would give them."""

from __future__ import annotations

from typing import Any

import numpy as np
from vla_zenoh_benchmarks.lockstep.loop import Lockstep
from vla_zenoh_benchmarks.lockstep.worker import Delays

from vla_zenoh.policy import (
    ActionSpec,
    CameraSpec,
    DepthSpec,
    ModelSpec,
    Observation,
    ObservationSpec,
)
from vla_zenoh.profile import load_profile, override
from vla_zenoh.simulation.world import build_world

SPACING_NS, RATE_HZ = 100_000_000, 5.0
HALF_A_FRAME_NS = 17_000_000


class Looker:
    def __init__(self, **fields: Any) -> None:
        looks = ObservationSpec(
            cameras=(CameraSpec(camera="front"),),
            depth=(DepthSpec(camera="front", unit_m=0.0005),),
            state=("pose", "wrench", "effort"),
            prompt=False,
            history=3,
            history_spacing_s=0.1,
            **fields,
        )
        action = ActionSpec(horizon=1, dt_s=0.1, gripper="none")
        self.spec = ModelSpec(name="looker", observation=looks, action=action)
        self.seen: list[Observation] = []

    def infer(self, observation: Observation) -> list[list[float]]:
        self.seen.append(observation)
        return [[0.0] * 6]


def watch(model: Looker, seconds: float) -> Lockstep:
    profile = override(load_profile("panda_sim"), {"cameras": {"front": {"depth_unit_m": 0.001}}})
    loop = Lockstep(profile, build_world(profile), model, delays=Delays(inference_s=0.15), steps=4)
    loop.put("rate", RATE_HZ)
    loop.run(seconds)
    return loop


def before_ns(seen: Observation) -> list[int]:
    return [seen.stamp_wall_ns - each.stamp_wall_ns for each in seen.history]


def test_a_history_has_its_spacing_and_begins_with_a_repeated_observation() -> None:
    model = Looker()
    loop = watch(model, 1.5)
    assert before_ns(model.seen[0]) == [0, 0]
    for seen in model.seen[3:]:
        two, one = before_ns(seen)
        assert abs(two - 2 * SPACING_NS) <= HALF_A_FRAME_NS
        assert abs(one - SPACING_NS) <= HALF_A_FRAME_NS
    loop.put("active", True)
    loop.run(0.5)
    assert loop.commander.state.value == "active", loop.commander.why
    episodes = [seen.task.episode for seen in model.seen]
    first = episodes.index(episodes[-1])
    assert episodes[0] != episodes[-1]
    start = model.seen[first]
    assert max(before_ns(start)) < SPACING_NS, "nothing of the episode before"


def test_who_waits_is_asked_first_when_there_are_n() -> None:
    model = Looker(history_start="wait")
    watch(model, 1.0)
    assert model.seen
    two, _ = before_ns(model.seen[0])
    assert abs(two - 2 * SPACING_NS) <= HALF_A_FRAME_NS


def test_depth_wrench_and_efforts_come_with_every_observation() -> None:
    model = Looker()
    watch(model, 1.0)
    for each in (model.seen[-1], *model.seen[-1].history):
        assert each.depth["front"].dtype == np.uint16
        assert np.median(each.depth["front"]) == 1000  # a row of it is noise
        assert each.wrench is not None
        assert each.wrench.shape == (6,)
        assert each.effort_nm is not None
        assert np.abs(each.effort_nm).max() > 1.0, "the arm carries its own weight"
        assert each.joint is None
