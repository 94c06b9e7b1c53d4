"""The command node's mind: what it does with chunks, settings, losses, and what never happens."""

from __future__ import annotations

import itertools
import math
import random
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from command_rig import (
    MS,
    OFTEN,
    OTHER,
    SOURCE,
    START_M,
    WORKER,
    Rig,
    model_spec,
    profile,
    quat_of,
    reach_of,
)

from vla_zenoh.control.axis_smoothing import AxisSmoother
from vla_zenoh.control.commander import ANSWER_S, MAX_ANSWER_S, Commander, Inputs, Setting
from vla_zenoh.control.limits import BEGIN_JOINT, BEGIN_M
from vla_zenoh.control.motion_pipeline import LINGER_NS
from vla_zenoh.keys import OPENING
from vla_zenoh.kinematics.so3 import norm3
from vla_zenoh.profile import load_profile, override
from vla_zenoh.types import GripperState, HeldBox, PoseState, Stamped

UP = [0.0, 0.0, 0.01, 0.0, 0.0, 0.0, 0.0]
FORTH = [0.02, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]
STAND = [0.0] * 7
DOWN_FAST = [0.0, 0.0, -0.03, 0.0, 0.0, 0.0, 0.0]
BOX = HeldBox((0.1, 0.1, 0.6))
STEP_M = 0.01
AT_GOAL_M, AT_GOAL_RAD = 1e-6, 1e-6
BRAKE_S = 0.4


def moving_rig(**kwargs: object) -> Rig:
    """Active and in the middle of a move along x at some 0.3 m/s."""
    rig = Rig(**kwargs)  # pyright: ignore[reportArgumentType]
    rig.activate()
    for _ in range(6):
        rig.send([[0.03, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]])
        rig.run(0.096)
    assert norm3(rig.commands[-1].twist[:3]) > 0.2
    return rig


# -- before and after activation ------------------------------------------------------------------


def test_before_activation_nothing_is_streamed_and_chunks_are_only_looked_at() -> None:
    rig = Rig()
    for _ in range(50):
        assert rig.send([UP]).pose is None
    assert rig.state == "inactive"
    assert rig.refused == {}
    tracking = rig.commander.parts[0].tracking
    assert (tracking.apart_m, tracking.apart_rad) == (0.0, 0.0), "there is no command to follow"


def test_activation_is_refused_with_every_reason_as_an_event() -> None:
    rig = Rig()
    rig.peers = replace(rig.peers, alive=frozenset())
    rig.put("active", True)
    assert rig.state == "inactive"
    rejections = [event for event in rig.events if event.kind == "refusal"]
    assert len(rejections) >= 3
    assert {event.what for event in rejections} == {"activate_refused"}
    assert rig.refused["activate_refused"] == len(rejections)


def test_an_activation_while_only_something_starts_is_rejected_as_a_notice() -> None:
    rig = Rig()
    rig.tick(chunks=[rig.chunk([STAND])])
    there = rig.peers
    rig.peers = replace(there, camera_ages_s={}, camera_reasons={"front": OPENING})
    starting = rig.tick(Setting("active", True))
    rig.peers = replace(there, alive=there.alive - {"camera"})
    gone = rig.tick(Setting("active", True))
    levels = [(event.what, event.level) for event in rig.events if event.kind == "refusal"]
    assert levels == [("activate_refused", "info"), ("activate_refused", "warning")]
    assert [each.quiet for out in (starting, gone) for each in out.rejections] == [True, False]


def test_activation_begins_where_the_robot_holds_and_does_not_move_it() -> None:
    rig = Rig()
    rig.activate()
    rig.run(0.5)
    assert len(rig.commands) > 0.4 * rig.profile.timing.command_hz
    for command in rig.commands:
        np.testing.assert_allclose(command.position_m, START_M, atol=1e-12)
    assert rig.widths_m == []


def test_a_chunk_observed_before_the_activation_is_refused_in_silence() -> None:
    rig = Rig()
    rig.activate()
    rig.events.clear()
    rig.send([UP], observed_ago_s=0.1)
    assert rig.refused == {"before_activation": 1}
    assert rig.events == []


def test_a_dry_run_computes_everything_and_streams_nothing() -> None:
    rig = Rig(dry_run=True)
    rig.activate()
    for _ in range(5):
        out = rig.send([[*UP[:6], -0.03]])
        assert out.accepted is not None
        rig.run(0.2)
    assert rig.commander.progress.steps == 5
    assert rig.commander.parts[0].motion.goal is not None
    np.testing.assert_allclose(
        rig.commander.parts[0].motion.goal.pose.position_m, START_M + [0, 0, 0.05]
    )
    assert rig.commands == []
    assert rig.widths_m == []


# -- composing ------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("rate_hz", "latency_s"),
    [(2, 0.0), (2, 0.14), (5, 0.3), (10, 0.14), (20, 0.05), (20, 0.3)],
)
def test_steps_are_neither_lost_nor_counted_twice_whatever_rate_latency_and_jitter(
    rate_hz: int, latency_s: float
) -> None:
    jitter = random.Random(rate_hz)
    rig = Rig(profile(timing={"watchdog_s": 2.0}))
    rig.activate()
    given, due_s, steps = 0.0, 0.0, 8
    began_ns = rig.now_ns
    for _ in range(steps):
        # The observation is later than the last publication; the chunk comes after the latency.
        while (rig.now_ns - began_ns) / 1e9 < due_s:
            rig.tick()
        observed_ns = rig.now_ns + rig.period_ns
        wait_s = latency_s * jitter.uniform(0.7, 1.3)
        rig.run(wait_s)
        ago_s = (rig.now_ns + rig.period_ns - observed_ns) / 1e9
        out = rig.send([UP], observed_ago_s=ago_s)
        assert out.accepted is not None, rig.refused
        due_s = max(due_s + 1 / rate_hz, (rig.now_ns - began_ns) / 1e9)
        given += STEP_M
    rig.settle()
    np.testing.assert_allclose(rig.moved_m(), [0, 0, given], atol=AT_GOAL_M)
    assert norm3(rig.turned_rad()) < AT_GOAL_RAD
    rig.assert_smooth()


def test_of_a_chunk_that_lasts_too_long_only_the_beginning_is_followed() -> None:
    rig = Rig(profile(timing={"max_open_loop_s": 0.5}), horizon=50, dt_s=0.1)
    rig.activate()
    out = rig.send([UP] * 50, done=True)
    assert out.accepted is not None
    (event,) = [event for event in rig.events if event.what == "open_loop"]
    assert (event.value, event.limit) == (pytest.approx(5.0), 0.5)
    rig.run(3.0)
    rig.settle()
    np.testing.assert_allclose(rig.moved_m(), [0, 0, 5 * STEP_M], atol=AT_GOAL_M)
    assert not rig.commander.progress.done
    assert rig.state == "holding"


def test_a_single_step_that_takes_too_long_does_not_keep_the_watchdog_waiting() -> None:
    rig = Rig(profile(timing={"max_open_loop_s": 0.5}), dt_s=60.0)
    rig.activate()
    assert rig.send([UP]).accepted is not None
    rig.run(1.5)
    assert rig.state == "holding"


def test_an_arm_that_holds_for_long_needs_activation_again() -> None:
    rig = Rig(profile(timing={"max_hold_s": 2.0}))
    rig.activate()
    rig.send([UP])
    rig.run(2.0)
    assert rig.state == "holding"
    rig.peers = replace(rig.peers, worker_complaints={WORKER: "contract: steps hold NaN"})
    rig.run(1.0)
    assert rig.state == "inactive"
    assert "held for 2 s" in rig.commander.why
    assert f"worker {WORKER!r} reports: contract: steps hold NaN" in rig.commander.why
    rig.send([UP])
    assert rig.state == "inactive"
    np.testing.assert_allclose(rig.moved_m(), [0, 0, STEP_M], atol=AT_GOAL_M)


def test_by_default_an_arm_that_held_for_10_s_does_not_move_by_itself() -> None:
    rig = Rig()
    rig.activate()
    rig.send([UP])
    rig.run(9.0)
    assert rig.state == "holding"
    rig.run(3.0)
    assert rig.state == "inactive"


