"""Joint positions that follow a stream of TCP poses: differential inverse kinematics.

Each tick takes one damped Newton step to the pose, as joint velocities within the limits of the
joints. With ``e`` the error from joints to target, ``v`` the target's twist and J# the inverse
damped near a singularity::

    feed      = J# v
    back      = J# e / dt - feed      bounded: can stop within J# e - feed dt
    qd_wanted = (feed + back) + (1 - J# J) kp (q_posture - q)

    J#        = J^T (J J^T + W)^-1,   W = wmax (1 - (s / s0)^2)^2 1 where s < s0, else 0

`feed` makes a smooth stream exact; the bound on `back` lets a far target be reached without
overshoot. One factor slows all joints to the velocity limits, and one to the acceleration limits.
Each joint follows its wanted velocity within its jerk limit ``j``: with ``r`` the rate of that
velocity and ``d`` the difference left beyond it, the acceleration is

    r + sign(d) a,   a dt + (a - j dt) dt + (a - 2 j dt) dt + ... = |d|

which returns to ``r`` as ``d`` vanishes. No joint exceeds its velocity limit, or the velocity from
which it can stop before the end of its range, in whole ticks and within both limits; a joint held
at its end is removed and the others continue without it. Towards a singularity all joints slow
down so that the singular value s falls no faster than ``ka (s - s_stop)``, and than a stop of all
joints together allows: an arm that slips through a singularity would come back in another branch.
Of each near constraint (a face of the box, a distance) the greatest rate of approach from which it
can be kept is computed; `nearest_velocities` keeps all of them at once.

Damping: Nakamura, Hanafusa, "Inverse kinematic solutions with singularity robustness", J. Dyn.
Sys. Meas. Control 108, 1986.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import daqp
import numpy as np

from vla_zenoh.control.limits import LimitHit, bound_norm, stop_s_of, workspace_corners
from vla_zenoh.control.reachability import Barriers
from vla_zenoh.kinematics.kinematics import Kinematics, pose_error, smallest_singular_value
from vla_zenoh.kinematics.so3 import Pose
from vla_zenoh.profile import Limits
from vla_zenoh.types import FloatArray, JointBound

POSTURE_1_S, POSTURE = 1.0, JointBound(0.2, 0.06)
"""Rate kp at which a redundant arm goes to its posture, and its greatest speed then."""
DAMPED_BELOW, DAMPING = 0.03, 4e-4
"""Singular value s0 below which the inverse is damped, and wmax, at a singularity."""
SINGULARITY_1_S = 5.0
"""ka, rate of the approach to a singularity."""
NEAR_END = JointBound(0.1, 0.03)
"""A joint further from the end of its range is not reported as held by it."""
ACCELERATION_HALVINGS = 8
"""Of the search for an acceleration: to 1/256 of the range allowed."""
NEAR_SHARE, FAR_SHARE = 0.7, 0.1
"""Part of the joints' acceleration and jerk for a far target, a distance constraint or a
singularity: they follow the pose besides. And for the first test whether a constraint is far."""
EXCESS_COST = 1e6
"""Cost of approaching a constraint too fast beside that of the TCP's motion."""
ELBOW_COST = 1e-2
"""Cost of a joint's motion beside that of the TCP's."""
BACK_JERK = 0.4
"""Rate of the correction in units of jerk over acceleration, at most one per tick."""
ROUNDING_RAD_S = 1e-9
"""A smaller excess of a velocity is rounding; smaller divisors would be noise."""
CONSTRAINED_M = 0.08
"""A pair further from its stop than this is no constraint until the next update."""
SINGULARITY_PEEK_RAD = 1e-3
"""Joint displacement for the rate of the singular value."""


class JointMotion(NamedTuple):
    """Motion of the joints, (n,) each.

    Args:
        position_rad: positions.
        velocity_rad_s: velocities.
        acceleration_rad_s2: during the tick before.
        wanted_rad_s: velocities wanted before the limits.
    """

    position_rad: FloatArray
    velocity_rad_s: FloatArray
    acceleration_rad_s2: FloatArray
    wanted_rad_s: FloatArray

    @classmethod
    def standing(cls, position_rad: FloatArray) -> JointMotion:
        """Standing there."""
        zeros = np.zeros(len(position_rad))
        return cls(np.array(position_rad, dtype=np.float64), zeros, zeros, zeros)


