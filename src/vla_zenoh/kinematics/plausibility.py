"""Numbers that no arm has, described or measured: degrees for radians, millimetres for metres."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from vla_zenoh.kinematics.collision import CollisionModel
from vla_zenoh.kinematics.kinematics import Kinematics
from vla_zenoh.profile import Limits
from vla_zenoh.types import GripperState, JointState

MAX_TURN_RAD = 4 * math.pi + 0.1
"""Wrists turn by at most two turns to each side; a range in degrees is beyond this."""
MAX_SPEED_RAD_S = 50.0
"""The quickest joints of arms make 10 rad/s; a velocity in degrees is beyond this."""
MIN_SPEED_RAD_S, MIN_SPEED_M_S = 0.01, 0.001
"""Slower joints are no arm's: a turn takes ten minutes."""
MAX_LENGTH_M = 10.0
"""Between two joints, or from the root of the description to the base."""
MIN_ARM_M = 0.05
"""From the first joint to the TCP, stretched: the smallest desk arms have 0.2 m."""
MAX_LINK_M = 3.0
"""From a joint to the end of the link that it moves."""
BEYOND = 0.1
"""A joint at its end may be measured this share of its range beyond it: zero points differ."""
WIDER_M = 0.01
"""A gripper may be measured wider than it opens by this."""


def implausible(
    kinematics: Kinematics, limits: Limits, collisions: CollisionModel
) -> Iterator[str]:
    """What cannot be right about an arm, each with the unit that it is probably in."""
    name = kinematics.urdf.name
    for index, joint in enumerate(kinematics.arm_joints):
        low, high = float(kinematics.lower_rad[index]), float(kinematics.upper_rad[index])
        velocity = float(kinematics.velocity_rad_s[index])
        slides = bool(kinematics.slides[index])
        furthest = MAX_LENGTH_M if slides else MAX_TURN_RAD
        fastest = MAX_LENGTH_M if slides else MAX_SPEED_RAD_S
        slowest = MIN_SPEED_M_S if slides else MIN_SPEED_RAD_S
        unit, wrong = ("m", "millimetres") if slides else ("rad", "degrees")
        if not kinematics.endless[index] and max(abs(low), abs(high)) > furthest:
            yield (
                f"joint {joint!r} of {name} goes from {low:g} to {high:g} {unit}: are these "
                f"{wrong}? Correct the description, or give robot.joint_range_rad"
            )
        if velocity > fastest:
            yield (
                f"joint {joint!r} of {name} has a velocity of {velocity:g} {unit}/s: are these "
                f"{wrong}? Correct the description"
            )
        if velocity < slowest:
            yield (
                f"joint {joint!r} of {name} has a velocity of {velocity:g} {unit}/s: it would "
                f"take minutes. A URDF has {unit}/s: correct the description"
            )
    base_m = float(np.linalg.norm(kinematics.base_placement.translation))
    if base_m > MAX_LENGTH_M:
        yield (
            f"base_frame is {base_m:g} m from the root of {name}: is this in millimetres, or a "
            "place on a map? Give a base_frame at the arm's foot, or correct the description"
        )
    lengths_m = [
        (float(np.linalg.norm(kinematics.model.jointPlacements[index].translation)), joint)
        for index, joint in enumerate(kinematics.model.names)
        if index > 1
    ]
    tcp = kinematics.model.frames[kinematics.tcp]
    lengths_m.append((float(np.linalg.norm(tcp.placement.translation)), tcp.name))
    for length_m, what in lengths_m:
        if length_m > MAX_LENGTH_M:
            yield (
                f"{name} has {what!r} {length_m:g} m from the joint before it: are these "
                "millimetres? A URDF is in metres"
            )
    length_m = sum(length for length, _ in lengths_m)
    if length_m + _slides_m(kinematics) < MIN_ARM_M:
        yield (
            f"the arm of {name} is {length_m:.3g} m long from its first joint to the TCP: was it "
            "divided by 1000? A URDF is in metres"
        )
    for link, reach_m in collisions.reaches_m():
        if reach_m > MAX_LINK_M:
            yield (
                f"{name} has link {link!r} with a collision shape that ends {reach_m:.3g} m from "
                'its joint: is it in millimetres? Give its mesh scale="0.001 0.001 0.001", or '
                "correct its size: no barrier can keep it from the arm itself"
            )
    yield from _out_of_reach(kinematics, limits, length_m)


def state_fault(
    kinematics: Kinematics,
    max_width_m: float,
    joint: JointState | None,
    gripper: GripperState | None,
) -> str:
    """What this arm cannot have measured, with the unit that it is probably in; empty: nothing."""
    if joint is not None:
        here_rad = kinematics.joints_of(joint)
        lower_rad, upper_rad = kinematics.lower_rad, kinematics.upper_rad
        away_rad = np.maximum(lower_rad - here_rad, here_rad - upper_rad)
        for index in np.flatnonzero(away_rad > BEYOND * (upper_rad - lower_rad)).tolist():
            unit = kinematics.unit(index)
            return (
                f"joint {kinematics.arm_joints[index]!r} is at {here_rad[index]:.4g} {unit}, and "
                f"goes from {lower_rad[index]:.4g} to {upper_rad[index]:.4g}: is this in "
                f"{'millimetres' if unit == 'm' else 'degrees'}?"
            )
    if gripper is not None and gripper.opening_m > max_width_m + WIDER_M:
        return f"the gripper is {gripper.opening_m:.4g} m wide, and opens to {max_width_m:g} m"
    return ""


def _slides_m(kinematics: Kinematics) -> float:
    """How far the sliding joints can be out, together."""
    return float(np.sum(np.abs(kinematics.upper_rad)[kinematics.slides]))


def _out_of_reach(kinematics: Kinematics, limits: Limits, length_m: float) -> Iterator[str]:
    """Whether the workspace lies where no joint position takes the TCP."""
    first = kinematics.model.jointPlacements[1]
    foot_m = kinematics.base_placement.actInv(first).translation
    nearest_m = np.clip(foot_m, *limits.tcp_box.corners_m)
    away_m = float(np.linalg.norm(nearest_m - foot_m))
    reach_m = length_m + _slides_m(kinematics)
    if away_m > reach_m:
        yield (
            f"limits.workspace is {away_m:.3g} m from the first joint, and the arm of "
            f"{kinematics.urdf.name} is {reach_m:.3g} m long: nothing in it can be reached. Are "
            "its numbers in the frame of base_frame, and in metres?"
        )