def test_a_chunk_whose_observation_does_not_show_the_last_chunk_replaces_it() -> None:
    rig = Rig()
    rig.activate()
    rig.run(0.1)
    rig.send([UP])
    rig.run(0.04)
    rig.send([UP], observed_ago_s=0.05)  # taken just before the first one was published
    rig.settle()
    np.testing.assert_allclose(rig.moved_m(), [0, 0, STEP_M], atol=AT_GOAL_M)


def test_a_chunk_counts_from_its_publication_however_long_it_was_on_its_way() -> None:
    rig = Rig()
    rig.activate()
    rig.run(0.2)
    rig.send([UP], observed_ago_s=0.15, published_ago_s=0.1)
    rig.run(0.02)
    rig.send([UP], observed_ago_s=0.08)  # later than the first one's publication: on top of it
    rig.settle()
    np.testing.assert_allclose(rig.moved_m(), [0, 0, 2 * STEP_M], atol=AT_GOAL_M)


def test_a_chunk_published_before_it_was_observed_counts_from_its_observation() -> None:
    rig = Rig()
    rig.activate()
    rig.run(0.2)
    rig.send([UP], observed_ago_s=0.15)
    rig.run(0.1)
    rig.send([UP], observed_ago_s=0.05, published_ago_s=10.0)
    rig.run(0.02)
    rig.send([UP], observed_ago_s=0.01)
    rig.settle()
    np.testing.assert_allclose(rig.moved_m(), [0, 0, 3 * STEP_M], atol=AT_GOAL_M)


def test_steps_whose_time_has_passed_while_another_chunk_ran_are_skipped_and_no_way_is_lost() -> (
    None
):
    rig = Rig()
    rig.activate()
    rig.run(0.4)
    rig.send([UP] * 8)
    rig.run(0.346)
    out = rig.send([UP] * 8, observed_ago_s=0.34)
    assert out.pose is not None
    # 20 ms of the first chunk and four steps of the second.
    np.testing.assert_allclose(out.pose.goal_position_m, START_M + [0, 0, 0.042])
    rig.settle()
    np.testing.assert_allclose(rig.moved_m(), [0, 0, 0.082], atol=AT_GOAL_M)
    rig.assert_smooth()


@pytest.mark.parametrize("late_s", [0.0, 0.35])
@pytest.mark.parametrize("earlier", [0, 2])
def test_an_arm_that_stands_begins_a_late_chunk_at_its_first_step(
    late_s: float, earlier: int
) -> None:
    rig = Rig()
    rig.activate()
    if earlier:
        rig.send([UP] * earlier)
    rig.run(0.6)
    out = rig.send([UP] * 8, observed_ago_s=late_s)
    assert out.pose is not None
    np.testing.assert_allclose(out.pose.goal_position_m, START_M + [0, 0, 0.01 * (earlier + 1)])
    rig.settle()
    np.testing.assert_allclose(rig.moved_m(), [0, 0, 0.01 * (earlier + 8)], atol=AT_GOAL_M)
    rig.assert_smooth()


@pytest.mark.parametrize("published_ago_s", [-10.0, 0.0])
def test_a_chunk_that_lies_about_its_publication_begins_when_it_arrives(
    published_ago_s: float,
) -> None:
    rig = Rig()
    rig.activate()
    rig.run(0.4)
    rig.send([UP] * 8, observed_ago_s=0.3, published_ago_s=published_ago_s)
    rig.run(0.25)
    goal = rig.commander.parts[0].motion.goal
    assert goal is not None
    np.testing.assert_allclose(goal.pose.position_m, START_M + [0, 0, 0.03])


@pytest.mark.parametrize("period_s", [0.1, 0.28, 0.52])
def test_overlapping_chunks_give_the_speed_that_was_asked_for(period_s: float) -> None:
    rig = Rig()
    rig.activate()
    asked_s = 2.08
    for _ in range(round(asked_s / period_s)):
        rig.send([UP] * 10)
        rig.run(period_s - rig.period_ns / 1e9)
    goal = rig.commander.parts[0].motion.goal
    assert goal is not None
    spent_s = round(asked_s / period_s) * period_s
    # The goal in force leads what was asked until now by a step at most.
    asked_m = spent_s / 0.1 * STEP_M
    lead_m = goal.pose.position_m[2] - START_M[2] - asked_m
    assert -AT_GOAL_M <= lead_m <= STEP_M + AT_GOAL_M


@pytest.mark.parametrize("cuts", [[12], [1] * 12, [5, 1, 6]])
def test_the_same_steps_in_any_split_of_chunks_end_at_the_same_pose(cuts: list[int]) -> None:
    step = [0.004, -0.003, 0.005, 0.02, -0.03, 0.04, 0.0]
    rig = Rig()
    rig.activate()
    for count in cuts:
        rig.send([step] * count)
        rig.run(0.1 * count - 0.004)
    rig.settle()
    np.testing.assert_allclose(rig.moved_m(), [0.048, -0.036, 0.06], atol=AT_GOAL_M)
    np.testing.assert_allclose(rig.turned_rad(), [0.24, -0.36, 0.48], atol=AT_GOAL_RAD)
    rig.assert_smooth()


def test_absolute_steps_go_to_the_pose_they_name() -> None:
    rig = Rig(kind="absolute", rotation="quaternion", gripper="absolute_m")
    goal = [0.45, 0.02, 0.32, *quat_of([0.0, 0.0, 0.1]), 0.04]
    rig.tick(chunks=[rig.chunk([goal])])
    rig.put("active", True)
    for _ in range(3):
        rig.send([goal])
        rig.run(0.1)
    rig.settle()
    np.testing.assert_allclose(rig.position_m, goal[:3], atol=AT_GOAL_M)
    np.testing.assert_allclose(rig.turned_rad(), [0, 0, 0.1], atol=AT_GOAL_RAD)
    assert rig.widths_m == pytest.approx([0.04])


# -- bounds ---------------------------------------------------------------------------------------


def test_a_step_over_its_limit_is_shortened_and_told() -> None:
    rig = Rig()
    rig.activate()
    rig.send([[0.08, 0, 0, 0, 0, 0, 0]])
    (event,) = [event for event in rig.events if event.kind == "limit"]
    assert (event.what, event.limit) == ("step_m", rig.profile.limits.step_m)
    assert event.value == pytest.approx(0.08)
    rig.settle()
    np.testing.assert_allclose(rig.moved_m(), [rig.profile.limits.step_m, 0, 0], atol=AT_GOAL_M)


def test_a_step_far_over_its_limit_refuses_the_whole_chunk() -> None:
    rig = Rig()
    rig.activate()
    out = rig.send([UP, [10.0, 0, 0, 0, 0, 0, 0]])
    assert out.accepted is None
    assert rig.refused == {"step_m": 1}
    assert any("is its unit right?" in event.why for event in rig.events)
    rig.run(0.5)
    np.testing.assert_allclose(rig.moved_m(), np.zeros(3), atol=AT_GOAL_M)


def test_a_profile_that_says_refuse_drops_what_would_be_shortened() -> None:
    rig = Rig(profile(limits={"out_of_bounds": "refuse"}))
    rig.activate()
    rig.send([UP, [0.08, 0, 0, 0, 0, 0, 0]])
    assert rig.refused == {"step_m": 1}


def test_a_gripper_number_of_another_meaning_is_refused() -> None:
    rig = Rig()
    rig.activate()
    rig.send([[0, 0, 0, 0, 0, 0, 1.0]])
    assert rig.refused == {"meaning": 1}


def test_the_goal_stops_at_the_border_of_the_workspace() -> None:
    rig = Rig()
    rig.activate()
    for _ in range(9):
        rig.send([[0.05, 0, 0, 0, 0, 0, 0]])
        rig.run(0.196)
    rig.settle()
    assert rig.position_m[0] == pytest.approx(rig.profile.limits.workspace.x_m[1], abs=AT_GOAL_M)
    assert max(command.position_m[0] for command in rig.commands) <= 0.75 + AT_GOAL_M
    rig.assert_smooth()


