"""Limits on what a model may ask for, and slowdowns.

The arm moves at full speed, unless a barrier is near (`vla_zenoh.control.reachability`). A step for
which the joints are too slow takes the time that they need, and a far target is approached at a
speed of its own. The arm is then later than the steps ask for, and the slowdown lasts until it has
caught up (`keep_slowdown`): until then it is still where it needs that speed.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from vla_zenoh.kinematics.so3 import Pose, exp3, log3, norm3, orthonormal, pose_distance
from vla_zenoh.profile import Limits, Profile, ReachLimits
from vla_zenoh.types import FloatArray, JointBound

if TYPE_CHECKING:
    from vla_zenoh.kinematics.kinematics import Kinematics

ROTATION_BOX = 0.55
"""Share of a rotation limit per axis, so that the norm over three axes (sqrt 3 of it) and the small
terms of a moving chart (5 %) stay below the limit in any direction."""
APPROACH = "approach"
"""Name of the slowdown towards a target that is further away than a step."""
LEAST_NEAR_STOP = 0.1
"""Least share of the speed close to a stop: the arm has to be able to work there."""
PAUSE_LEAD_M, PAUSE_LEAD_RAD = 0.01, 0.02
"""The goal of an arm that another part holds up leads it by this much at most."""
SPEED_STEPS = 20
"""Number of speed shares of what is measured: each change of the share plans the motion again."""
BEGIN_M, BEGIN_RAD = 0.002, 0.01
BEGIN_JOINT = JointBound(0.004, BEGIN_M)
"""A command stream begins this near to where the robot holds the arm, or its guard rejects it: what
it begins with is one step of the controller's set-point."""
LEAST_TO_GOAL = 1e-4
"""Least share where the joints are too slow, or a far target is approached."""


class MotionLimits(NamedTuple):
    """(velocity, acceleration, jerk): translation per axis in m, s; rotation as norm in rad, s."""

    translation: tuple[float, float, float]
    rotation: tuple[float, float, float]

    @property
    def box(self) -> FloatArray:
        """(3, 6) of every axis."""
        return np.array(
            [[move] * 3 + [turn * ROTATION_BOX] * 3 for move, turn in zip(*self, strict=True)]
        )


def motion_limits(limits: Limits) -> MotionLimits:
    """The motion limits of a profile."""
    translation, rotation = limits.translation, limits.rotation
    return MotionLimits(
        (translation.velocity_m_s, translation.acceleration_m_s2, translation.jerk_m_s3),
        (rotation.velocity_rad_s, rotation.acceleration_rad_s2, rotation.jerk_rad_s3),
    )


class Shares(NamedTuple):
    """Shares of the limits of velocity, acceleration and jerk, each above 0 and at most 1."""

    velocity: float = 1.0
    acceleration: float = 1.0
    jerk: float = 1.0


FULL = Shares()
"""All of the limits."""


class JointMotionLimits(NamedTuple):
    """Limits of joint motion, (n,) each: rad/s, rad/s^2, rad/s^3."""

    velocity_rad_s: FloatArray
    acceleration_rad_s2: FloatArray
    jerk_rad_s3: FloatArray


def joint_motion_limits(profile: Profile, margin: float = 1.0) -> JointMotionLimits:
    """`margin` times the limits of `profile`, in the order of ``robot.arm_joints``."""
    limits, joints = profile.limits.joint, len(profile.robot.arm_joints)
    names = ("velocity_rad_s", "acceleration_rad_s2", "jerk_rad_s3")
    return JointMotionLimits(*(margin * np.array(limits.of(name, joints)) for name in names))


def chain_motion_limits(profile: Profile, kinematics: Kinematics) -> JointMotionLimits:
    """The same in chain order; the velocities are those of the URDF at most."""
    velocity, acceleration, jerk = (
        kinematics.ordered(profile.robot.arm_joints, values)
        for values in joint_motion_limits(profile)
    )
    return JointMotionLimits(np.minimum(velocity, kinematics.velocity_rad_s), acceleration, jerk)


