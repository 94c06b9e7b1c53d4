"""Overlapping chunks in lockstep: every mode, chunk length and latency ends at the same pose."""

from __future__ import annotations

import numpy as np
import pytest
from motions import make_world
from vla_zenoh_benchmarks.lockstep.loop import Lockstep
from vla_zenoh_benchmarks.lockstep.worker import Delays

from vla_zenoh.control.reachability import ReachabilityFilter
from vla_zenoh.kinematics.so3 import log3
from vla_zenoh.policy.loader import find_model, make_policy
from vla_zenoh.profile import Composition, Profile, load_profile
from vla_zenoh.types import FloatArray

pytestmark = pytest.mark.long

REACHED_M, OFF_AXIS_M, TURNED_RAD = 1e-3, 1e-3, 2e-3
DRIFT_M, DRIFT_RAD = 1e-3, 2e-3
LIMIT_RTOL = 1e-6
SETTLE_S = 1.0
STEP_M, STEP_RAD = 0.01, 0.05
SEAM_TICKS = 2
ELBOW_S = 0.6
"""The pull to the posture dies away within its own jerk: all but a hundredth of it in 0.27 s."""
MODES = ("replace", "blend", "ensemble")
DELAYS = {"at once": Delays(), "late": Delays(inference_s=0.14, jitter=0.3, camera_s=0.03)}
JOINT_7_MARGIN_RAD = 0.05
JOINT_RTOL = 1e-3


def changed(mode: str = "replace", command: str = "pose") -> Profile:
    base = load_profile("panda_sim")
    return base.model_copy(
        update={
            "composition": Composition.model_validate({"mode": mode}),
            "robot": base.robot.model_copy(update={"command": command}),
        }
    )


def begin(
    profile: Profile,
    rate_hz: float,
    *,
    horizon: int = 1,
    delays: Delays | None = None,
    bounded: bool = True,
) -> Lockstep:
    """A loop that is active and holds; `bounded` by the arm's kinematics."""
    policy = make_policy(find_model("scripted"), {"horizon": str(horizon)})
    loop = Lockstep(
        profile,
        make_world(),
        policy,
        delays=delays,
        reach=ReachabilityFilter(profile) if bounded else None,
    )
    loop.put("rate", rate_hz)
    loop.run(0.5 + 1 / rate_hz)
    loop.put("active", True)
    loop.run(0.1)
    assert loop.commander.state.value == "active", loop.commander.why
    return loop


def carry_out(loop: Lockstep, prompt: str, count: int) -> tuple[FloatArray, FloatArray]:
    """Put a prompt and wait until the arm stands; (3,) m and (3,) rad that it moved."""
    position_m, rotation = loop.world.tcp()
    loop.put("prompt", f"HARD: {prompt} x{count}")
    loop.run(0.01)
    limit_s = 1.3 * count / loop.commander.task.rate_hz + 3.0
    assert loop.run_until(lambda: loop.commander.progress.done, limit_s), loop.refused
    loop.run(SETTLE_S)
    # The elbow of an arm that is commanded by joints takes its time to its posture.
    assert loop.commander.at_rest or loop.profile.robot.command == "joint"
    assert loop.commander.state.value == "active", loop.commander.why
    assert not loop.guard_refused
    end_m, end_rotation = loop.world.tcp()
    return end_m - position_m, log3(end_rotation @ rotation.T)


def check_seams(loop: Lockstep) -> None:
    """Limits hold in every command, and where chunks meet nothing is rougher than elsewhere."""
    translation = loop.profile.limits.translation
    sent = [command for command in loop.trace.commands if command is not None]
    acceleration = np.array([command.acceleration[:3] for command in sent])
    steps = np.abs(np.diff(acceleration, axis=0)).max(axis=1)
    most = translation.jerk_m_s3 / loop.profile.timing.command_hz
    assert np.abs(acceleration).max() <= translation.acceleration_m_s2 * (1 + LIMIT_RTOL)
    assert steps.max() <= most * (1 + LIMIT_RTOL)
    seqs = np.array([command.cause.chunk_seq if command.cause else 0 for command in sent])
    seam = np.zeros(len(sent), bool)
    for at in np.flatnonzero(np.diff(seqs)):
        seam[at : at + SEAM_TICKS] = True
    assert 5 < seam.sum() < len(sent) / 2
    bumps = np.abs(acceleration).max(axis=1)
    assert bumps[seam].max() <= bumps[~seam].max() * (1 + LIMIT_RTOL)
    assert steps[seam[1:]].max() <= steps[~seam[1:]].max() * (1 + LIMIT_RTOL)


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("horizon", [1, 8, 50])
@pytest.mark.parametrize("late", DELAYS)
def test_every_mode_ends_where_the_steps_end(mode: str, horizon: int, late: str) -> None:
    rate_hz, count = 6.0, 10
    loop = begin(changed(mode), rate_hz, horizon=horizon, delays=DELAYS[late], bounded=False)
    moved_m, turned_rad = carry_out(loop, "go up", count)
    np.testing.assert_allclose(moved_m, [0, 0, count * STEP_M], atol=REACHED_M)
    np.testing.assert_allclose(turned_rad, np.zeros(3), atol=TURNED_RAD)
    assert loop.commander.progress.steps == count
    check_seams(loop)