def test_the_leash_keeps_a_backlog_from_building_up_and_what_was_cut_does_not_come_back() -> None:
    rig = Rig(profile(limits={"lead_m": 0.06}))
    rig.activate()
    for _ in range(10):
        rig.send([[0.0, 0.04, 0.0, 0, 0, 0, 0]])
        rig.run(0.02)
    goal = rig.commander.parts[0].motion.goal
    assert goal is not None
    ahead_m = norm3(goal.pose.position_m - rig.position_m)
    assert ahead_m <= 0.06 + 1e-9
    assert any(event.what == "lead_m" and event.why == "leash" for event in rig.events)
    end_m = goal.pose.position_m
    rig.settle()
    np.testing.assert_allclose(rig.position_m, end_m, atol=AT_GOAL_M)


# -- silence, stop, loss --------------------------------------------------------------------------


def test_without_fresh_chunks_it_brakes_holds_and_goes_on_with_the_next_one() -> None:
    rig = moving_rig(of=profile(limits={"lead_m": 0.5}), horizon=1)
    watchdog_s = rig.profile.timing.watchdog_s
    began_ns = rig.now_ns
    while rig.state == "active" and rig.now_ns < began_ns + 3 * 10**9:
        rig.tick()
    waited_s = (rig.now_ns - began_ns) / 1e9
    assert watchdog_s < waited_s < watchdog_s + 1 / rig.commander.task.rate_hz + 0.1 + 0.01
    rig.run(1.0)
    assert rig.commander.at_rest
    assert rig.state == "holding"
    at_m = rig.position_m[0]
    rig.send([FORTH])
    assert rig.state == "active"
    rig.run(1.5)
    assert rig.commander.at_rest
    assert rig.position_m[0] == pytest.approx(at_m + 0.02, abs=1e-4)
    assert rig.transitions[-3:-1] == ["active->holding", "holding->active"]
    rig.assert_smooth()


@pytest.mark.parametrize("order", ["deactivate", "stop", "lose"])
def test_whatever_ends_a_move_brakes_it_within_the_limits_and_nothing_pulls_it_on(
    order: str,
) -> None:
    rig = moving_rig()
    if order == "deactivate":
        rig.put("active", False)
    elif order == "stop":
        rig.tick("stop")
    else:
        rig.put("lose", "the loop stood still")
    at_m, speed = rig.position_m[0], rig.commands[-1].twist[0]
    rig.run(1.0)
    assert rig.commander.at_rest
    limits = rig.profile.limits.translation
    ramp_s = limits.acceleration_m_s2 / limits.jerk_m_s3
    longest_m = speed**2 / (2 * limits.acceleration_m_s2) + speed * 2 * ramp_s
    assert 0 < rig.position_m[0] - at_m < longest_m
    assert min(command.twist[0] for command in rig.commands[-200:]) > -1e-9
    rig.assert_smooth()


def test_the_stream_ends_a_while_after_the_arm_stands() -> None:
    rig = Rig()
    rig.activate()
    rig.put("active", False)
    began_ns = rig.now_ns
    while rig.tick().pose is not None:
        assert rig.now_ns < began_ns + 2 * LINGER_NS
    assert rig.now_ns - began_ns == pytest.approx(LINGER_NS, abs=10 * MS)
    assert not rig.commander.streaming


def test_the_stream_of_an_arm_at_rest_ends_though_the_clock_was_set_back() -> None:
    rig = Rig()
    rig.activate()
    rig.put("active", False)
    assert rig.commander.streaming
    rig.now_ns -= 3600 * 10**9
    rig.run(2 * LINGER_NS / 1e9)
    assert not rig.commander.streaming


def robot_away_from_its_last_command(rig: Rig, away_m: float) -> Stamped[PoseState]:
    """A state of a robot whose controller's set-point is this far above the stream's."""
    pose = Rig.pose_state(rig)
    held_m = rig.commands[-1].position_m + [0.0, 0.0, away_m]
    record = replace(pose.record, reference_position_m=held_m)
    return Stamped(pose.header, record, pose.received_ns)


def test_a_robot_that_swings_past_its_last_command_is_not_activated_before_it_stands() -> None:
    rig = moving_rig()
    rig.put("active", False)
    while not rig.commander.at_rest:
        rig.tick()
    rig.tick(chunks=[rig.chunk([[0.0] * 7])])
    for away_m in (0.012, 0.008, 0.004, 0.001):
        rig.pose_state = lambda away_m=away_m: robot_away_from_its_last_command(rig, away_m)
        rig.tick()
    rig.pose_state = lambda: robot_away_from_its_last_command(rig, -0.004)
    rig.put("active", True)
    assert rig.state == "inactive"
    assert "the robot is still 0.004 m" in rig.commander.why
    rig.assert_smooth()


def test_a_robot_whose_joints_swing_past_their_last_command_is_not_activated_then() -> None:
    of = override(load_profile("panda_sim"), {"robot": {"command": "joint"}})
    reach = reach_of(of)
    kinematics = reach.kinematics
    rig = Rig(of, reach=reach)
    rig.stand_at(kinematics, np.array(of.robot.home_rad))
    rig.activate()
    rig.put("active", False)
    out = rig.tick(chunks=[rig.chunk([[0.0] * 7])])
    assert out.joint is not None
    for away_rad in (0.012, 0.01, 0.008):  # the first joint turns, the TCP is not seen to move
        rig.joints_rad = out.joint.position_rad + away_rad * np.eye(7)[0]
        rig.tick()
    rig.put("active", True)
    assert rig.state == "inactive"
    assert "its joints 0.008 rad" in rig.commander.why
    rig.run(0.15)
    out = rig.put("active", True)
    assert rig.state == "active"
    assert out.joint is not None
    np.testing.assert_allclose(out.joint.position_rad, rig.joints_rad, atol=BEGIN_JOINT.turns)


def test_a_repeated_state_does_not_show_that_the_robot_stands() -> None:
    rig = moving_rig()
    rig.put("active", False)
    while not rig.commander.at_rest:
        rig.tick()
    rig.tick(chunks=[rig.chunk([[0.0] * 7])])
    repeated = robot_away_from_its_last_command(rig, 0.01)
    rig.pose_state = lambda: repeated
    rig.run(0.15)
    rig.put("active", True)
    assert rig.state == "inactive"
    assert "the robot is still 0.010 m" in rig.commander.why
    rig.pose_state = lambda: robot_away_from_its_last_command(rig, 0.01)
    rig.run(0.15)
    rig.put("active", True)
    assert rig.state == "active"


def test_a_stop_is_latched_until_it_is_reset() -> None:
    rig = moving_rig()
    rig.tick("stop")
    for name, value in (("active", True), ("active", False), ("prompt", "x"), ("rate", 2.0)):
        rig.put(name, value)
        rig.send([UP])
        assert rig.state == "stopped"
    assert rig.refused["activate_refused"] == 1
    rig.tick("reset")
    assert rig.state == "inactive"
    rig.activate()
    rig.assert_smooth()


@pytest.mark.parametrize(
    "settings",
    [
        ["stop", "reset", Setting("active", True)],
        ["reset", Setting("active", True), "stop"],
        [Setting("active", True), "stop", "reset"],
    ],
)
@pytest.mark.parametrize("before", ["inactive", "active", "stopped"])
def test_a_stop_beats_whatever_else_is_put_in_the_same_tick(
    settings: list[Setting | str], before: str
) -> None:
    rig = Rig()
    rig.tick(chunks=[rig.chunk([STAND])])
    if before == "active":
        rig.put("active", True)
    if before == "stopped":
        rig.tick("stop")
    rig.tick(*settings)
    assert rig.state == "stopped"
    assert rig.refused["reset_refused"] == 1


@pytest.mark.parametrize("first", ["command", "robot", "both", "robot alone"])
def test_a_stop_has_the_same_reason_whichever_node_tells_of_it_first(first: str) -> None:
    rig = moving_rig()
    settings = ["stop"] if first in ("command", "both") else []
    if first != "command":
        rig.gripper = replace(rig.gripper, mode="latched")
    rig.tick(*settings)
    told = rig.state, rig.commander.why
    rig.gripper = replace(rig.gripper, mode="latched")
    rig.tick(*([] if first == "robot alone" else ["stop"]))
    rig.run(0.1)
    assert told == (rig.state, rig.commander.why) == ("stopped", "emergency stop")
    stops = [event.why for event in rig.events if event.what == "active->stopped"]
    assert stops == ["emergency stop"]


def test_a_robot_that_still_says_so_does_not_stop_an_arm_again_after_a_reset() -> None:
    rig = Rig()
    rig.gripper = replace(rig.gripper, mode="latched")
    rig.tick()
    assert rig.state == "stopped"
    rig.put("reset")
    rig.run(0.05)
    assert rig.state == "inactive"


