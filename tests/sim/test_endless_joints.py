"""An arm with joints that turn without an end, simulated: turns of its wrist one way."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from endless_arm import HOME_RAD, endless_arm
from vla_zenoh_benchmarks.lockstep.loop import Lockstep

from vla_zenoh.control.reachability import ReachabilityFilter
from vla_zenoh.policy import ActionSpec, ActionSteps, ModelSpec, Observation, ObservationSpec
from vla_zenoh.policy.meaning import wrapped
from vla_zenoh.profile import override
from vla_zenoh.simulation.world import build_world
from vla_zenoh.types import FloatArray, JointCommand

HOME = np.array(HOME_RAD)
TURN = 2 * math.pi
STEP_S, HORIZON = 0.1, 8
SPEED_RAD_S = 1.2
QUICK = {
    "task": {"rate_hz": 5},
    "timing": {"command_hz": 50, "state_hz": 50},
    "limits": {
        "joint": {"velocity_rad_s": [2.0] * 6},
        "rotation": {"velocity_rad_s": 2.5},
        "lead_rad": 1.0,
        "step_rad": 0.5,
    },
}


class Turner:
    """A model that turns the flange steadily for a while, once it is obeyed, and what it was told.

    Args:
        joints: names of the arm's.
        duration_s: of the turning.
        **action: fields of its `ActionSpec`.
    """

    def __init__(self, joints: tuple[str, ...], duration_s: float, **action: Any) -> None:
        given = {"gripper": "none", **action}
        if action.get("space") != "tcp":
            given |= {"space": "joint", "joints": joints}
        self.spec = ModelSpec(
            name="turner",
            observation=ObservationSpec(cameras=(), state=("joint",), prompt=False),
            action=ActionSpec(horizon=HORIZON, dt_s=STEP_S, **given),
        )
        self._duration_s, self._since_s = duration_s, math.inf
        self.told: list[FloatArray] = []

    def _way(self, at_s: float) -> float:
        """Angle that it has turned by at a time, rad."""
        return SPEED_RAD_S * min(max(at_s - self._since_s, 0.0), self._duration_s)

    def infer(self, observation: Observation) -> ActionSteps:
        joint, action = observation.joint, self.spec.action
        assert joint is not None
        assert joint.endless == ("joint1", "joint4", "joint6")
        self.told.append(joint.position_rad)
        now_s = observation.stamp_wall_ns / 1e9
        if observation.task.active and self._since_s == math.inf:
            self._since_s = now_s
        angles = np.array([self._way(now_s + n * STEP_S) for n in range(HORIZON + 1)])
        steps = np.zeros((HORIZON, action.dimension))
        if action.kind == "delta":
            # Of the joint, or about the TCP's own x.
            steps[:, 5 if action.joints else 3] = np.diff(angles)
            return ActionSteps(steps)
        rows = HOME + angles[1:, None] * np.eye(6)[5]
        return ActionSteps(wrapped(rows) if action.turns == "wrapped" else rows)


def turned(
    folder: Path, count: float, command: str = "joint", **action: Any
) -> tuple[Turner, Lockstep, float]:
    """The model, the loop, and by how much the simulated flange was turned, `count` turns."""
    profile = override(endless_arm(folder, **QUICK), {"robot": {"command": command}})
    world, reach = build_world(profile), ReachabilityFilter(profile)
    model = Turner(profile.robot.arm_joints, count * TURN / SPEED_RAD_S, **action)
    loop = Lockstep(profile, world, model, reach=reach, steps=2)
    assert loop.activate(1.0, 0.2) == ""
    loop.run(count * TURN / SPEED_RAD_S + 2.0)
    assert loop.commander.task.active, [event.why for event in loop.events]
    assert not loop.guard_refused
    return model, loop, float(world.joint_state().position_rad[5] - HOME[5])


def joint_commands(loop: Lockstep) -> list[JointCommand]:
    return [command for command in loop.trace.joints if command is not None]


@pytest.mark.parametrize(
    ("count", "kind", "turns"),
    [
        pytest.param(10, "delta", "wrapped", marks=pytest.mark.slow),
        (0.6, "absolute", "wrapped"),
        pytest.param(10, "absolute", "wrapped", marks=pytest.mark.slow),
        pytest.param(10, "absolute", "counted", marks=pytest.mark.slow),
    ],
)
def test_turns_of_the_wrist_are_made_without_a_jump(
    tmp_path: Path, count: float, kind: str, turns: str
) -> None:
    model, loop, way_rad = turned(tmp_path, count, kind=kind, turns=turns)
    assert way_rad == pytest.approx(count * TURN, abs=5e-3)
    ways = np.diff([command.position_rad for command in joint_commands(loop)], axis=0)
    assert ways[:, 5].min() > -1e-5
    assert np.abs(ways).max() < 2.0 * 1.001 / 50
    assert np.abs(ways[:, :5]).max() < 1e-4
    told = np.array(model.told)
    if turns == "wrapped":
        assert (told[:, [0, 3, 5]] > -math.pi).all()
        assert (told[:, [0, 3, 5]] <= math.pi).all()
        assert np.sum(np.diff(told[:, 5]) < -math.pi) == math.ceil(count)
    else:
        assert told[-1, 5] == pytest.approx(HOME[5] + count * TURN, abs=5e-3)


@pytest.mark.parametrize("command", [pytest.param("joint", marks=pytest.mark.long), "pose"])
def test_the_tool_is_turned_past_half_a_turn_by_poses(tmp_path: Path, command: str) -> None:
    by_poses = {"kind": "delta", "space": "tcp", "frame": "tcp", "rotation": "rotvec"}
    _, loop, way_rad = turned(tmp_path, 0.6, command, **by_poses)
    assert way_rad == pytest.approx(0.6 * TURN, abs=0.02)
    assert np.abs(loop.world.joint_state().position_rad - HOME)[:5].max() < 0.02
