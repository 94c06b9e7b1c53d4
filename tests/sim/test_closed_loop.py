"""The whole loop in lockstep: what a model asks for is what the arm does, and nothing else."""

from __future__ import annotations

import itertools
import re
from dataclasses import dataclass

import numpy as np
import pytest
from motions import make_world
from vla_zenoh_benchmarks.lockstep.loop import Lockstep
from vla_zenoh_benchmarks.lockstep.worker import Delays

from vla_zenoh.kinematics.so3 import Pose, log3, norm3
from vla_zenoh.policy import (
    ActionSpec,
    ActionSteps,
    ModelSpec,
    Observation,
    ObservationSpec,
    Policy,
)
from vla_zenoh.policy.loader import find_model, make_policy
from vla_zenoh.profile import load_profile, override
from vla_zenoh.simulation.impedance import ImpedanceGains
from vla_zenoh.simulation.pace import MAX_STEPS
from vla_zenoh.simulation.world import World
from vla_zenoh.types import PoseReference

REACHED_M, OFF_AXIS_M, DRIFT_RAD = 1e-3, 1e-3, 2e-3
DIRECTION_M = 4e-4
"""Of a way of 0.03 m."""
TURNED_RAD = 2e-3
WITH_FRICTION_M = 2e-3
FRICTION_NM = 0.5
# What makes the simulated arm lose as much as the thesis's did, with its gains.
THESIS_FRICTION_NM = 0.3
THESIS_TOLERANCE_M, THESIS_SIDEWAYS_M, KEPT_M = 0.04, 0.03, 0.45
SETTLE_S = 0.6
LIMIT_RTOL = 1e-6
WIDTH_M = 1e-3
LATE = Delays(inference_s=0.14, jitter=0.3, camera_s=0.03, wire_s=0.001)


@dataclass(slots=True)
class Run:
    """What became of a prompt.

    Args:
        loop: the loop after it.
        moved_m: (3,) displacement of the measured TCP.
        turned_rad: (3,) rotation vector of the measured TCP.
    """

    loop: Lockstep
    moved_m: np.ndarray
    turned_rad: np.ndarray


class Straight:
    """A model for all six directions: ``HARD: +x x14`` is 14 steps of a centimetre along x."""

    def __init__(self) -> None:
        self.spec = ModelSpec(
            name="straight",
            observation=ObservationSpec(prompt=False),
            action=ActionSpec(horizon=1, dt_s=0.1, gripper="none"),
        )
        self.reset()

    def reset(self) -> None:
        self._given = 0

    def infer(self, observation: Observation) -> ActionSteps:
        step = np.zeros((1, 6))
        asked = re.fullmatch(r"HARD: ([+-])([xyz]) x(\d+)", observation.prompt)
        if asked is None:
            return ActionSteps(step)
        if observation.task.active and self._given < int(asked[3]):
            step[0, "xyz".index(asked[2])] = float(f"{asked[1]}0.01")
            self._given += 1
        return ActionSteps(step, self._given >= int(asked[3]))


def begin(
    rate_hz: float,
    world: World,
    delays: Delays | None = None,
    policy: Policy | None = None,
    **options: str,
) -> Lockstep:
    """A loop that is active and holds."""
    loop = Lockstep(
        override(load_profile("panda_sim"), {"task": {"rate_hz": rate_hz}}),
        world,
        policy or make_policy(find_model("scripted"), options),
        delays=delays,
        steps=MAX_STEPS,
    )
    loop.run(0.2 + 1 / rate_hz)
    loop.put("active", True)
    loop.run(0.1)
    assert loop.commander.state.value == "active", loop.commander.why
    return loop


def carry_out(loop: Lockstep, prompt: str, count: int) -> Run:
    """Put a prompt and wait until the arm stands after its last step."""
    position_m, rotation = loop.world.tcp()
    commander = loop.commander
    loop.put("prompt", f"HARD: {prompt} x{count}")
    loop.run(0.01)
    limit_s = 1.3 * count / commander.task.rate_hz + 3.0
    assert loop.run_until(lambda: commander.progress.done, limit_s), loop.refused
    # At a steady pace the last step takes until the next chunk would come.
    loop.run(SETTLE_S + 1.0 / commander.task.rate_hz)
    assert commander.at_rest
    assert commander.state.value in ("active", "holding"), commander.why
    assert not loop.guard_refused
    end_m, end_rotation = loop.world.tcp()
    return Run(loop, end_m - position_m, log3(end_rotation @ rotation.T))


