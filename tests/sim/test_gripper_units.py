"""A policy that holds a brick keeps it, whatever the units and the polarity of its gripper.

The stand-in answers in its own numbers what it was told of itself in its own numbers: first its
state, then the steps of its last chunk in execution, as a policy with real-time chunking does.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import pytest
from brick_rig import IN_JAW_M, held, hold
from model_wires import groot, lerobot_server, openpi, openvla_rest, xpolicylab
from motions import make_world
from vla_zenoh_benchmarks.lockstep.loop import Lockstep
from vla_zenoh_benchmarks.lockstep.worker import Delays
from vla_zenoh_policy_servers.field_mapping import FieldMapping, read_field_mapping

from vla_zenoh.control.reachability import ReachabilityFilter
from vla_zenoh.policy import ActionSteps, Observation
from vla_zenoh.policy.inference import Committed
from vla_zenoh.policy.meaning import unturned
from vla_zenoh.profile import Profile, load_profile
from vla_zenoh.simulation.world import World, build_world

pytestmark = pytest.mark.long

SO101, PANDA = load_profile("so101_sim"), load_profile("panda_sim")
LATE = Delays(inference_s=0.15, camera_s=0.02)
SO101_OPTIONS = {
    "map": "state=joint_deg+gripper_open, prompt=prompt",
    "action": "joint_position",
    "joint_scale_rad": str(np.pi / 180),
    "gripper": "open_fraction",
    "dt_s": "0.0333333",
    "horizon": "30",
}


class Keeps:
    """Stays where it is, and keeps its gripper at a number of its own.

    Args:
        first: that number, as long as nothing of its own is in execution.
    """

    takes_committed = True

    def __init__(self, mapping: FieldMapping, first: float) -> None:
        self.mapping, self.spec, self._first = mapping, mapping.spec, first
        self.told: list[float] = []
        self.asked: list[dict[str, Any]] = []

    def infer(self, observation: Observation, committed: Committed | None = None) -> ActionSteps:
        request = self.mapping.request(observation)
        self.asked.append(request)
        gripper = self._first
        if committed is not None:
            gripper = self.mapping.semantics.rows(committed.steps)[-1, -1]
        self.told.append(gripper)
        row = [*self._arm(request), gripper]
        return self.mapping.read(np.tile(row, (self.spec.action.horizon, 1)))

    def _arm(self, request: Mapping[str, Any]) -> list[float]:
        """No motion, or the part of the state that is of the actions' kind."""
        action = self.spec.action
        if action.kind == "absolute":
            (state,) = (
                request[name]
                for name, of in self.mapping.states.items()
                if of.names[0] in ("joint", "joint_deg", "position")
            )
            return [*state[: sum(self.mapping.semantics.parts().values()) - 1]]
        if action.space == "joint":
            return [0.0] * action.arm_size
        return [0.0, 0.0, 0.0, *unturned(self.mapping.semantics.rotation)]


def run(profile: Profile, world: World, policy: Keeps, seconds: float) -> None:
    loop = Lockstep(profile, world, policy, delays=LATE, reach=ReachabilityFilter(profile), steps=2)
    loop.put("rate", 5.0)
    loop.put("prompt", "hold it")
    loop.run(0.5)
    assert loop.activate(2.0, 0.1) == ""
    loop.run(seconds)
    assert loop.commander.task.active
    assert len(policy.told) > 3 * seconds


@pytest.mark.parametrize(
    ("ends", "number", "seconds"),
    [
        ("0:100", 5.0, 10.0),
        ("100:0", 95.0, 10.0),
        pytest.param("0:100", 5.0, 60.0, marks=[pytest.mark.long, pytest.mark.timeout(900)]),
    ],
)
def test_an_so_101_in_degrees_and_percent_holds_a_brick(
    ends: str, number: float, seconds: float
) -> None:
    """For a while, with its own chunks told to it in its own units."""
    world = build_world(SO101)
    options = {**SO101_OPTIONS, "gripper_range": ends}
    policy = Keeps(read_field_mapping("so101", {}, "none", options, profile=SO101), number)
    was_m = hold(world, IN_JAW_M, SO101)
    run(SO101, world, policy, seconds)
    held(world, was_m)
    np.testing.assert_allclose(policy.told, number, atol=1e-3)


def test_an_so_101_that_holds_its_jaw_open_by_percent_keeps_it_open() -> None:
    world = build_world(SO101)
    options = {**SO101_OPTIONS, "gripper_range": "0:100"}
    policy = Keeps(read_field_mapping("so101", {}, "none", options, profile=SO101), 70.0)
    run(SO101, world, policy, 5.0)
    assert world.gripper_state().width_m == pytest.approx(0.07, abs=2e-3)
    state = policy.asked[-1]["state"]
    assert state[-1] == pytest.approx(70.0, abs=2.0)
    np.testing.assert_allclose(state[:5], np.rad2deg(SO101.robot.home_rad), atol=1.0)


XPOLICYLAB = {
    "gripper": "open_fraction",
    "gripper_range": "0:1000",
    "dt_s": "0.05",
    "horizon": "16",
    "map": "state/ee_joint_state=gripper_open",
}
PRESETS: Mapping[str, tuple[Any, dict[str, str], float]] = {
    # Its presets, options without a default, and the number by which it shuts the gripper.
    "openpi libero": (openpi.PRESETS, {}, 1.0),
    "openpi droid": (openpi.PRESETS, {}, 1.0),
    "openpi own": (openpi.PRESETS, {}, 0.0),
    "groot libero": (groot.PRESETS, {}, 0.0),
    "groot bridge": (groot.PRESETS, {}, 0.0),
    "openvla_rest bridge": (openvla_rest.PRESETS, {"horizon": "4"}, 0.0),
    "openvla_rest libero": (openvla_rest.PRESETS, {"horizon": "4"}, 0.0),
    "openvla_rest oft_libero": (openvla_rest.PRESETS, {}, 0.0),
    "lerobot_server libero": (lerobot_server.PRESETS, {"horizon": "10"}, 1.0),
    "xpolicylab joint": (
        xpolicylab.PRESETS,
        {
            **XPOLICYLAB,
            "joint_scale_rad": "0.0174533",
            "map": f"state/arm_joint_state=joint, {XPOLICYLAB['map']}",
        },
        10.0,
    ),
    "xpolicylab pose": (xpolicylab.PRESETS, XPOLICYLAB, 10.0),
}


def test_every_preset_with_a_gripper_is_tried() -> None:
    every = {
        f"{name} {preset}"
        for name, model in (
            ("openpi", openpi),
            ("groot", groot),
            ("openvla_rest", openvla_rest),
            ("lerobot_server", lerobot_server),
            ("xpolicylab", xpolicylab),
        )
        for preset in model.PRESETS
    }
    assert set(PRESETS) == every


@pytest.mark.parametrize(
    "seconds", [2.0, pytest.param(60.0, marks=[pytest.mark.slow, pytest.mark.timeout(1800)])]
)
@pytest.mark.parametrize("name", PRESETS)
def test_a_policy_of_every_preset_holds_a_brick(name: str, seconds: float) -> None:
    presets, options, shut = PRESETS[name]
    mapping = read_field_mapping("x", presets, name.split()[1], options, profile=PANDA)
    world, policy = make_world(), Keeps(mapping, shut)
    was_m = hold(world, np.zeros(3), PANDA)
    run(PANDA, world, policy, seconds)
    held(world, was_m)
    np.testing.assert_allclose(policy.told, shut, atol=1e-3)