def test_an_arm_that_starves_on_a_busy_computer_says_so() -> None:
    rig = Rig()
    rig.activate()
    rig.tick(ticks=30)
    while rig.state == "active":
        rig.tick()
    assert "this computer is too busy" in rig.commander.why


def test_what_is_refused_after_a_stop_does_not_replace_its_reason() -> None:
    rig = moving_rig()
    rig.tick("stop")
    rig.put("active", True)
    assert rig.refused["activate_refused"] == 1
    assert (rig.state, rig.commander.why) == ("stopped", "emergency stop")


def test_a_stop_and_a_chunk_in_one_tick_is_a_stop() -> None:
    rig = moving_rig()
    out = rig.tick("stop", chunks=[rig.chunk([UP])])
    assert rig.state == "stopped"
    assert out.accepted is None


def test_a_fault_of_the_robot_is_latched_while_it_lasts_and_until_reset() -> None:
    rig = moving_rig()
    rig.gripper = replace(rig.gripper, faults=("joint 4 is too hot",))
    rig.tick()
    assert rig.state == "fault"
    rig.tick("reset")
    assert rig.state == "fault"
    assert any("still reports: joint 4" in event.why for event in rig.events)
    rig.gripper = replace(rig.gripper, faults=())
    rig.run(1.0)
    assert rig.state == "fault"
    rig.tick("reset")
    assert rig.state == "inactive"
    rig.assert_smooth()


def test_a_robot_that_leaves_its_ready_mode_ends_the_activation() -> None:
    rig = moving_rig()
    rig.gripper = replace(rig.gripper, mode="guiding")
    rig.tick()
    assert rig.state == "inactive"
    assert "not ready but 'guiding'" in rig.commander.why


def test_a_robot_that_is_back_is_activated_where_it_is_now_and_not_where_the_last_one_was() -> None:
    rig = moving_rig()
    whole = rig.peers
    rig.peers = replace(whole, alive=whole.alive - {"sim"})
    rig.tick()
    rig.run(1.5)
    elsewhere_m = rig.position_m = START_M + [0.0, 0.05, 0.0]
    rig.blocked = rig.silent = True
    rig.peers = whole
    rig.tick(Setting("active", True), chunks=[rig.chunk([STAND])])
    assert rig.state == "inactive"
    assert {event.why for event in rig.events if event.what == "activate_refused"} == {
        "the TCP pose is not known: nothing received on state/pose",
        "the gripper is not known: nothing received on state/gripper",
        "the last activation ended: node 'sim' is gone",
    }
    rig.silent, rig.reference = False, None
    rig.activate()
    rig.tick()
    np.testing.assert_allclose(rig.commands[-1].position_m, elsewhere_m, atol=1e-12)


@pytest.mark.parametrize("node", ["sim", "camera", "worker-scripted"])
def test_a_node_that_is_gone_ends_the_activation_and_coming_back_does_not_renew_it(
    node: str,
) -> None:
    rig = moving_rig()
    whole = rig.peers
    rig.peers = replace(whole, alive=whole.alive - {node})
    rig.tick()
    assert rig.state == "inactive"
    assert node in rig.commander.why
    rig.peers = whole
    rig.run(1.0)
    assert rig.state == "inactive"
    rig.assert_smooth()
    rig.activate()


def test_a_camera_that_lies_ends_the_activation_by_name() -> None:
    rig = moving_rig()
    frozen = {"front": "shows the same picture since 1.2 s"}
    rig.peers = replace(rig.peers, camera_faults=frozen)
    rig.tick()
    assert rig.state == "inactive"
    assert rig.commander.why == "camera 'front' shows the same picture since 1.2 s"
    rig.peers = replace(rig.peers, camera_faults={})
    rig.run(1.0)
    assert rig.state == "inactive"
    rig.assert_smooth()
    rig.activate()


@pytest.mark.parametrize("other", ["camera", "camera-2"])
def test_a_camera_of_ros_2_is_gone_with_the_node_that_serves_it(other: str) -> None:
    """What that node said of the camera is forgotten with it; another camera node lives on."""
    front = {"front": profile().cameras["front"].model_copy(update={"source": "ros2:/front"})}
    rig = Rig(profile().model_copy(update={"cameras": front}))
    there = rig.peers
    alive = (there.alive - {"camera"}) | {"ros2", other}
    rig.peers = replace(there, alive=alive, same_host=alive, camera_nodes={"front": "ros2"})
    rig.activate()
    rig.peers = replace(rig.peers, alive=alive - {"ros2"}, camera_nodes={}, camera_ages_s={})
    rig.tick()
    assert rig.state == "inactive"
    assert rig.commander.why == "node 'ros2' is gone"


def test_a_camera_that_the_model_does_not_use_may_lie() -> None:
    rig = moving_rig()
    rig.peers = replace(rig.peers, camera_faults={"wrist": "is black"})
    rig.tick()
    assert rig.state == "active"


def test_a_node_that_is_not_needed_may_go() -> None:
    rig = moving_rig()
    rig.peers = replace(rig.peers, alive=rig.peers.alive - {f"worker-{OTHER}"})
    rig.tick()
    assert rig.state == "active"


def test_a_worker_that_was_started_anew_has_to_be_activated_anew() -> None:
    rig = moving_rig()
    rig.peers = replace(rig.peers, spec_sources={WORKER: "worker-scripted-2"})
    rig.tick()
    assert rig.state == "inactive"
    assert "was restarted" in rig.commander.why
    rig.put("active", True)
    assert rig.state == "inactive"  # its chunks of before do not count
    rig.activate()


def test_robot_state_that_falls_silent_ends_the_activation() -> None:
    rig = moving_rig(of=profile(timing=OFTEN))
    rig.silent = True
    began_ns = rig.now_ns
    while rig.state == "active":
        rig.tick()
    waited_s = (rig.now_ns - began_ns) / 1e9
    assert waited_s == pytest.approx(rig.profile.timing.state_timeout_s, abs=0.01)
    assert "robot state lost" in rig.commander.why
    rig.run(1.0)
    rig.silent = False
    rig.run(0.1)
    assert rig.state == "inactive"
    rig.assert_smooth()


def test_robot_state_that_comes_late_ends_the_activation() -> None:
    rig = moving_rig()
    late = rig.pose_state()
    header = replace(late.header, stamp_wall_ns=rig.now_ns - 10**9)
    inputs = Inputs(pose=replace(late, header=header), gripper=rig.gripper_state())
    rig.commander.step(inputs, rig.now_ns)
    assert rig.state == "inactive"
    assert "comes late" in rig.commander.why


def test_a_gripper_that_falls_silent_ends_the_activation() -> None:
    rig = moving_rig()
    for _ in range(50):
        rig.now_ns += rig.period_ns
        rig.commander.step(Inputs(pose=rig.pose_state(), peers=rig.peers), rig.now_ns)
    assert rig.state == "inactive"
    assert "robot state lost: gripper" in rig.commander.why


def test_a_blocked_arm_ends_the_activation() -> None:
    rig = moving_rig()
    rig.blocked = True
    for _ in range(20):
        rig.send([[0.04, 0, 0, 0, 0, 0, 0]])
        rig.run(0.096)
        if rig.state != "active":
            break
    assert rig.state == "inactive"
    assert "is it blocked?" in rig.commander.why
    last_m = rig.commands[-1].position_m
    limits = rig.profile.limits
    assert norm3(last_m - rig.position_m) < limits.tracking_m + 0.1
    rig.assert_smooth()


def test_why_an_arm_stopped_by_itself_is_said_when_it_is_activated_again() -> None:
    rig = moving_rig()
    rig.blocked = True
    while rig.state == "active":
        rig.send([[0.04, 0, 0, 0, 0, 0, 0]])
        rig.run(0.096)
    ended = f"the last activation ended: {rig.commander.why}"
    rig.blocked = False
    rig.run(2.0)
    rig.peers = replace(rig.peers, alive=rig.peers.alive - {"camera"})
    told = rig.put("active", True).events
    assert [event.why for event in told][-1] == ended
    assert ended in rig.commander.why  # in status, too, until something is different
    rig.peers = replace(rig.peers, alive=rig.peers.alive | {"camera"})
    rig.activate()
    assert ended in rig.commander.why
    rig.put("active", False)  # this time a person ended it
    rig.run(2.0)
    rig.activate()
    assert "ended" not in rig.commander.why