def check_stream(loop: Lockstep) -> None:
    """Limits hold in every command and over every seam between chunks."""
    limits, dt_s = loop.profile.limits, 1 / loop.profile.timing.command_hz
    translation, rotation = (
        list(part.model_dump().values()) for part in (limits.translation, limits.rotation)
    )
    streaming = [command is not None for command in loop.trace.commands]
    # It began once and ended once at most: a pause would hide what happened in it.
    assert len(list(itertools.groupby(streaming))) <= 3
    sent = [command for command in loop.trace.commands if command is not None]
    twist = np.array([command.twist for command in sent])
    acceleration = np.array([command.acceleration for command in sent])
    jerk = np.diff(acceleration, axis=0) / dt_s
    for order, values in enumerate((twist, acceleration, jerk)):
        assert np.abs(values[:, :3]).max() <= translation[order] * (1 + LIMIT_RTOL)
        assert np.linalg.norm(values[:, 3:], axis=1).max() <= rotation[order] * (1 + LIMIT_RTOL)
    # A step in velocity would be one that no acceleration explains.
    explained = (acceleration[:-1] + acceleration[1:]) * (dt_s / 2)
    unexplained = np.abs(np.diff(twist, axis=0) - explained)
    assert unexplained[:, :3].max() <= translation[2] * dt_s**2
    assert unexplained[:, 3:].max() <= rotation[2] * dt_s**2


def check_translation(run: Run, axis: int, way_m: float, tolerance_m: float = REACHED_M) -> None:
    assert run.moved_m[axis] == pytest.approx(way_m, abs=tolerance_m)
    off_axis_m = np.delete(run.moved_m, axis)
    assert norm3(np.append(off_axis_m, 0.0)) < max(OFF_AXIS_M, tolerance_m)


# As below, but by an easier model; every direction is tried at this rate, too.
@pytest.mark.slow
@pytest.mark.parametrize(("rate_hz", "count"), [(1.0, 50), (2.0, 10), (5.0, 50), (10.0, 50)])
def test_steps_up_add_up_to_their_whole_way_at_every_rate(rate_hz: float, count: int) -> None:
    run = carry_out(begin(rate_hz, make_world()), "go up", count)
    check_translation(run, 2, 0.01 * count)
    assert norm3(run.turned_rad) < DRIFT_RAD
    assert run.loop.commander.progress.steps >= count
    check_stream(run.loop)


@pytest.mark.parametrize("count", [8, pytest.param(50, marks=pytest.mark.long)])
def test_steps_up_add_up_to_their_whole_way_with_a_slow_and_unsteady_model(count: int) -> None:
    run = carry_out(begin(5.0, make_world(), LATE), "go up", count)
    check_translation(run, 2, 0.01 * count)
    assert norm3(run.turned_rad) < DRIFT_RAD
    check_stream(run.loop)


def test_chunks_of_many_steps_that_overlap_end_where_they_were_to() -> None:
    run = carry_out(begin(3.0, make_world(), LATE, horizon="8"), "go up", 16)
    check_translation(run, 2, 0.16)
    check_stream(run.loop)


@pytest.mark.long
def test_friction_in_every_joint_costs_no_more_than_two_millimetres() -> None:
    run = carry_out(begin(5.0, make_world(friction_nm=FRICTION_NM)), "go up", 50)
    check_translation(run, 2, 0.5, WITH_FRICTION_M)
    check_stream(run.loop)


def test_a_way_along_every_axis_is_exact_and_moves_nothing_else() -> None:
    loop = begin(10.0, make_world(), policy=Straight())
    for axis, (sign, name) in enumerate(("+x", "-y", "+z")):
        run = carry_out(loop, f"{sign}{name}", 3)
        check_translation(run, axis, float(f"{sign}0.03"), DIRECTION_M)
        assert norm3(run.turned_rad) < DRIFT_RAD
    check_stream(loop)