@pytest.mark.parametrize(
    "horizon",
    [pytest.param(1, marks=pytest.mark.slow), 8, pytest.param(50, marks=pytest.mark.slow)],
)
def test_fifty_steps_are_counted_as_fifty(horizon: int) -> None:
    loop = begin(changed(), 7.0, horizon=horizon, delays=DELAYS["late"])
    moved_m, _ = carry_out(loop, "go up", 50)
    assert loop.commander.progress.steps == 50
    np.testing.assert_allclose(moved_m, [0, 0, 0.5], atol=REACHED_M)


@pytest.mark.slow
@pytest.mark.parametrize("horizon", [1, 50])
def test_a_joint_limit_stops_a_turn_without_drift_and_the_way_back_is_free(horizon: int) -> None:
    loop = begin(changed(), 10.0, horizon=horizon)
    moved_m, turned_rad = carry_out(loop, "yaw right", 60)
    np.testing.assert_allclose(moved_m, np.zeros(3), atol=DRIFT_M)
    np.testing.assert_allclose(turned_rad[:2], np.zeros(2), atol=DRIFT_RAD)
    stopped = [event for event in loop.events if event.what == "joint_limit"]
    assert stopped
    assert {"panda_joint7" in event.why for event in stopped} == {True}
    joint_rad = loop.world.joint_state().position_rad[6]
    upper_rad = loop.world.joint_range_rad[1][6]
    room_rad = upper_rad - joint_rad
    assert JOINT_7_MARGIN_RAD - DRIFT_RAD < room_rad < JOINT_7_MARGIN_RAD + STEP_RAD
    back_m, back_rad = carry_out(loop, "yaw left", 20)
    np.testing.assert_allclose(back_m, np.zeros(3), atol=DRIFT_M)
    np.testing.assert_allclose(back_rad, [0, 0, 20 * STEP_RAD], atol=TURNED_RAD)


def test_joints_carry_out_fifty_steps_and_turns_exactly() -> None:
    loop = begin(changed(command="joint"), 10.0)
    assert loop.guard.kind == "joint"
    moved_m, turned_rad = carry_out(loop, "go up", 50)
    np.testing.assert_allclose(moved_m, [0, 0, 0.5], atol=REACHED_M)
    np.testing.assert_allclose(turned_rad, np.zeros(3), atol=DRIFT_RAD)
    for prompt, axis, sign in (("yaw left", 2, 1), ("roll right", 0, 1), ("pitch up", 1, -1)):
        moved_m, turned_rad = carry_out(loop, prompt, 8)
        expected = np.zeros(3)
        expected[axis] = sign * 8 * STEP_RAD
        np.testing.assert_allclose(turned_rad, expected, atol=TURNED_RAD)
        np.testing.assert_allclose(moved_m, np.zeros(3), atol=OFF_AXIS_M)
    loop.put("active", False)
    assert loop.run_until(lambda: loop.commander.at_rest, ELBOW_S)
    sent = [command for command in loop.trace.joints if command is not None]
    assert sent
    assert not any(loop.trace.commands)
    joint = loop.profile.limits.joint
    velocity = np.array([command.velocity_rad_s for command in sent])
    acceleration = np.array([command.acceleration_rad_s2 for command in sent])
    assert (np.abs(velocity) <= np.array(joint.velocity_rad_s) * (1 + JOINT_RTOL)).all()
    assert (np.abs(acceleration) <= np.array(joint.acceleration_rad_s2) * (1 + JOINT_RTOL)).all()