def stuck_rig() -> Rig:
    """Just stopped, because the joints cannot follow."""
    changes = {"robot": {"command": "joint", "posture": "home"}, "timing": {"command_hz": 100}}
    of = override(load_profile("panda_sim"), changes)
    reach, rng = reach_of(of), np.random.default_rng(0)
    kinematics = reach.kinematics
    rig = Rig(of, reach=reach)
    rig.stand_at(kinematics, np.array(of.robot.home_rad))
    rig.activate()
    step = rng.normal(size=6)
    for _ in range(60):
        step = step + 0.5 * rng.normal(size=6)
        way = np.clip(step, -1, 1) * [0.03, 0.03, 0.03, 0.15, 0.15, 0.15]
        rig.send([[*way, 0.0]] * 8)
        for _ in range(20):
            out = rig.tick()
            if out.joint is not None:
                rig.stand_at(kinematics, out.joint.position_rad)
            if rig.state != "active":
                return rig
    raise AssertionError("the joints follow")


def test_an_arm_whose_joints_cannot_follow_stops_and_can_be_activated_while_it_is_paused() -> None:
    rig = stuck_rig()
    why = "the joints cannot follow the pose: it has waited for them for 0.5 s; they are held by"
    assert rig.state == "inactive"
    assert f"{why} joint_limit panda_joint5" in rig.commander.why
    assert why in [event for event in rig.events if event.kind == "transition"][-1].why
    rig.put("speed", 0.0)
    while rig.state != "active":
        assert rig.commander.streaming, rig.commander.why
        rig.put("active", True)
    assert f"the last activation ended: {why}" in rig.commander.why
    rig.run(0.1)
    assert rig.state == "active", rig.commander.why


@pytest.mark.parametrize(("name", "value"), [("prompt", "go down"), ("worker", OTHER)])
def test_why_an_arm_stopped_before_it_was_told_something_else_is_not_said(
    name: str, value: str
) -> None:
    rig = moving_rig()
    rig.peers = replace(rig.peers, alive=rig.peers.alive - {"camera"})
    rig.run(2.0)
    rig.put(name, value)
    assert all(
        "the last activation ended" not in event.why for event in rig.put("active", True).events
    )
    assert rig.state == "inactive"


def test_an_arm_activated_again_while_blocked_is_led_back_to_where_it_is() -> None:
    rig = moving_rig()
    rig.blocked = True
    while rig.state == "active":
        rig.send([[0.04, 0, 0, 0, 0, 0, 0]])
        rig.run(0.096)
    rig.put("stop")  # it is not led back before
    rig.run(2.0)
    assert norm3(rig.commands[-1].position_m - rig.position_m) > rig.profile.limits.tracking_m
    rig.put("reset")
    rig.activate()
    rig.run(1.0)
    assert rig.state == "active", rig.commander.why
    np.testing.assert_allclose(rig.commands[-1].position_m, rig.position_m, atol=1e-6)
    rig.assert_smooth()
    # From here on it is guarded as ever.
    for _ in range(6):
        rig.send([[0.04, 0, 0, 0, 0, 0, 0]])
        rig.run(0.096)
    assert rig.state == "inactive"


# -- who is obeyed --------------------------------------------------------------------------------


@pytest.mark.parametrize("source", ["worker-scripted-9", "", "x" * 128])
def test_a_source_that_did_not_publish_the_workers_spec_is_never_obeyed(source: str) -> None:
    rig = Rig()
    rig.tick(chunks=[rig.chunk([STAND], source=source)])
    rig.put("active", True)
    assert rig.state == "inactive"  # it cannot get the lease
    rig.activate()
    rig.send([UP], source=source, seq=10**6)
    assert rig.refused["foreign"] == 2
    assert rig.send([UP]).accepted is not None
    rig.settle()
    np.testing.assert_allclose(rig.moved_m(), [0, 0, STEP_M], atol=AT_GOAL_M)


def test_a_worker_without_a_spec_is_not_obeyed() -> None:
    rig = Rig()
    rig.tick(chunks=[rig.chunk([STAND], worker="ghost", source="ghost-1")])
    assert rig.refused == {"unknown_worker": 1}


def test_a_worker_without_the_lease_runs_in_the_shadow() -> None:
    rig = Rig()
    rig.activate()
    out = rig.send([UP], worker=OTHER)
    assert out.accepted is None
    assert rig.refused == {}
    rig.run(0.3)
    np.testing.assert_allclose(rig.moved_m(), np.zeros(3), atol=1e-12)


def test_a_chunk_that_comes_again_is_refused() -> None:
    rig = Rig()
    rig.activate()
    rig.run(0.1)
    chunk = rig.chunk([UP])
    assert rig.tick(chunks=[chunk]).accepted is not None
    assert rig.tick(chunks=[chunk]).accepted is None
    assert rig.refused == {"replayed": 1}
    rig.settle()
    np.testing.assert_allclose(rig.moved_m(), [0, 0, STEP_M], atol=AT_GOAL_M)


def test_chunks_of_another_spec_than_agreed_are_refused() -> None:
    rig = Rig()
    rig.activate()
    changed = model_spec(dt_s=0.2)
    rig.peers = replace(rig.peers, specs={WORKER: changed})
    rig.send([UP], spec_hash=changed.hash)
    assert rig.refused == {"spec_mismatch": 1}


# -- settings in motion ---------------------------------------------------------------------------


def test_a_new_prompt_in_motion_supersedes_chunks_under_way_without_a_jump() -> None:
    rig = moving_rig()
    episode = rig.commander.task.episode
    out = rig.put("prompt", "HARD: go down")
    assert out.task_changed
    assert rig.commander.task.prompt == "HARD: go down"
    assert rig.commander.task.episode > episode
    rig.send([FORTH], episode=episode)
    assert rig.refused == {"superseded": 1}
    assert rig.send([FORTH]).accepted is not None
    rig.settle()
    rig.assert_smooth()


@pytest.mark.parametrize(("name", "values"), [("prompt", "ab"), ("worker", [OTHER, WORKER])])
@pytest.mark.parametrize("velocity_m_s", [0.5, 0.01])
def test_the_plan_of_an_old_prompt_or_worker_runs_out_within_its_time_and_no_further(
    name: str, values: Sequence[str], velocity_m_s: float
) -> None:
    """However often another one is put, and however late the arm is."""
    limits = profile().limits
    slow = limits.translation.model_copy(update={"velocity_m_s": velocity_m_s})
    rig = Rig(profile(limits={"translation": slow}))
    rig.send([STAND], worker=OTHER)
    rig.activate()
    rig.send([[0.02, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]] * 16)
    timing, heard_ns = rig.profile.timing, rig.now_ns
    for value in itertools.islice(itertools.cycle(values), 40):
        rig.put(name, value)
        rig.run(0.096)
        moves_on = np.abs(rig.commands[-1].twist).max() > 1e-6
        late_s = (rig.now_ns - heard_ns) / 1e9 - timing.max_open_loop_s - timing.watchdog_s
        assert not moves_on or late_s < BRAKE_S
    assert rig.moved_m()[0] <= 16 * 0.02 + AT_GOAL_M
    rig.assert_smooth()


def test_no_episode_has_the_number_of_one_before_also_after_a_restart_or_a_clock_set_back() -> None:
    rig, numbers = Rig(), [0]
    for prompt, back_s in (("a", 0), ("b", 3600), ("c", 0)):
        rig.now_ns -= back_s * 10**9
        rig.put("prompt", prompt)
        numbers.append(rig.commander.task.episode)
    assert sorted(set(numbers)) == numbers
    restarted = Rig()
    restarted.now_ns += 4 * 10**9
    restarted.put("prompt", "a")
    assert restarted.commander.task.episode > numbers[-1]


