"""A policy that changes its mind makes the goal jump; told what is under way, it does not."""

from __future__ import annotations

import numpy as np
from motions import make_world
from vla_zenoh_benchmarks.lockstep.loop import Lockstep
from vla_zenoh_benchmarks.lockstep.worker import Delays

from vla_zenoh.policy import ActionSpec, ActionSteps, ModelSpec, Observation, ObservationSpec
from vla_zenoh.policy.inference import Committed
from vla_zenoh.profile import load_profile

HORIZON, DT_S, RATE_HZ = 8, 0.1, 2.5
STEP_M = 0.006
LATE = Delays(inference_s=0.25, camera_s=0.02)
RUN_S = 2.0
ONE_STEP_M = 1.05 * STEP_M
"""What the goal moves by within a chunk, and rounding."""


class Wavering:
    """Wants to pass on the left or on the right, and thinks about it anew at every look."""

    spec = ModelSpec(
        name="wavering",
        observation=ObservationSpec(cameras=(), state=("pose",), prompt=False),
        action=ActionSpec(horizon=HORIZON, dt_s=DT_S, gripper="none"),
    )

    def __init__(self, *, takes_committed: bool) -> None:
        self.takes_committed = takes_committed
        self._random = np.random.default_rng(1)

    def infer(self, observation: Observation, committed: Committed | None = None) -> ActionSteps:
        steps = np.zeros((HORIZON, 6))
        steps[:, 1] = STEP_M * self._random.choice([-1.0, 1.0])
        if committed is not None:
            weights = committed.weights(HORIZON)[:, None]
            steps = weights * committed.padded(HORIZON) + (1 - weights) * steps
        return ActionSteps(steps)


def jumps_m(*, takes_committed: bool) -> np.ndarray:
    """How far the goal moved between two ticks, wherever it moved; not when the first chunk came.

    That one is late like the others, and there is nothing before it that it could go on with.
    """
    loop = Lockstep(
        load_profile("panda_sim"),
        make_world(),
        Wavering(takes_committed=takes_committed),
        delays=LATE,
        steps=4,
    )
    loop.put("rate", RATE_HZ)
    loop.put("prompt", "pass")
    loop.run(0.5)
    loop.put("active", True)
    loop.run(RUN_S)
    goals = [command.goal_position_m for command in loop.trace.commands if command is not None]
    moved = np.linalg.norm(np.diff(goals, axis=0), axis=1)
    return moved[moved > 0][1:]


def test_told_what_is_under_way_a_wavering_policy_never_makes_the_goal_jump() -> None:
    jumps = jumps_m(takes_committed=True)
    assert len(jumps) > RUN_S / DT_S / 2
    assert jumps.max() <= ONE_STEP_M


def test_without_being_told_it_does() -> None:
    assert jumps_m(takes_committed=False).max() > 2 * STEP_M