class DistanceConstraints:
    """Linear constraints on joint velocities: the faces of the TCP's box, and distances of the arm.

    Each constraint is a row ``g`` (n,) in m/rad and the distance left in m: joint velocities ``qd``
    reduce it at the rate ``g qd``. Distances of the arm to itself, the table and keep-outs are
    computed every few ticks and linear in between; their slope is the relative velocity of the two
    nearest points along the line between them.

    Args:
        limits: with the box of the TCP.
        barriers: of the arm; None: only the box.
    """

    def __init__(self, limits: Limits, barriers: Barriers | None) -> None:
        self._low_m, self._high_m = workspace_corners(limits)
        self._barriers = barriers
        self._at_rad: FloatArray | None = None
        self._near = np.zeros(0, dtype=np.intp)
        self._rows, self._left_m = np.zeros((0, 0)), np.zeros(0)

    def update(self, joints_rad: FloatArray) -> None:
        """Compute distances and slopes at these joints (n,)."""
        if self._barriers is None:
            return
        collisions, stop_m = self._barriers.collisions, self._barriers.stop[1:]
        distances_m = collisions.distances(joints_rad)
        self._near = near = np.flatnonzero(distances_m < stop_m + CONSTRAINED_M)
        self._at_rad = joints_rad
        self._rows = -collisions.gradients(joints_rad, near.tolist())
        self._left_m = (distances_m - stop_m)[near]

    def hit(self, row: int, left_m: float) -> LimitHit:
        """The constraint of this row as a limit that acted, `left_m` from the arm."""
        if row < 6 or self._barriers is None:
            return LimitHit("workspace", -left_m, 0.0)
        return self._barriers.hit(int(self._near[row - 6]) + 1, left_m)

    def at(
        self, joints_rad: FloatArray, position_m: FloatArray, jacobian: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Rows (m, n) and distances left (m,) at these joints (n,), their TCP and its Jacobian."""
        rows = [jacobian[:3], -jacobian[:3]]
        left_m = [self._high_m - position_m, position_m - self._low_m]
        if self._at_rad is not None and len(self._rows):
            rows.append(self._rows)
            left_m.append(self._left_m - self._rows @ (joints_rad - self._at_rad))
        return np.concatenate(rows), np.concatenate(left_m)


class JointFollower:
    """Joints that follow a TCP pose within joint limits and distance constraints.

    Args:
        kinematics: of the arm.
        posture_rad: (n,) preferred joints of a redundant arm.
        constraints: distances to keep; None: none.
        acceleration_rad_s2: greatest of every joint, one number or (n,).
        jerk_rad_s3: greatest of every joint; the default has no noticeable effect.
        velocity_rad_s: greatest of every joint, (n,); None: those of the URDF.
        margin_rad: kept from both ends of every joint's range, one number or (n,).
        singularity_stop: s_stop, below which the arm does not go by itself.
        lead: m and rad from the TCP to the furthest target that is followed as it is.
    """

    def __init__(
        self,
        kinematics: Kinematics,
        posture_rad: FloatArray,
        constraints: DistanceConstraints | None = None,
        *,
        acceleration_rad_s2: float | FloatArray = 10.0,
        jerk_rad_s3: float | FloatArray = 1e6,
        velocity_rad_s: FloatArray | None = None,
        margin_rad: float | FloatArray = 0.05,
        singularity_stop: float = 0.015,
        lead: tuple[float, float] = (math.inf, math.inf),
    ) -> None:
        self.kinematics, self.constraints = kinematics, constraints
        self.posture_rad = posture_rad
        self.acceleration_rad_s2 = np.full(kinematics.size, acceleration_rad_s2)
        self.jerk_rad_s3 = np.full(kinematics.size, jerk_rad_s3)
        self._ramp_s = float(np.max(self.acceleration_rad_s2 / self.jerk_rad_s3))
        self._back_1_s = BACK_JERK / self._ramp_s
        self.velocity_rad_s = (
            kinematics.velocity_rad_s if velocity_rad_s is None else velocity_rad_s
        )
        self.lower_rad = kinematics.lower_rad + margin_rad
        self.upper_rad = kinematics.upper_rad - margin_rad
        self._singularity_stop, self._lead = singularity_stop, lead
        self._near_end, self._posture = (
            NEAR_END.of(kinematics.slides),
            POSTURE.of(kinematics.slides),
        )

    def step(
        self, now: JointMotion, target: Pose, twist: FloatArray, dt_s: float
    ) -> tuple[JointMotion, list[LimitHit]]:
        """The joints one tick later, and the limits that acted.

        They keep to their ranges, velocities and accelerations, whatever the target: the pose of
        the TCP then, and its `twist` (6,), m/s and rad/s in base axes. One that is further than
        `lead` is followed as if it were so far in its direction. The limits are ``lead_m``,
        ``lead_rad``, ``joint_velocity``, ``joint_limit``, ``singularity``, and the distance
        constraints.
        """
        joints, velocity = now.position_rad, now.velocity_rad_s
        here, jacobian = self.kinematics.pose_and_jacobian(joints)
        way, (lead_m, lead_rad) = pose_error(target, here), self._lead
        way_m, hits = bound_norm("lead_m", way[:3], lead_m)
        turn, turned = bound_norm("lead_rad", way[3:], lead_rad)
        error, hits = np.concatenate([way_m, turn]), hits + turned
        singular_value = smallest_singular_value(jacobian)
        if singular_value < DAMPED_BELOW:
            hits.append(LimitHit("singularity", singular_value, DAMPED_BELOW))
        low, high = self._allowed(now, dt_s)
        held = np.zeros(len(joints), dtype=bool)
        onto = np.zeros(len(joints))
        while True:
            wanted = self._wanted(joints, jacobian, error, twist, singular_value, held, onto, dt_s)
            wanted *= self._share_near_singularity(joints, wanted, singular_value)
            ratio = float(np.max(np.abs(wanted) / self.velocity_rad_s))
            wanted /= max(ratio, 1.0)
            reached = self._reachable(wanted, now, dt_s)
            excess = np.where(held, 0.0, np.maximum(reached - high, low - reached))
            joint = int(np.argmax(excess))
            if excess[joint] <= ROUNDING_RAD_S:
                break
            held[joint] = True
            onto[joint] = min(max(reached[joint], low[joint]), high[joint])
            bound = self.upper_rad if reached[joint] > high[joint] else self.lower_rad
            place, name = float(joints[joint]), self.kinematics.arm_joints[joint]
            if abs(float(bound[joint]) - place) < self._near_end[joint]:
                hits.append(LimitHit("joint_limit", place, float(bound[joint]), where=name))
        if ratio > 1.0 + 1e-9:
            joint = int(np.argmax(np.abs(wanted) / self.velocity_rad_s))
            asked, limit = ratio * abs(float(wanted[joint])), float(self.velocity_rad_s[joint])
            name = self.kinematics.arm_joints[joint]
            hits.append(LimitHit("joint_velocity", asked, limit, where=name))
        reached, constrained = self._constrained(reached, low, high, now, here, jacobian, dt_s)
        acceleration = (reached - velocity) / dt_s
        motion = JointMotion(joints + reached * dt_s, reached, acceleration, wanted)
        return motion, hits + constrained

    def brake(self, now: JointMotion, dt_s: float) -> JointMotion:
        """The joints one tick later if they stop as soon as they can, all together.

        So the TCP keeps its direction. A distance constraint may reduce the braking of a joint, but
        never lets it speed up.
        """
        joints, velocity = now.position_rad, now.velocity_rad_s
        speed = np.maximum(np.abs(velocity), ROUNDING_RAD_S)
        slower = (
            np.minimum(_stoppable(speed, self.jerk_rad_s3, dt_s), self.acceleration_rad_s2) * dt_s
        )
        reached = velocity * (1.0 - min(float(np.min(slower / speed)), 1.0))
        here, jacobian = self.kinematics.pose_and_jacobian(joints)
        low, high = self._allowed(now, dt_s)
        least = np.minimum(high, np.maximum(low, np.minimum(velocity, 0.0)))
        most = np.maximum(low, np.minimum(high, np.maximum(velocity, 0.0)))
        reached, _ = self._constrained(reached, least, most, now, here, jacobian, dt_s)
        acceleration = (reached - velocity) / dt_s
        return JointMotion(joints + reached * dt_s, reached, acceleration, np.zeros(len(joints)))

    def _constrained(
        self,
        reached: FloatArray,
        low: FloatArray,
        high: FloatArray,
        now: JointMotion,
        here: Pose,
        jacobian: FloatArray,
        dt_s: float,
    ) -> tuple[FloatArray, list[LimitHit]]:
        """`reached`, within `low` and `high`, such that the arm can stop at each constraint.

        Changes the motion of the TCP as little as possible: moving the elbow costs least.
        """
        reached, hits = np.minimum(np.maximum(reached, low), high), []
        if self.constraints is None:
            return reached, hits
        rows, left_m = self.constraints.at(now.position_rad, here.position_m, jacobian)
        # A row of zeros, of what no joint moves, divides by rounding and not by zero.
        most, jerk = (
            np.maximum(FAR_SHARE * (np.abs(rows) @ limit), ROUNDING_RAD_S)
            for limit in (self.acceleration_rad_s2, self.jerk_rad_s3)
        )
        # A conservative test first, for all constraints at once.
        fastest = np.maximum(rows @ reached, 0.0) + most * most / jerk
        far = left_m > fastest * (dt_s + 2 * most / jerk + fastest / (2 * most))
        near = np.flatnonzero(~far & rows.any(axis=1)).tolist()
        if not near:
            return reached, hits
        rows, metric = rows[near], jacobian.T @ jacobian + ELBOW_COST * np.eye(len(reached))
        ways = np.linalg.solve(metric, rows.T)
        ways /= (rows.T * ways).sum(axis=0)
        # Joints that brake for one constraint have less for others, unless these lie on its way.
        others = 1.0 - np.clip(rows @ ways, 0.0, 1.0)
        others[rows @ reached <= 0] = 0.0
        efforts = np.maximum(np.abs(ways) @ (np.eye(len(near)) + others), ROUNDING_RAD_S)
        # How fast each constraint is approached, and could be after this tick.
        before = rows @ now.velocity_rad_s
        slowest = np.minimum(rows * low, rows * high).sum(axis=1)
        quickest = np.maximum(rows * low, rows * high).sum(axis=1)
        bounds = (
            left_m[near],
            before,
            (slowest - before) / dt_s,
            (quickest - before) / dt_s,
            NEAR_SHARE * (self.acceleration_rad_s2[:, None] / efforts).min(axis=0),
            NEAR_SHARE * (self.jerk_rad_s3[:, None] / efforts).min(axis=0),
        )
        change = [_towards_end(*one, dt_s=dt_s) for one in np.stack(bounds, axis=1).tolist()]
        allowed = before + np.array(change) * dt_s
        too_fast = np.flatnonzero(rows @ reached > allowed + ROUNDING_RAD_S)
        if not len(too_fast):
            return reached, hits
        hits = [self.constraints.hit(near[row], float(left_m[near[row]])) for row in too_fast]
        return nearest_velocities(reached, metric, rows, allowed, low, high), hits

    def _wanted(
        self,
        joints: FloatArray,
        jacobian: FloatArray,
        error: FloatArray,
        twist: FloatArray,
        singular_value: float,
        held: FloatArray,
        onto: FloatArray,
        dt_s: float,
    ) -> FloatArray:
        posture = POSTURE_1_S * (self.kinematics.nearest(self.posture_rad, joints) - joints)
        posture /= max(float((np.abs(posture) / self._posture).max()), 1.0)
        free = jacobian
        if held.any():
            posture = np.where(held, 0.0, posture)
            free = np.where(held, 0.0, jacobian)
            singular_value = smallest_singular_value(free)
        taken = jacobian @ onto
        damping = 1e-12
        if singular_value < DAMPED_BELOW:
            share = 1.0 - (singular_value / DAMPED_BELOW) ** 2
            damping += DAMPING * share * share
        right = np.stack([error / dt_s - taken, twist - taken, free @ posture], axis=1)
        solved = free.T @ np.linalg.solve(free @ free.T + damping * np.eye(6), right)
        whole, feed = solved[:, 0], solved[:, 1]
        back = min(1.0, self._back_1_s * dt_s) * (whole - feed)
        most = _stoppable(np.abs(back) * dt_s, NEAR_SHARE * self.acceleration_rad_s2, dt_s)
        excess = float(np.max(np.abs(back) / np.maximum(most, 1e-12)))
        if excess > 1.0:
            back = back / excess
        return np.where(held, onto, feed + back + posture - solved[:, 2])

    def _share_near_singularity(
        self, joints: FloatArray, wanted: FloatArray, singular_value: float
    ) -> float:
        """Factor on `wanted` at which a singularity is approached slowly enough."""
        speed = np.maximum(np.abs(wanted), ROUNDING_RAD_S)
        fastest, left = float(speed.max()), singular_value - self._singularity_stop
        # A stop of all joints together takes this and a ramp, and goes as far as half of that.
        slows_s, ramp_s = float(np.max(speed / self.acceleration_rad_s2)), self._ramp_s
        if left > fastest * max(1 / SINGULARITY_1_S, slows_s + ramp_s):  # at 1 per radian
            return 1.0
        ahead = joints + wanted * (SINGULARITY_PEEK_RAD / fastest)
        after = smallest_singular_value(self.kinematics.jacobian(ahead))
        fall_1_s = (singular_value - after) / SINGULARITY_PEEK_RAD * fastest
        if fall_1_s <= 0.0:
            return 1.0
        room_s = max(left, 0.0) / fall_1_s
        root_s = math.hypot(ramp_s, math.sqrt(8 * NEAR_SHARE * slows_s * room_s))
        return min(SINGULARITY_1_S * room_s, (root_s - ramp_s) / (2 * slows_s), 1.0)

    def _reachable(self, wanted: FloatArray, now: JointMotion, dt_s: float) -> FloatArray:
        """Velocity (n,) after one tick towards `wanted`, without overshoot later."""
        velocity, most = now.velocity_rad_s, self.acceleration_rad_s2
        rate = (wanted - now.wanted_rad_s) / dt_s
        rate = np.minimum(np.maximum(rate, -most), most)
        left = wanted - velocity - rate * dt_s
        acceleration = rate + np.copysign(_stoppable(np.abs(left), self.jerk_rad_s3, dt_s), left)
        excess = float(np.max(np.abs(acceleration) / most))
        return velocity + acceleration * (dt_s / max(excess, 1.0))

    def _allowed(self, now: JointMotion, dt_s: float) -> tuple[FloatArray, FloatArray]:
        """Least and greatest velocities (n,) of the joints one tick later.

        Within jerk and acceleration, and such that each joint can stay within its velocity and
        range. Where these conflict (a joint outside its range, or too fast) the former win.
        """
        joints, velocity, before, _ = now
        jerk, most = self.jerk_rad_s3, self.acceleration_rad_s2
        tick = jerk * dt_s
        least = np.maximum(np.minimum(before - tick, most), -most)
        greatest = np.minimum(np.maximum(before + tick, -most), most)
        top, limit, ramp_s = [], self.velocity_rad_s, most / jerk
        for sign, bound in ((1.0, self.upper_rad), (-1.0, self.lower_rad)):
            room = limit - sign * velocity
            high = np.where(room >= 0, _stoppable(np.maximum(room, 0.0), jerk, dt_s), room / dt_s)
            left = sign * (bound - joints)
            # A joint gets faster until the jerk has ended its acceleration.
            fastest = np.maximum(sign * velocity, 0.0) + most * (dt_s + ramp_s)
            near = left < fastest * (dt_s + ramp_s + fastest / (2 * most))
            ends = (least, greatest) if sign > 0 else (-greatest, -least)
            for joint in np.flatnonzero(near):
                known = left, sign * velocity, *ends, most, jerk
                end = _towards_end(*(float(values[joint]) for values in known), dt_s=dt_s)
                high[joint] = min(high[joint], end)
            top.append(high)
        high = np.maximum(np.minimum(greatest, top[0]), least)
        low = np.minimum(np.maximum(least, -top[1]), greatest)
        return velocity + np.minimum(low, high) * dt_s, velocity + high * dt_s


def nearest_velocities(
    wanted: FloatArray,
    metric: FloatArray,
    rows: FloatArray,
    allowed: FloatArray,
    low: FloatArray,
    high: FloatArray,
) -> FloatArray:
    """Joint velocities (n,) within ``[low, high]`` that approach no constraint faster than allowed.

    Those nearest to `wanted`: a quadratic program, in which constraints that no joint velocities
    within their bounds meet are exceeded by as little as possible, ``s`` (m,)::

        min  (qd - wanted)^T metric (qd - wanted) + EXCESS_COST |s|^2
        rows qd - s <= allowed,   low <= qd <= high

    Args:
        wanted: (n,) rad/s.
        metric: (n, n) cost of a change.
        rows: (m, n) constraints, m/rad.
        allowed: (m,) m/s.
        low: (n,) rad/s.
        high: (n,) rad/s.
    """
    size, count = len(wanted), len(rows)
    cost = np.zeros((size + count, size + count))
    cost[:size, :size] = metric
    cost[size:, size:] = EXCESS_COST * np.eye(count)
    linear = np.concatenate([-metric @ wanted, np.zeros(count)])
    no_bound = np.full(count, np.inf)
    upper = np.concatenate([high, no_bound, allowed])
    lower = np.concatenate([low, -no_bound, -no_bound])
    solution, _, flag, _ = daqp.solve(
        cost, linear, np.concatenate([rows, -np.eye(count)], axis=1), upper, lower
    )
    if flag < 1:  # rounding let it cycle: every joint brakes as hard as it can
        return np.minimum(np.maximum(0.0, low), high)
    return np.minimum(np.maximum(solution[:size], low), high)


def _towards_end(
    left: float,
    velocity: float,
    least: float,
    greatest: float,
    most: float,
    jerk: float,
    dt_s: float,
) -> float:
    """Greatest acceleration after which a motion towards an end can still stop within `left`.

    Between `least` and `greatest`; the stop has the acceleration `most` and the jerk `jerk`.
    """

    def fits(acceleration: float) -> bool:
        after = velocity + acceleration * dt_s
        return after * dt_s + _stop_way(after, acceleration, most, jerk) <= max(left, 0.0)

    if fits(greatest):
        return greatest
    low, high = least, greatest
    for _ in range(ACCELERATION_HALVINGS):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if fits(middle) else (low, middle)
    return low


def _stop_way(velocity: float, acceleration: float, most: float, jerk: float) -> float:
    """Stopping distance within an acceleration and a jerk."""
    if velocity <= 0 and acceleration <= 0:
        return 0.0
    # Relative to when its acceleration becomes zero, or was zero.
    ramp_s = abs(acceleration) / jerk
    fastest = velocity + 0.5 * abs(acceleration) * ramp_s
    if fastest <= 0:
        return 0.0
    if acceleration > 0:
        before = velocity * ramp_s + acceleration * ramp_s**2 / 3
    else:
        before = acceleration * ramp_s**2 / -6 - fastest * ramp_s
    return max(before + fastest * stop_s_of(fastest, most, jerk) / 2, 0.0)


def _stoppable(distance: FloatArray, acceleration: FloatArray, dt_s: float) -> FloatArray:
    """Greatest velocity from which joints that change it once per tick stop within `distance`.

    After ``v dt`` come ``(v - a dt) dt``, ``(v - 2 a dt) dt``, ...: with k whole ticks of braking
    ``distance = (k + 1) v dt - k (k + 1) / 2 a dt^2``.
    """
    unit = acceleration * (dt_s * dt_s)
    ticks = np.floor(np.sqrt(0.25 + 2.0 * distance / unit) - 0.5)
    return (distance / (ticks + 1.0) + 0.5 * ticks * unit) / dt_s