def test_chunks_that_were_held_up_while_the_arm_stood_replace_each_other() -> None:
    rig = Rig(profile(timing={"max_observation_age_s": 2.0}))
    rig.activate()
    while rig.state == "active":
        rig.tick()
    rig.run(0.5)
    for ago_s in (0.4, 0.25):
        rig.send([UP] * 4, observed_ago_s=ago_s, published_ago_s=ago_s - 0.02)
    assert rig.state == "active"
    goal_m = rig.commands[-1].goal_position_m
    np.testing.assert_allclose(goal_m, START_M + UP[:3], atol=AT_GOAL_M)
    rig.settle()
    np.testing.assert_allclose(rig.moved_m(), 4 * np.array(UP[:3]), atol=AT_GOAL_M)


def test_after_a_pause_the_rest_of_a_chunk_that_has_become_old_is_dropped() -> None:
    rig = Rig(profile(timing={"max_observation_age_s": 1.0}))
    rig.activate()
    rig.send([UP] * 16)
    rig.run(0.3)
    rig.put("speed", 0.0)
    rig.run(1.5)
    stood_m = rig.position_m.copy()
    rig.put("speed", 100.0)
    rig.run(1.0)
    np.testing.assert_allclose(rig.position_m, stood_m, atol=AT_GOAL_M)
    assert "paused" in {event.what for event in rig.events}


def test_the_chunk_that_an_arm_was_activated_with_is_none_of_its_motion() -> None:
    rig = Rig()
    chunk = rig.chunk([UP], seq=7)
    rig.tick(chunks=[chunk])
    rig.put("active", True)
    rig.tick(
        chunks=[replace(chunk, record=replace(chunk.record, episode=rig.commander.task.episode))]
    )
    assert rig.refused == {"replayed": 1}
    assert rig.send([UP], seq=8).accepted is not None


def test_another_speed_drops_nothing_of_a_plan_that_runs() -> None:
    rig = Rig(profile(timing={"max_observation_age_s": 0.5}))
    rig.activate()
    rig.send([UP] * 10)
    rig.run(0.7)
    rig.put("speed", 80.0)
    rig.settle(2.0)
    np.testing.assert_allclose(rig.moved_m(), 10 * np.array(UP[:3]), atol=AT_GOAL_M)


def test_the_same_prompt_again_is_no_new_episode() -> None:
    rig = moving_rig()
    task = rig.commander.task
    assert not rig.put("prompt", task.prompt).task_changed


def test_the_lease_passes_to_another_worker_in_motion_without_a_jump() -> None:
    rig = moving_rig()
    rig.send([STAND], worker=OTHER)
    rig.put("worker", OTHER)
    assert rig.state == "active"
    assert rig.commander.task.worker == OTHER
    rig.run(0.1)
    assert rig.send([FORTH]).accepted is None  # of the worker before
    assert rig.send([UP], worker=OTHER).accepted is not None
    rig.settle()
    rig.assert_smooth()


def test_the_lease_does_not_pass_to_a_worker_that_is_not_fit() -> None:
    rig = moving_rig()
    rig.put("worker", "ghost")
    assert rig.commander.task.worker == WORKER
    assert rig.refused["worker_refused"] >= 1
    assert rig.send([FORTH]).accepted is not None


def test_while_inactive_any_worker_may_be_named() -> None:
    rig = Rig()
    rig.put("worker", "ghost")
    assert rig.commander.task.worker == "ghost"
    rig.put("active", True)
    assert rig.state == "inactive"


def test_a_new_rate_in_motion_changes_nothing_but_the_task() -> None:
    rig = moving_rig()
    assert rig.put("rate", 20.0).task_changed
    assert rig.commander.task.rate_hz == 20.0
    assert rig.state == "active"
    rig.settle()
    rig.assert_smooth()


def test_the_speed_is_part_of_the_task_and_no_new_episode() -> None:
    rig = moving_rig()
    episode = rig.commander.task.episode
    assert rig.commander.task.speed_percent == 100.0
    assert rig.put("speed", 30.0).task_changed
    assert rig.commander.task.speed_percent == 30.0
    assert rig.put("speed", 80.0).task_changed
    assert (rig.commander.task.speed_percent, rig.commander.task.episode) == (80.0, episode)
    assert rig.state == "active"


def test_slower_only_ever_lowers_the_speed() -> None:
    rig = Rig()
    rig.put("slower", 40.0)
    assert rig.commander.task.speed_percent == 40.0
    out = rig.put("slower", 40.5)
    assert rig.commander.task.speed_percent == 40.0
    assert rig.refused == {"slower_refused": 1}
    assert [event.why for event in out.events] == [
        "40.5 % is more than the 40 % in force; use the setting speed to go faster"
    ]
    rig.put("slower", 40.0)
    rig.put("slower", 0.0)
    assert rig.commander.task.speed_percent == 0.0
    rig.put("speed", 100.0)
    assert rig.commander.task.speed_percent == 100.0
    assert rig.refused == {"slower_refused": 1}


def test_the_speed_at_the_beginning_is_that_of_the_profile() -> None:
    profile = load_profile("panda_sim")
    slow = profile.task.model_copy(update={"speed_percent": 25.0})
    commander = Commander(profile.model_copy(update={"task": slow}))
    assert commander.task.speed_percent == 25.0


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("rate", math.nan),
        ("rate", -1.0),
        ("rate", True),
        ("rate", "fast"),
        *((name, value) for name in ("speed", "slower") for value in (math.nan, -1.0, True, "30")),
        ("speed", 100.5),
        ("prompt", "x" * 5000),
        ("prompt", 3.0),
        ("prompt", "\ud800"),
        ("worker", "x" * 200),
        ("active", math.nan),
        ("active", 1.0),
        ("colour", "red"),
    ],
)
def test_a_setting_that_cannot_be_is_refused_and_changes_nothing(
    name: str, value: str | bool | float
) -> None:
    rig = Rig()
    rig.tick(chunks=[rig.chunk([STAND])])
    task = rig.commander.task
    rig.put(name, value)
    assert rig.commander.task == task
    assert rig.state == "inactive"
    assert rig.refused == {f"{name}_refused": 1}


def test_activated_again_while_it_brakes_it_comes_to_rest_without_turning_back() -> None:
    rig = moving_rig()
    rig.put("active", False)
    rig.run(0.04)
    count = len(rig.commands)
    rig.activate()
    rig.run(1.0)
    assert rig.state == "active"
    assert rig.commander.at_rest
    assert min(command.twist[0] for command in rig.commands[count:]) > -1e-9
    rig.assert_smooth()
    at_m = rig.position_m[0]
    rig.send([FORTH])
    rig.settle()
    assert rig.position_m[0] == pytest.approx(at_m + 0.02, abs=AT_GOAL_M)


def test_an_arm_that_brakes_goes_on_without_a_step_where_its_controller_lags_at_an_activation() -> (
    None
):
    rig = moving_rig()
    rig.put("active", False)
    rig.run(0.04)
    measured = rig.pose_state

    def late() -> Stamped[PoseState]:
        state = measured()
        held_m = state.record.position_m - [2 * BEGIN_M, 0.0, 0.0]
        return replace(state, record=replace(state.record, reference_position_m=held_m))

    rig.pose_state = late
    rig.activate()
    rig.pose_state = measured
    rig.run(1.0)
    assert rig.state == "active", rig.commander.why
    rig.assert_smooth()


