"""What was written down of a motion that something happened to, as figures of its row, and what of
our promises they break. Pure.

The arm may move on after a chunk for the end of its step, one period, the watchdog and a brake;
the simulator without a command, and the command node without a state, for the profile's patience
and a brake. Rows of every kind are held to that, whether the arm stood or went on.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from netns.flight_log import Flight, brake_s
from netns.rows import Fault, Row

from vla_zenoh.profile import Profile

RATE_HZ = 10.0
STEP_S, STEP_M = 0.1, 0.01
STEPS = 40
"""Of a motion that is to reach its goal: 0.4 m."""
GOAL_M = 0.001
BEFORE_S = 0.2
"""What is written down of the motion just before the fault is looked at as well."""
AROUND_S = 0.1
"""The hardest motion within this of a moment is what has to be braked from there."""
MEASURED_SLACK, OWN_BRAKE_SLACK = 1.15, 2.0
"""Share of the acceleration limit that the measured arm may take; where the robot brakes alone."""
COMMANDED_SLACK = 1.001


class Span(NamedTuple):
    """Times of a row on the monotonic clock.

    Args:
        began_s: the fault came.
        ended_s: it was ended.
        rest_s: the arm was deactivated.
    """

    began_s: float
    ended_s: float
    rest_s: float


def measure_motion(
    row: Row,
    fault: Fault,
    profile: Profile,
    measured: Flight,
    commanded: Flight,
    span: Span,
    *,
    done: bool,
) -> None:
    """Fill in how the arm moved.

    Args:
        row: is filled in.
        fault: what happened.
        profile: its limits and patience.
        measured: by the simulator.
        commanded: by the command node.
        span: when.
        done: the motion came to its goal, where the arm stands, too: it was not braked for good.
    """
    began_s = span.began_s
    stood_s = None if done else measured.stood_at_s(began_s, span.rest_s)
    if stood_s is not None:
        row.stood_s = stood_s - began_s
        way = measured.between(began_s, stood_s).position_m
        row.way_mm = float(np.linalg.norm(way[-1] - way[0])) * 1e3 if len(way) else 0.0
    if fault.alone and fault.seconds is not None:
        if stood_s is not None:  # its link is dead from the beginning, whatever still comes
            row.braked_s = stood_s - began_s
            row.braked_bound_s = profile.timing.command_timeout_s + _brake_s(
                profile, commanded, began_s
            )
    else:
        until_s = stood_s or (span.ended_s if done else span.rest_s)
        _measure_chunks(row, fault, profile, measured.between(began_s, until_s), commanded, began_s)
    _measure_silence(row, profile, measured.between(began_s), commanded.between(began_s))
    limits = profile.limits.translation
    before_s = began_s - BEFORE_S
    row.acceleration = measured.between(before_s).hardest_m_s2() / limits.acceleration_m_s2
    period_s = 1.0 / profile.timing.command_hz
    row.jerk = commanded.between(before_s).jerk_m_s3(period_s) / limits.jerk_m_s3


def _measure_chunks(
    row: Row, fault: Fault, profile: Profile, moved: Flight, commanded: Flight, began_s: float
) -> None:
    """The longest the arm moved on after a chunk; what it was asked before the fault is no news."""
    asked_s = np.fmax(commanded.asked_at_s(moved.time_s), began_s)
    longest = moved.longest_s(asked_s)
    if longest is None:
        return
    timing = profile.timing
    row.braked_s, since_s = longest
    row.braked_bound_s = STEP_S + 1.0 / RATE_HZ + timing.watchdog_s
    row.braked_bound_s += _brake_s(profile, commanded, since_s)
    if fault.alone:  # commands that cross its link may be late by as much as they may be silent
        row.braked_bound_s += timing.command_timeout_s


def _measure_silence(row: Row, profile: Profile, measured: Flight, commanded: Flight) -> None:
    timing = profile.timing
    for node, flight, patience_s in (
        ("sim", measured, timing.command_timeout_s),
        ("command", commanded, timing.state_timeout_s),
    ):
        longest = flight.longest_s(flight.heard_s)
        if longest is not None:
            row.unheard_s[node], since_s = longest
            brakes_s = [_brake_s(profile, commanded, since_s)]
            if node == "sim":  # what it does may have been commanded long before
                here = measured.between(since_s - AROUND_S, since_s + AROUND_S)
                speeds = here.twist[:: len(here.twist) // 10 + 1, :3]
                brakes_s += [brake_s(profile, speed, np.zeros(3)) for speed in speeds]
            row.unheard_bound_s[node] = patience_s + max(brakes_s)


def _brake_s(profile: Profile, commanded: Flight, at_s: float) -> float:
    around = commanded.between(at_s - AROUND_S, at_s + AROUND_S)
    return max(
        (
            brake_s(profile, twist[:3], change)
            for twist, change in zip(around.twist[::5], around.last[::5], strict=True)
        ),
        default=0.0,
    )


def judge(row: Row, fault: Fault, finished: dict[str, Any], recovered: dict[str, Any]) -> None:
    """Write down what is wrong.

    Args:
        row: measured.
        fault: what happened.
        finished: what the operator says of the motion's end, empty where it has none.
        recovered: what the operator says of its return, empty where there was no need.
    """
    _judge_brake(row)
    slack = OWN_BRAKE_SLACK if fault.alone else MEASURED_SLACK
    if row.acceleration > slack:
        row.wrong.append(f"acceleration {row.acceleration:.2f} of its limit")
    if row.jerk > COMMANDED_SLACK:
        row.wrong.append(f"commanded jerk {row.jerk:.3f} of its limit")
    if recovered and not recovered.get("moves"):
        row.wrong.append("did not come back")
    if fault.goes_on and fault.seconds is not None:
        if row.stood_s is not None:
            row.wrong.append(f"stood on its way after {row.stood_s:.1f} s")
    elif fault.goes_on:
        if not finished.get("done"):
            row.wrong.append("did not reach its goal")
        elif (row.off_mm or 0.0) > GOAL_M * 1e3:
            row.wrong.append(f"{row.off_mm:.2f} mm beside its goal")


def _judge_brake(row: Row) -> None:
    took_s, bound_s = row.braked_s, row.braked_bound_s
    if took_s is not None and bound_s is not None and took_s > bound_s:
        row.wrong.append(f"stood after {took_s:.3f} s, allowed {bound_s:.3f} s")
    for node, silent_s in row.unheard_s.items():
        if silent_s > row.unheard_bound_s[node]:
            row.wrong.append(
                f"moved on {silent_s:.3f} s after {node} had last heard, "
                f"allowed {row.unheard_bound_s[node]:.3f} s"
            )