def stop_way(
    velocity: FloatArray, acceleration: FloatArray, box: FloatArray, ahead_s: float
) -> FloatArray:
    """Distance (n,) of a stop of all axes together, within `box`, begun in `ahead_s`.

    From a speed v a stop takes ``v / a + a / j`` at most and goes half as far as v would. It is an
    upper bound, unless the axes are accelerated further until it begins.
    """
    _, most, jerk = box
    ramp_s = np.abs(acceleration) / jerk
    later = velocity + 0.5 * acceleration * ramp_s
    fast = np.where(np.abs(later) > np.abs(velocity), later, velocity)
    stop_s = float(np.max(0.5 * (np.abs(later) / most + most / jerk) + ramp_s))
    return (ahead_s + stop_s) * fast


def stop_s_of(speed: float, most: float, jerk: float) -> float:
    """How long a stop takes from constant `speed`; it goes half as far as `speed` would."""
    if speed * jerk < most * most:
        return 2.0 * math.sqrt(speed / jerk)
    return speed / most + most / jerk


def between(start: FloatArray, end: FloatArray) -> list[FloatArray]:
    """Two places (n,) of a short motion: half of it, and its end."""
    return [0.5 * (start + end), end]


def joint_margins(limits: ReachLimits, kinematics: Kinematics) -> FloatArray:
    """(n,) kept from both ends of every joint's range, rad, of a joint that slides m."""
    return JointBound(limits.joint_margin_rad, limits.joint_margin_m).of(kinematics.slides)


WAYS_OUT = {
    "singularity": ": the arm is stretched, or two of its axes are in line; lead it back the way "
    "it came, or by its joints (`vla-zenoh do home`)",
}
"""What to do about a limit whose name does not say it, to end a sentence."""


class LimitHit(NamedTuple):
    """A limit that acted.

    Args:
        name: ``step_m``, ``step_rad``, ``workspace``, ``lead_m``, ``lead_rad``; from the arm's
            kinematics ``reach``, ``joint_limit``, ``joint_velocity``, ``singularity``,
            ``self_collision``, ``table_distance``, ``keep_out``.
        value: the value asked for.
        limit: the value allowed.
        where: the joint, the two links, the link over the table, or link and keep-out; empty for
            the whole arm.
    """

    name: str
    value: float
    limit: float
    where: str = ""

    @property
    def at(self) -> str:
        """ " at WHERE" for a sentence, empty for the whole arm."""
        return f" at {self.where}" if self.where else ""

    @property
    def way_out(self) -> str:
        """What to do about it, to end a sentence; empty where the name says it."""
        return WAYS_OUT.get(self.name, "")


def bound_step(limits: Limits, before: Pose, asked: Pose) -> tuple[Pose, list[LimitHit]]:
    """Shorten the step from `before` to `asked` to its limits and the workspace.

    Returns:
        the bounded pose, and the limits that acted.
    """
    way_m = asked.position_m - before.position_m
    turn = log3(asked.rotation @ before.rotation.T)
    way_m, hits = bound_norm("step_m", way_m, limits.step_m)
    turn, hit = bound_norm("step_rad", turn, limits.step_rad)
    hits += hit
    inside, overshoot_m = into_workspace(limits, before.position_m + way_m, before.position_m)
    if overshoot_m > 0:
        hits.append(LimitHit("workspace", overshoot_m, 0.0))
    if not hits:
        return Pose(inside, asked.rotation), hits
    return Pose(inside, orthonormal(exp3(turn) @ before.rotation)), hits


def bound_norm(name: str, vector: FloatArray, limit: float) -> tuple[FloatArray, list[LimitHit]]:
    """`vector` (3,) no longer than `limit`, and the limit if it acted."""
    norm = norm3(vector)
    if norm <= limit * (1 + 1e-6):  # float32 steps of exactly the limit are within it
        return vector, []
    if not math.isfinite(norm):  # a product of numbers that were finite each
        return np.zeros(3), [LimitHit(name, math.inf, limit)]
    return vector * (limit / norm), [LimitHit(name, norm, limit)]


def workspace_corners(limits: Limits) -> tuple[FloatArray, FloatArray]:
    """Lower and upper corner (3,) m of the workspace box."""
    low, high = np.array(limits.tcp_box.corners_m)
    return low, high