@pytest.mark.parametrize(
    ("there", "back", "axis", "count"),
    [
        pytest.param("roll right", "roll left", 0, 12, marks=pytest.mark.slow),
        pytest.param("pitch down", "pitch up", 1, 12, marks=pytest.mark.slow),
        ("yaw left", "yaw right", 2, 3),
    ],
)
def test_every_rotation_turns_about_its_own_axis_and_moves_nothing(
    there: str, back: str, axis: int, count: int
) -> None:
    loop = begin(10.0, make_world())
    carry_out(loop, "go up", count)
    for prompt, sign in ((there, 1), (back, -1)):
        run = carry_out(loop, prompt, count)
        expected = np.zeros(3)
        expected[axis] = sign * 0.05 * count
        np.testing.assert_allclose(run.turned_rad, expected, atol=TURNED_RAD)
        assert norm3(run.moved_m) < OFF_AXIS_M
    check_stream(loop)


def test_the_gripper_closes_and_opens() -> None:
    loop = begin(5.0, make_world())
    assert loop.world.gripper_state().width_m == pytest.approx(0.08, abs=WIDTH_M)
    for prompt, count, width_m in (
        ("close gripper", 1, 0.03),
        ("open gripper", 1, 0.08),
        ("close gripper", 2, 0.0),
    ):
        run = carry_out(loop, prompt, count)
        assert loop.world.gripper_state().width_m == pytest.approx(width_m, abs=WIDTH_M)
        assert norm3(run.moved_m) < OFF_AXIS_M


def test_a_run_is_the_same_to_the_bit_when_it_is_repeated() -> None:
    def run() -> tuple[np.ndarray, list[np.ndarray]]:
        loop = begin(10.0, make_world(seed=3), LATE)
        carry_out(loop, "go up", 2)
        return loop.world.qpos(), loop.trace.position_m

    (first, path), (second, again) = run(), run()
    np.testing.assert_array_equal(first, second)
    np.testing.assert_array_equal(path, again)


# -- what all this is for -------------------------------------------------------------------------


def way_without_a_command_node(rate_hz: float, *, on_measured: bool) -> np.ndarray:
    """The way of 50 steps up where each delta goes straight to a soft, frictional arm.

    With `on_measured` a delta is added to where the arm is, as in the thesis, else to the goal
    before.
    """
    soft = ImpedanceGains(
        translational_n_m=150.0,
        rotational_nm_rad=10.0,
        integral_1_s=0.0,
        max_error_m=1.0,
        max_error_rad=3.0,
    )
    world = make_world(soft, friction_nm=THESIS_FRICTION_NM)
    start_m, rotation = world.tcp()
    goal = Pose(start_m, rotation)
    for _ in range(50):
        before = Pose(*world.tcp()) if on_measured else goal
        goal = Pose(before.position_m + [0.0, 0.0, 0.01], before.rotation)
        for _ in range(round(1000 / rate_hz)):
            world.tick(PoseReference(goal.position_m, goal.rotation, np.zeros(6), np.zeros(6)))
    return world.tcp()[0] - start_m


@pytest.mark.parametrize(
    ("rate_hz", "thesis_m"),
    [
        pytest.param(1.0, 0.20, marks=pytest.mark.slow),
        pytest.param(5.0, 0.11, marks=pytest.mark.long),
    ],
)
def test_composing_on_the_measured_pose_fails_as_in_the_thesis(
    rate_hz: float, thesis_m: float
) -> None:
    lost = way_without_a_command_node(rate_hz, on_measured=True)
    assert lost[2] == pytest.approx(thesis_m, abs=THESIS_TOLERANCE_M)
    assert norm3(np.array([*lost[:2], 0.0])) > THESIS_SIDEWAYS_M


@pytest.mark.long
@pytest.mark.parametrize("rate_hz", [pytest.param(1.0, marks=pytest.mark.slow), 5.0])
def test_composing_on_the_goal_keeps_the_way_with_the_same_arm(rate_hz: float) -> None:
    kept = way_without_a_command_node(rate_hz, on_measured=False)
    assert kept[2] > KEPT_M


@pytest.mark.slow
@pytest.mark.parametrize("rate_hz", [1.0, 5.0])
def test_the_command_node_keeps_the_whole_way_with_the_friction_of_the_thesis(
    rate_hz: float,
) -> None:
    loop = begin(rate_hz, make_world(friction_nm=THESIS_FRICTION_NM))
    check_translation(carry_out(loop, "go up", 50), 2, 0.5, WITH_FRICTION_M)