@pytest.mark.slow
def test_a_minute_of_toggling_active_ten_times_a_second_stays_smooth() -> None:
    rig = Rig()
    rig.activate()
    for k in range(600):  # 0.1 s each
        rig.put("active", k % 2 == 1)
        for _ in range(4):
            rig.send([[0.02, 0.0, 0.01 * (-1) ** (k // 50), 0.0, 0.0, 0.05, 0.0]])
            rig.run(0.02)
    rig.put("active", False)
    rig.settle(1.0)
    assert rig.commander.progress.steps > 0
    assert rig.commander.parts[0].motion.failures == 0
    rig.assert_smooth()


# -- time -----------------------------------------------------------------------------------------


def test_a_late_call_samples_the_same_trajectory_later() -> None:
    steady, late = Rig(), Rig()
    positions: dict[str, dict[int, np.ndarray]] = {"steady": {}, "late": {}}
    for rig, name, pattern in ((steady, "steady", [1]), (late, "late", [1, 3, 1, 2, 5])):
        rig.activate()
        rig.send([[0.04, 0.02, 0.01, 0.1, 0.0, 0.1, 0.0]])
        begin_ns, k = rig.now_ns, 0
        while rig.now_ns < begin_ns + 500 * MS:
            out = rig.tick(ticks=pattern[k % len(pattern)])
            assert out.pose is not None
            positions[name][rig.now_ns - begin_ns] = out.pose.position_m
            k += 1
    for at_ns, position_m in positions["late"].items():
        if at_ns in positions["steady"]:
            np.testing.assert_allclose(position_m, positions["steady"][at_ns], atol=1e-12)
    assert len(positions["late"]) < len(positions["steady"]) / 2


def test_the_same_inputs_give_the_same_commands_to_the_bit() -> None:
    def run() -> list[np.ndarray]:
        rig = moving_rig()
        rig.put("active", False)
        rig.run(0.2)
        return [command.position_m for command in rig.commands]

    for first, second in zip(run(), run(), strict=True):
        np.testing.assert_array_equal(first, second)


# -- gripper --------------------------------------------------------------------------------------


def test_gripper_deltas_add_up_from_the_width_at_activation() -> None:
    rig = Rig()
    rig.activate()
    for _ in range(4):
        rig.send([[0, 0, 0, 0, 0, 0, -0.01]])
        rig.run(0.2)
    assert rig.widths_m == pytest.approx([0.07, 0.06, 0.05, 0.04])


def test_a_grip_is_kept_over_a_new_activation() -> None:
    rig = Rig()
    rig.activate()
    rig.send([[0, 0, 0, 0, 0, 0, -0.05]])
    rig.run(0.2)
    rig.gripper = GripperState(0.045, moving=False, holding=True)  # on a brick
    rig.put("active", False)
    rig.run(1.0)
    rig.activate()
    rig.send([STAND])
    rig.run(0.5)
    assert rig.widths_m == pytest.approx([0.03])


def test_a_grip_that_somebody_else_made_can_be_opened() -> None:
    rig = Rig(gripper="absolute_m")
    rig.tick(chunks=[rig.chunk([[0, 0, 0, 0, 0, 0, 0.08]])])
    rig.put("active", True)
    rig.send([[0, 0, 0, 0, 0, 0, 0.07]])
    rig.run(0.3)
    rig.put("active", False)
    rig.run(1.0)
    rig.gripper = GripperState(0.03, moving=False, holding=True)
    rig.tick(chunks=[rig.chunk([[0, 0, 0, 0, 0, 0, 0.07]])])
    rig.put("active", True)
    rig.send([[0, 0, 0, 0, 0, 0, 0.07]])
    rig.run(0.3)
    assert rig.widths_m == pytest.approx([0.07, 0.07])


def test_an_inactive_commander_moves_no_gripper() -> None:
    rig = Rig()
    rig.activate()
    rig.send([[0, 0, 0, 0, 0, 0, -0.05]])
    rig.put("active", False)
    rig.gripper = replace(rig.gripper, width_m=0.08)
    rig.run(2.0)
    assert len(rig.widths_m) == 1


# -- details of what is told ----------------------------------------------------------------------


def test_a_robot_with_very_much_to_complain_about_is_cut_short() -> None:
    rig = Rig()
    rig.gripper = replace(rig.gripper, faults=("x" * 500,) * 50)
    rig.tick()
    assert rig.state == "fault"
    rig.tick("reset")
    assert rig.state == "fault"


def test_a_command_carries_the_chunk_that_caused_it() -> None:
    rig = Rig()
    rig.activate()
    rig.run(0.1)
    out = rig.send([UP])
    assert out.accepted is not None
    assert out.pose is not None
    assert out.pose.cause == out.accepted
    assert (out.accepted.worker, out.accepted.chunk_seq) == (WORKER, rig.seq[WORKER])
    rig.put("active", False)
    assert rig.commands[-1].cause is None


def test_an_arm_outside_the_workspace_is_not_activated() -> None:
    rig = Rig()
    rig.position_m = np.array([0.1, 0.0, 0.3])
    rig.tick(chunks=[rig.chunk([STAND])])
    rig.put("active", True)
    assert rig.state == "inactive"
    assert "outside the workspace" in rig.commander.why


def test_the_robots_own_reference_is_where_it_begins() -> None:
    rig = Rig()
    held_m = START_M + [0.0, 0.0, 0.004]  # the arm sags below what its controller holds
    record = PoseState(START_M, rig.quat_xyzw, np.zeros(6), None, held_m, rig.quat_xyzw)
    rig.tick(chunks=[rig.chunk([STAND])])
    pose = replace(rig.pose_state(), record=record)
    inputs = Inputs([Setting("active", True)], [], pose, rig.gripper_state(), rig.peers)
    out = rig.commander.step(inputs, rig.now_ns)
    assert out.pose is not None
    np.testing.assert_allclose(out.pose.position_m, held_m, atol=1e-12)


def test_source_is_the_one_of_the_spec() -> None:
    rig = Rig()
    rig.activate()
    assert rig.commander.lease is not None
    assert rig.commander.lease.source == SOURCE


def test_what_was_put_before_a_stop_and_arrives_after_it_is_rejected() -> None:
    rig = Rig()
    rig.activate()
    rig.tick(Setting("stop", put_ns=2_000))
    for name, value in (("reset", None), ("active", True)):
        rig.tick(Setting(name, value, put_ns=1_000))
        assert rig.state == "stopped"
    assert "before the last emergency stop" in rig.events[-1].why
    rig.run(1.0)
    rig.tick(Setting("reset", put_ns=3_000))
    assert rig.state == "inactive"
    rig.tick(Setting("active", True, put_ns=1_500))
    assert rig.state == "inactive"


@pytest.mark.parametrize("older_ns", [500, None])
def test_a_stop_that_was_put_earlier_and_arrives_later_lets_nothing_older_pass(
    older_ns: int | None,
) -> None:
    rig = Rig()
    rig.activate()
    rig.tick(Setting("stop", put_ns=1_000))
    rig.run(0.05)
    rig.tick(Setting("stop", put_ns=older_ns))
    for name, value in (("reset", None), ("active", True)):
        rig.tick(Setting(name, value, put_ns=700))
        assert rig.state == "stopped"
    rig.tick(Setting("reset", put_ns=1_100))
    assert rig.state == "inactive"


def test_a_slower_rate_moves_the_time_at_which_the_next_chunk_is_due() -> None:
    rig = Rig()
    rig.activate()
    for _ in range(5):
        rig.send([[0.001, 0, 0, 0, 0, 0, 0]])
        rig.run(0.2)
    rig.put("rate", 0.5)
    rig.run(1.9)
    assert rig.state == "active"
    rig.run(1.5)
    assert rig.state == "holding"


def test_a_faster_rate_shortens_the_time_to_the_next_chunk_and_puts_of_it_do_not_lengthen_it() -> (
    None
):
    rig = Rig()
    rig.put("rate", 0.5)
    rig.activate()
    rig.send([[0.001, 0, 0, 0, 0, 0, 0]])
    rig.run(0.2)
    timing = rig.profile.timing
    for _ in range(20):
        rig.put("rate", 5.0)
        rig.run(0.1)
    assert timing.watchdog_s + 0.2 < 2.0
    assert rig.state == "holding"


def test_at_a_faster_rate_the_next_chunk_has_a_period_from_then_on() -> None:
    rig = Rig(profile(timing={"watchdog_s": 0.05}))
    rig.put("rate", 0.5)
    rig.activate()
    rig.send([[0.0] * 7])
    rig.run(1.0)
    rig.put("rate", 5.0)
    rig.run(0.15)
    assert rig.state == "active"
    rig.run(0.15)
    assert rig.state == "holding"


def test_a_step_that_lasts_longer_than_max_open_loop_does_not_put_off_the_next_chunk() -> None:
    rig = Rig(profile(timing={"max_open_loop_s": 0.5, "watchdog_s": 0.1}), dt_s=2.0)
    rig.put("rate", 10.0)
    rig.activate()
    rig.send([[0.0] * 7])
    rig.run(0.65)
    assert rig.state == "active"
    rig.run(0.1)
    assert rig.state == "holding"


def test_the_gripper_of_a_part_that_is_not_there_holds_nothing() -> None:
    rig = Rig()
    rig.tick(Setting("held", None, None, "left"))
    assert "no part 'left'" in rig.events[-1].why


def test_an_arm_without_a_gripper_holds_nothing() -> None:
    bare = override(profile(), {"robot": {"gripper": None, "finger_joints": []}})
    rig = Rig(bare, reach=reach_of(bare), gripper="none")
    rig.tick(Setting("held", BOX))
    assert "it holds nothing" in rig.events[-1].why


def test_what_the_gripper_holds_already_is_no_news() -> None:
    rig = Rig(reach=reach_of(profile()))
    for _ in range(2):
        rig.tick(Setting("held", BOX))
    assert [event.what for event in rig.events].count("gripper_holds") == 1


def test_a_router_whose_clock_was_set_back_does_not_keep_an_arm_stopped() -> None:
    rig = Rig()
    rig.tick(Setting("stop", put_ns=2_000_000_000))
    rig.run(1.0)
    rig.tick(Setting("reset", put_ns=1_000))
    assert rig.state == "stopped"
    rig.run(10.0)
    rig.tick(Setting("reset", put_ns=2_000))
    assert rig.state == "inactive"


def test_the_measured_joints_are_monitored_however_many_chunks_arrive() -> None:
    of = profile()
    reach = reach_of(of)
    rig = Rig(of, reach=reach)
    joints_rad, end_rad = reach.joints_rad.copy(), reach.kinematics.upper_rad[6] - 1e-3
    joints_rad[6] = end_rad - 0.2
    rig.stand_at(reach.kinematics, joints_rad)
    for _ in range(3):
        rig.tick()
    rig.activate()
    rig.run(0.2)
    rig.blocked = True  # a person moves it
    for _ in range(100):
        joints_rad[6] += 0.2 / 99
        rig.stand_at(reach.kinematics, joints_rad.copy())
        rig.tick(chunks=[rig.chunk([[0.0] * 7], seq=0)])
    assert rig.state == "inactive"
    assert "the measured arm is too near to a bound" in rig.commander.why


@pytest.mark.parametrize("command", ["pose", "joint"])
def test_a_chunk_planned_before_its_tick_gives_the_commands_that_the_tick_would(
    command: str,
) -> None:
    of = profile(robot={"command": command})
    moved: list[list[np.ndarray]] = []
    for early in (False, True):
        reach = reach_of(of)
        rig = Rig(of, reach=reach)
        rig.stand_at(reach.kinematics, reach.joints_rad.copy())
        rig.joints_rad = None
        rig.activate()
        moved.append([])
        for count in range(80):
            chunks = []
            if count % 10 == 0:
                chunks = [rig.chunk([[0.004, 0.002, 0.003, 0, 0, 0.01, 0]] * 6)]
            if early and chunks:
                rig.commander.prepare(Inputs(chunks=chunks), rig.now_ns + rig.period_ns)
                chunks = []
            out = rig.tick(chunks=chunks)
            if out.pose is not None:
                moved[-1].append(out.pose.position_m)
            else:
                assert out.joint is not None
                moved[-1].append(out.joint.position_rad)
        assert rig.commander.progress.chunks == 8
    np.testing.assert_array_equal(moved[0], moved[1])
    assert np.linalg.norm(moved[0][-1] - moved[0][0]) > 0.01


def test_of_a_chunk_planned_before_a_stop_nothing_is_carried_out() -> None:
    rig = moving_rig()
    before = rig.commander.progress.chunks
    rig.commander.prepare(Inputs(chunks=[rig.chunk([UP])]), rig.now_ns + rig.period_ns)
    assert rig.commander.progress.chunks == before + 1
    rig.put("stop")
    assert rig.state == "stopped"
    rig.settle()
    rig.assert_smooth()


def test_a_robot_that_leaves_its_ready_mode_between_two_ticks_is_inactive_in_the_task() -> None:
    rig = moving_rig()
    rig.gripper = replace(rig.gripper, mode="stalled")
    rig.commander.prepare(Inputs(gripper=rig.gripper_state()), rig.now_ns + rig.period_ns)
    out = rig.tick()
    assert rig.state == "inactive"
    assert not rig.commander.task.active
    assert out.task_changed


def rising_rig(command: str) -> Rig:
    """An arm on its way up."""
    of = profile(robot={"command": command})
    reach = reach_of(of)
    rig = Rig(of, reach=reach)
    rig.stand_at(reach.kinematics, reach.joints_rad.copy())
    rig.joints_rad = None
    rig.activate()
    rig.tick(chunks=[rig.chunk([UP] * 8)])
    rig.run(0.2)
    assert rig.state == "active"
    return rig


@pytest.mark.parametrize("command", ["pose", "joint"])
def test_a_goal_without_a_trajectory_is_a_fault_and_the_arm_brakes(
    command: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    rig = rising_rig(command)
    monkeypatch.setattr(AxisSmoother, "_towards", lambda *_: (None, False))
    rig.tick(chunks=[rig.chunk([UP] * 8)])
    rig.run(1.0)
    assert rig.state == "fault"
    assert rig.commander.why == "no trajectory could be computed; braked"
    assert rig.commander.at_rest


@pytest.mark.parametrize("command", ["pose", "joint"])
def test_a_tick_without_a_trajectory_brakes_and_the_next_one_goes_on(
    command: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    rig = rising_rig(command)
    with monkeypatch.context() as patch:
        patch.setattr(AxisSmoother, "_towards", lambda *_: (None, False))
        out = rig.tick(chunks=[rig.chunk([UP] * 8)])
        out.events += rig.tick().events
    told = [event.why for event in out.events if event.what == "no_trajectory"]
    assert told
    for word in ("velocity [", "target [", "shares [", "limits ["):
        assert all(word in why for why in told)
    before = rig.commander.parts[0].motion.commanded
    rig.run(0.3)
    after = rig.commander.parts[0].motion.commanded
    assert rig.state == "active"
    assert before is not None
    assert after is not None
    assert after.position_m[2] > before.position_m[2] + 0.01


# -- a prompt and an activation, put at once ------------------------------------------------------
UNKNOWN = {WORKER: "knows no prompt 'dance'"}


def asked_rig(rate_hz: float = 5.0) -> Rig:
    """A worker that complains about the prompt before; then a new one and an activation at once."""
    rig = Rig()
    rig.tick(Setting("rate", rate_hz), chunks=[rig.chunk([STAND])])
    rig.peers = replace(rig.peers, worker_complaints=UNKNOWN)
    rig.tick()
    rig.tick(Setting("prompt", "HARD: go down"), Setting("active", True))
    return rig


def test_an_activation_waits_until_the_worker_has_heard_the_prompt_before_it() -> None:
    rig = asked_rig()
    assert rig.refused == {}
    assert "waits for worker" in rig.commander.why
    rig.run(0.2)
    rig.peers = replace(rig.peers, worker_complaints={})
    rig.tick(chunks=[rig.chunk([STAND])])
    assert rig.state == "active"
    assert rig.refused == {}


@pytest.mark.parametrize(
    ("rate_hz", "patience_s"), [(0.2, MAX_ANSWER_S), (5.0, ANSWER_S + 0.2), (50.0, ANSWER_S + 0.02)]
)
def test_a_worker_that_cannot_do_the_new_prompt_either_is_waited_for_a_bounded_time(
    rate_hz: float, patience_s: float
) -> None:
    rig = asked_rig(rate_hz)
    rig.run(patience_s - 0.02)
    assert rig.refused == {}
    rig.run(0.04)
    assert rig.refused["activate_refused"] == 1
    assert "knows no prompt 'dance'" in rig.commander.why
    rig.peers = replace(rig.peers, worker_complaints={})
    rig.tick(chunks=[rig.chunk([STAND])])
    assert rig.state == "inactive", "it was rejected: it does not begin later by itself"


@pytest.mark.parametrize("ends_it", [Setting("stop"), Setting("active", False), Setting("reset")])
def test_what_comes_after_a_waiting_activation_ends_it(ends_it: Setting) -> None:
    rig = asked_rig()
    rig.tick(ends_it)
    rig.peers = replace(rig.peers, worker_complaints={})
    rig.tick(chunks=[rig.chunk([STAND])])
    assert rig.state != "active"


def test_an_activation_does_not_wait_for_what_a_prompt_cannot_mend() -> None:
    rig = Rig()
    rig.peers = replace(rig.peers, alive=frozenset())
    rig.tick(Setting("prompt", "HARD: go down"), Setting("active", True))
    assert rig.refused["activate_refused"] >= 1