def into_workspace(
    limits: Limits, position_m: FloatArray, before_m: FloatArray | None = None
) -> tuple[FloatArray, float]:
    """The nearest position (3,) inside the workspace box, and the distance to it (m).

    A step that starts at `before_m`, outside the box, may lead back or stay, but no further out.
    """
    x, y, z = position_m.tolist()
    (x_low, y_low, z_low), (x_high, y_high, z_high) = limits.tcp_box.corners_m
    if before_m is not None:
        x0, y0, z0 = before_m.tolist()
        x_low, y_low, z_low = min(x_low, x0), min(y_low, y0), min(z_low, z0)
        x_high, y_high, z_high = max(x_high, x0), max(y_high, y0), max(z_high, z0)
    if x_low <= x <= x_high and y_low <= y <= y_high and z_low <= z <= z_high:
        return position_m, 0.0
    inside = np.array(
        [min(max(x, x_low), x_high), min(max(y, y_low), y_high), min(max(z, z_low), z_high)]
    )
    return inside, norm3(position_m - inside)


def leash(limits: Limits, goal: Pose, commanded: Pose) -> tuple[Pose, list[LimitHit]]:
    """Keep the goal near the commanded pose, so that no backlog builds up."""
    apart_m, apart_rad = pose_distance(goal, commanded)
    if apart_m <= limits.lead_m and apart_rad <= limits.lead_rad:
        return goal, []
    hits: list[LimitHit] = []
    ahead_m = goal.position_m - commanded.position_m
    turn = log3(goal.rotation @ commanded.rotation.T)
    for name, vector, limit in (
        ("lead_m", ahead_m, limits.lead_m),
        ("lead_rad", turn, limits.lead_rad),
    ):
        norm = norm3(vector)
        if norm > limit:
            hits.append(LimitHit(name, norm, limit))
            vector *= limit / norm
    if not hits:
        return goal, hits
    return Pose(commanded.position_m + ahead_m, orthonormal(exp3(turn) @ commanded.rotation)), hits


# -- slowing down ---------------------------------------------------------------------------------
class Slowdown(NamedTuple):
    """Why the arm moves slower than at full speed.

    Args:
        name: the bound, as in `LimitHit`.
        share: of the speed limits.
        value: singular value or distance there.
        limit: the value below which it slows down.
        where: as in `LimitHit`.
        late_s: time by which the arm arrives later because of it.
    """

    name: str
    share: float
    value: float
    limit: float
    where: str
    late_s: float = 0.0

    @property
    def at(self) -> str:
        """ " at WHERE" for a sentence, empty for the whole arm."""
        return f" at {self.where}" if self.where else ""


def in_steps(share: float, least: float = LEAST_NEAR_STOP) -> float:
    """A share of the speed, rounded up to one of `SPEED_STEPS`; not below `least`."""
    return max(math.ceil(share * SPEED_STEPS) / SPEED_STEPS, least)


def slowest(*reasons: Slowdown | None) -> Slowdown | None:
    """The slowdown with the least share, None without any."""
    given = [reason for reason in reasons if reason is not None]
    return min(given, key=lambda reason: reason.share, default=None)


def full_speed_s(limits: Limits, before: Pose, after: Pose) -> float:
    """Time (s) that a step takes at full speed, by the limits of `Smoother.box`."""
    way_m = after.position_m - before.position_m
    turn = log3(before.rotation.T @ after.rotation)
    return max(
        max(map(abs, way_m.tolist())) / limits.translation.velocity_m_s,
        max(map(abs, turn.tolist())) / (ROTATION_BOX * limits.rotation.velocity_rad_s),
    )


def keep_slowdown(
    before: Slowdown | None, now: Slowdown | None, dt_s: float, most_s: float
) -> Slowdown | None:
    """The slowdown of a step of `dt_s` that the arm starts late, `before` being that of the last.

    `now` is that of the step itself, `most_s` the greatest lateness at full speed by the leash.
    """
    if before is None or before.late_s <= 0.0:
        return now
    added_s = 0.0 if now is None else now.late_s
    if now is not None and now.name == APPROACH:
        late_s = max(before.late_s - dt_s, added_s)
    else:
        late_s = before.late_s + (added_s or -dt_s)
    if now is not None and now.share <= before.share:
        before = now
    elif late_s <= 0.0:
        return now
    return before._replace(late_s=max(min(late_s, most_s / before.share), 0.0))


class BoundedStep(NamedTuple):
    """A step within what the arm can do.

    Args:
        pose: its end: exactly the requested pose if no limit acted, its start if nothing is left.
        hits: limits that acted.
        joints_rad: (n,) at its end.
        slowdown: why it is slower than full speed.
    """

    pose: Pose
    hits: list[LimitHit]
    joints_rad: FloatArray
    slowdown: Slowdown | None
