"""Monitoring of the measured joints: how near the moving arm is to its bounds, and its elbow.

Goals are bounded on a model of the arm; this monitors the arm itself. For every bound (end of a
joint's range, singular value, distances of the arm to itself and to the table)::

    inside its zone (slow to stop) and approaching    speed sqrt(distance left / zone)
    past the stop by `PAST` and approaching           the arm has to brake

`PAST` allows for the tracking error of an arm that works at a stop. A value approaches when it
leaves a band that follows it: noise within the band does not count, a slow drift does. In addition,
no joint may be far from its command or, if poses are commanded, from its place in a model whose TCP
follows the measured one: beyond ``limits.elbow_rad`` the arm slows down, at twice that it brakes.
"""

from __future__ import annotations

from operator import is_
from typing import Any

import numpy as np

from vla_zenoh.control.limits import SLOWEST, LimitHit, Slowdown, joint_margins, slowest
from vla_zenoh.control.reachability import ReachabilityFilter
from vla_zenoh.errors import VlaZenohError
from vla_zenoh.kinematics.kinematics import Kinematics
from vla_zenoh.kinematics.so3 import held_pose, pose_distance, pose_of
from vla_zenoh.profile import Profile
from vla_zenoh.types import FloatArray, JointState, PoseState, Stamped

PERIOD_NS = 30_000_000
PAST_M, PAST_SINGULAR = 0.005, 0.005
PAST_MARGIN = 0.5
"""Part of ``joint_margin_rad``."""
BAND_RAD, BAND_M, BAND_SINGULAR = 2e-3, 5e-4, 5e-4
STEPS = 20
"""Number of speed shares, so that the share does not change at every update."""

_NOTHING = (None, None, None)


class JointMonitor:
    """Slowdown and braking by the measured joints.

    Args:
        profile: its limits.
        reach: the model of the arm.
    """

    def __init__(self, profile: Profile, reach: ReachabilityFilter) -> None:
        self._reach = reach
        barriers, slides = reach.barriers, reach.kinematics.slides
        limits = profile.limits
        self._elbow_limits = np.where(slides, limits.tracking_m, limits.elbow_rad)
        margins, distances = joint_margins(limits.reach, reach.kinematics), len(barriers.stop) - 1
        self._stop = np.concatenate([margins, barriers.stop])
        self._slow = np.concatenate([2 * margins, barriers.slow])
        self._past = _each(PAST_MARGIN * margins, distances, PAST_SINGULAR, PAST_M)
        self._band = _each(np.where(slides, BAND_M, BAND_RAD), distances, BAND_SINGULAR, BAND_M)
        self.reset()

    def reset(self) -> None:
        """Forget the last values: the arm is not being moved."""
        self._edge: FloatArray | None = None
        self._expected_rad: FloatArray | None = None
        self.next_ns = 0
        """When the next check is due."""
        self._elbow_next = False
        self.elbow_rad = 0.0
        """Greatest distance of a joint from where it is expected."""
        self._bound_slowdown: Slowdown | None = None
        self._elbow_slowdown: Slowdown | None = None
        # Joints that passed each check, so that an arm at rest is not checked again.
        self._passed: list[tuple[Any, ...]] = [_NOTHING, _NOTHING]

    @property
    def slowdown(self) -> Slowdown | None:
        """The slowdown of the arm, None for full speed."""
        return slowest(self._bound_slowdown, self._elbow_slowdown)

    def late(self, now_ns: int) -> bool:
        """A check is overdue by a whole period."""
        return now_ns >= self.next_ns + PERIOD_NS // 2

    def update(
        self,
        measured_rad: FloatArray,
        commanded_rad: FloatArray | None,
        now_ns: int,
        *,
        in_joints: bool = False,
    ) -> LimitHit | None:
        """Check the bounds and the elbow in turn, one of them every half `PERIOD_NS`.

        Args:
            measured_rad: (n,) in chain order.
            commanded_rad: (n,) joint commands; None: poses are commanded.
            now_ns: time of this tick.
            in_joints: joints are commanded; then singularities do not matter.

        Returns:
            the bound for which the arm has to brake, None without one.
        """
        if now_ns < self.next_ns:
            return None
        self.next_ns = now_ns + PERIOD_NS // 2
        self._elbow_next = not self._elbow_next
        seen = measured_rad, commanded_rad, in_joints
        if self.slowdown is None and all(map(is_, seen, self._passed[self._elbow_next])):
            return None  # nothing moved since they passed this check
        if self._elbow_next:
            hit = self._bounds(measured_rad, in_joints=in_joints)
        else:
            hit = self._elbow(measured_rad, commanded_rad)
        self._passed[self._elbow_next] = seen if hit is None else _NOTHING
        return hit

    def _bounds(self, measured_rad: FloatArray, *, in_joints: bool) -> LimitHit | None:
        kinematics, barriers = self._reach.kinematics, self._reach.barriers
        ends = np.minimum(measured_rad - kinematics.lower_rad, kinematics.upper_rad - measured_rad)
        left = barriers.at(measured_rad, kinematics.jacobian(measured_rad))
        if in_joints:
            left[0] = np.inf
        left = np.concatenate([ends - self._stop[: len(ends)], left])
        before = left if self._edge is None else self._edge
        self._edge = np.minimum(np.maximum(before, left), left + self._band)
        nearer = self._edge < before
        past = np.where(nearer, left + self._past, 1.0)
        worst = int(np.argmin(past))
        if past[worst] < 0:
            stop = float(self._stop[worst])
            name, where = self._bound_name(worst)
            return LimitHit(name, float(left[worst]) + stop, stop, where=where)
        zone = np.maximum(self._slow - self._stop, 1e-12)
        shares = np.where(nearer, np.sqrt(np.clip(left / zone, 0.0, 1.0)), 1.0)
        worst = int(np.argmin(shares))
        name, where = self._bound_name(worst)
        value, limit = float(left[worst] + self._stop[worst]), float(self._slow[worst])
        self._bound_slowdown = _slowdown(name, float(shares[worst]), value, limit, where)
        return None

    def _elbow(self, measured_rad: FloatArray, commanded_rad: FloatArray | None) -> LimitHit | None:
        expected_rad = commanded_rad
        if expected_rad is None:
            start_rad = measured_rad if self._expected_rad is None else self._expected_rad
            pose = self._reach.kinematics.forward(measured_rad)
            expected_rad = self._expected_rad = self._reach.solve(pose, start_rad)
        if expected_rad is None:
            return None
        apart_rad = np.abs(measured_rad - expected_rad)
        worst = int(np.argmax(apart_rad / self._elbow_limits))
        self.elbow_rad, limit_rad = float(apart_rad[worst]), float(self._elbow_limits[worst])
        where = self._reach.kinematics.arm_joints[worst]
        if self.elbow_rad > 2 * limit_rad:
            return LimitHit("elbow_rad", self.elbow_rad, 2 * limit_rad, where=where)
        share = min(2.0 - self.elbow_rad / limit_rad, 1.0)
        self._elbow_slowdown = _slowdown("elbow_rad", share, self.elbow_rad, limit_rad, where)
        return None

    def _bound_name(self, index: int) -> tuple[str, str]:
        joints = self._reach.kinematics.arm_joints
        if index < len(joints):
            return "joint_limit", joints[index]
        index -= len(joints)
        return self._reach.barriers.names[index], self._reach.barriers.where(index)


def _each(
    of_joints: FloatArray, distances: int, of_singular: float, of_distance: float
) -> FloatArray:
    return np.concatenate([of_joints, [of_singular], [of_distance] * distances])


def _slowdown(name: str, share: float, value: float, limit: float, where: str) -> Slowdown | None:
    share = max(float(np.ceil(share * STEPS)) / STEPS, SLOWEST)
    return None if share >= 1.0 else Slowdown(name, share, value, limit, where)


JOINT_PATIENCE_S = 0.1
SAME_TCP_M, SAME_TCP_RAD = 0.005, 0.02
"""Largest difference of the TCP by kinematics from the TCP that the robot reports."""
HELD_RAD = 0.1
"""Largest distance of a joint from where its controller holds it."""


def joint_state_faults(
    profile: Profile,
    kinematics: Kinematics,
    joint: Stamped[JointState] | None,
    pose: Stamped[PoseState],
    now_ns: int,
) -> list[str]:
    """Whether the kinematics fit this robot: joints are received, their TCP is the reported one.

    Args:
        profile: the effective profile.
        kinematics: of the robot it describes.
        joint: newest joint state.
        pose: newest TCP pose.
        now_ns: same clock as the records' ``received_ns``.
    """
    if joint is None:
        return ["the joints are not known: nothing received on state/joint"]
    age_s = (now_ns - joint.received_ns) / 1e9
    if age_s > profile.timing.state_timeout_s + JOINT_PATIENCE_S:
        return [f"the joint state is {age_s:.2f} s old"]
    try:
        joints_rad = kinematics.joints_of(joint.record)
    except VlaZenohError as error:
        return [str(error)]
    apart_m, apart_rad = pose_distance(kinematics.forward(joints_rad), pose_of(pose.record))
    if apart_m <= SAME_TCP_M and apart_rad <= SAME_TCP_RAD:
        return _elbow_is_not_held(profile, joint.record, pose.record)
    return [
        f"the joints put the TCP {apart_m * 1e3:.1f} mm and {apart_rad:.3f} rad from where "
        "the robot reports it: robot.description or robot.tcp_frame is another robot's"
    ]


def _elbow_is_not_held(profile: Profile, joint: JointState, pose: PoseState) -> list[str]:
    """Whether joint commands would begin far from the measured joints.

    They begin where the robot's controller holds the joints. If the TCP is far from there the arm
    is blocked, and retreats with all its joints; otherwise only the elbow was moved, and would be
    pulled back.
    """
    if profile.robot.command != "joint" or joint.reference_rad is None:
        return []
    apart_m, apart_rad = pose_distance(held_pose(pose), pose_of(pose))
    if apart_m > profile.limits.tracking_m or apart_rad > profile.limits.tracking_rad:
        return []
    away_rad = np.abs(joint.reference_rad - joint.position_rad)
    worst = int(np.argmax(away_rad))
    if float(away_rad[worst]) <= HELD_RAD:
        return []
    return [
        f"joint {joint.names[worst]} is {away_rad[worst]:.2f} rad from where its controller holds "
        f"it, at most {HELD_RAD:g}: release the arm, or move the robot once by its own means"
    ]
