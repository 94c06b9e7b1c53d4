"""What must hold in every run of the motion fuzz, each with its tolerance.

A violation is told once a run and property, with its worst size.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from motion_case import Case
from motion_rig import HAS_SPEED, Tick, Trace
from numpy.typing import NDArray

from vla_zenoh.control.limits import ROTATION_BOX, joint_motion_limits, motion_limits
from vla_zenoh.guard.reference_governor import BRAKE_MARGIN

Array = NDArray[np.float64]

LIMIT_RTOL, JERK_RTOL = 1e-3, 1e-2
"""Of velocity and acceleration; of jerk."""
JOINT_JERK = 1.2
GUARD_RTOL, GUARD_TURN = 1e-2, {"velocity": 0.04, "acceleration": 0.04, "jerk": 0.15}
"""Of what the robot is sent; of rotations, whose axes turn meanwhile."""
WANDER_M, WANDER_RAD = 1e-5, 1e-5
"""An axis at its goal, a path beyond its ends, a line."""
OUTSIDE_M = 1e-4
"""Beyond the workspace box, of command and goal."""
LEAD_M, LEAD_RAD = 1e-4, 1e-3
"""Beyond the leash."""
SAME = 2e-7
"""m and rad: a goal that moves less is told to stay; float32 has 3e-8 of 0.5 m."""
THERE, STILL, CALM = 1e-6, 1e-6, 1e-3
"""m or rad, m/s or rad/s, m/s^2 or rad/s^2: what stands at its goal."""
REST, JOINT_REST = 1e-6, 1e-3
"""m/s or rad/s of a command that stands."""
STOP_S, JOINT_STOP_S, JOINT_LONGER = 0.03, 0.12, 2.0
"""A stop may take this much longer than the limits need; of joints, times that, and their elbow's
pull has to fade."""
PULL_1_S, PULL_JERK = 25.0, 0.28
SLOWER_S = 0.1
"""A lower speed is kept after the time a stop takes and this."""


class Violation(NamedTuple):
    """What did not hold.

    Args:
        name: of the property.
        tick: where it was worst.
        size: how bad; in the property's unit.
        unit: of that.
        count: ticks.
        note: for people.
    """

    name: str
    tick: int
    size: float
    unit: str
    count: int = 1
    note: str = ""


class Judge:
    """Judges one run.

    Args:
        case: the run.
        trace: what came of it.
    """

    def __init__(self, case: Case, trace: Trace) -> None:
        self._case, self._trace = case, trace
        self._limits = case.profile.limits
        self.found: list[Violation] = []
        ticks = trace.ticks
        self._at = np.array([i for i, tick in enumerate(ticks) if tick.record is not None], int)
        self._told: list[Tick] = [ticks[i] for i in self._at]
        self._time_s = np.array([(t.time_ns - ticks[0].time_ns) / 1e9 for t in self._told])
        # Consecutive calls, of which the second goes on from the first. A command begins at the
        # set-point that the robot tells, so a step from it to a false one is the robot's.
        anew = np.array([t.anchored and (t.misled or not t.followed) for t in self._told], bool)
        self._goes_on = (np.diff(self._at) == 1) & ~anew[1:]
        self._states = np.array([t.state for t in self._told])
        self._active = self._states == "active"
        self._retreats = np.array([t.retreats for t in self._told], bool)

    def judge(self) -> list[Violation]:
        """All that did not hold."""
        trace = self._trace
        if trace.failed is not None:
            self.found.append(Violation("exception", trace.failed[0], 1.0, "", 1, trace.failed[1]))
        if trace.faults:
            at, why = trace.faults[0]
            self.found.append(Violation("FAULT", at, 1.0, "", len(trace.faults), why))
        for name in dict.fromkeys(name for _, name, *_ in trace.broken):
            of_name = [each for each in trace.broken if each[1] == name]
            at, _, size, unit = max(of_name, key=lambda each: each[2])
            self.found.append(Violation(name, at, size, unit, len(of_name)))
        if len(self._told) > 3:
            if self._case.joint:
                self._joints()
            else:
                self._poses()
            self._goals()
        if len(trace.references) > 3:
            self._guard()
        return self.found

    # -- commands -----------------------------------------------------------------------------
    def _poses(self) -> None:
        records = [t.record for t in self._told]
        self._position_m = np.array([r.position_m for r in records])
        self._rotation = from_quat(np.array([r.quat_xyzw for r in records]))
        twist = np.array([r.twist for r in records])
        acceleration = np.array([r.acceleration for r in records])
        most = motion_limits(self._limits)
        way, spin = most.translation, most.rotation
        turned = log_of(np.einsum("nij,nkj->nik", self._rotation[1:], self._rotation[:-1]))
        moved = np.diff(self._position_m, axis=0)
        for name, values, change, limit, size in (
            ("translation", moved, (twist[:, :3], acceleration[:, :3]), way, np.abs),
            ("rotation", turned, (twist[:, 3:], acceleration[:, 3:]), spin, norms),
        ):
            self._differences(name, values, *change, limit, size, JERK_RTOL)
        self._stops(self._stop_s(twist, acceleration), norms(twist)[:, 0], REST)
        if HAS_SPEED:
            everywhere = np.ones(len(twist), bool)
            self._slower(self._over_speed(twist), everywhere, self._stop_s(twist, acceleration))
        self._box("command outside the box", self._position_m)
        self._wandering(twist, acceleration)
        self._ways(twist, acceleration)
        self._lines(twist)

    def _joints(self) -> None:
        records = [t.record for t in self._told]
        position, velocity, acceleration = (
            np.array([getattr(r, name) for r in records])
            for name in ("position_rad", "velocity_rad_s", "acceleration_rad_s2")
        )
        most = joint_motion_limits(self._case.profile)
        moved = np.diff(position, axis=0)
        self._differences("joint", moved, velocity, acceleration, most, np.abs, JOINT_JERK - 1.0)
        arm = self._case.arm
        beyond = np.maximum(arm.lower_rad - position, position - arm.upper_rad).max(axis=1)
        self._tell("joint beyond its range", beyond, 1e-9, "rad")
        if self._case.in_joints:
            self._joint_goals(position)
        places = [arm.forward(joints) for joints in position]
        self._position_m = np.array([place.position_m for place in places])
        self._rotation = np.array([place.rotation for place in places])
        self._box("command outside the box", self._position_m)
        fade_s = 8 / min(PULL_1_S, (float(most.jerk_rad_s3.min()) / PULL_JERK) ** 0.5)
        needed_s = np.abs(velocity) / most.acceleration_rad_s2
        needed_s += most.acceleration_rad_s2 / most.jerk_rad_s3
        needed_s = JOINT_LONGER * needed_s.max(axis=1) + JOINT_STOP_S + fade_s
        speed = np.abs(velocity).max(axis=1)
        self._stops(needed_s, speed, JOINT_REST)
        if HAS_SPEED:  # what the joints' own limits allow at another speed is not said
            stands = np.array([t.percent == 0.0 for t in self._told])
            moves = np.where(stands, np.maximum(speed - JOINT_REST, 0.0), 0.0)
            self._slower(moves, stands, needed_s)

    def _joint_goals(self, position: Array) -> None:
        """A goal of joints is on the leash."""
        sizes = np.zeros(len(self._told))
        late_s = np.diff(self._time_s, prepend=self._time_s[:1])
        for i, tick in enumerate(self._told):
            if tick.goal_rad is not None and tick.state == "active":
                ahead_rad = float(np.abs(tick.goal_rad - position[i]).max())
                sizes[i] = ahead_rad - self._limits.lead_rad - 3.0 * late_s[i]
        self._tell("goal leads: joints", sizes, LEAD_RAD, "rad over")

    def _differences(
        self,
        name: str,
        moved: Array,
        velocity: Array,
        acceleration: Array,
        limits: Any,
        size: Any,
        jerk_rtol: float,
    ) -> None:
        """Of every order: what is told, what it changes by, and what the positions say."""
        step_s = np.diff(self._time_s)[:, None]
        ok = self._goes_on
        # Differences of differences, where all of them are one period long and go on.
        period_s = 1.0 / self._case.profile.timing.command_hz
        even = ok & (np.abs(step_s[:, 0] - period_s) < 0.1 * period_s)
        two, three = even[1:] & even[:-1], even[2:] & even[1:-1] & even[:-2]
        v, a, j = "velocity", "acceleration", "jerk"
        told, place = "as told", "by its positions"
        rows = (
            (v, 0, LIMIT_RTOL, velocity, None, 0, told),
            (v, 0, LIMIT_RTOL, moved / step_s, ok, 1, place),
            (a, 1, LIMIT_RTOL, acceleration, None, 0, told),
            (a, 1, LIMIT_RTOL, np.diff(velocity, axis=0) / step_s, ok, 1, "by its velocities"),
            (a, 1, LIMIT_RTOL, np.diff(moved, axis=0) / period_s**2, two, 2, place),
            (j, 2, jerk_rtol, np.diff(acceleration, axis=0) / step_s, ok, 1, told),
            (j, 2, jerk_rtol, np.diff(moved, 2, axis=0) / period_s**3, three, 3, place),
        )
        worst: dict[str, Violation] = {}
        for order, index, rtol, values, where, shift, source in rows:
            share = (size(values) / np.asarray(limits[index])).max(axis=1)
            if where is not None:
                share = np.where(where, share, 0.0)
            many = int((share > 1.0 + rtol).sum())
            if many:
                at, title = int(share.argmax()), f"command {name} {order}"
                if any(t.anchored for t in self._told[at : at + shift + 1]):
                    source += ", at an activation"
                found = Violation(
                    title, int(self._at[at + shift]), float(share[at]), "x limit", many, source
                )
                if title not in worst or worst[title].size < found.size:
                    worst[title] = found
        self.found += worst.values()

    def _tell(self, name: str, sizes: Array, limit: float, unit: str, factor: float = 1.0) -> None:
        """`sizes` of every command, beyond `limit` or not."""
        many = int((sizes > limit).sum())
        if many:
            at = int(sizes.argmax())
            self.found.append(
                Violation(name, int(self._at[at]), float(sizes[at]) * factor, unit, many)
            )

    # -- box and leash ------------------------------------------------------------------------
    def _outside(self, position_m: Array) -> Array:
        box = self._limits.workspace
        low, high = np.array([box.x_m, box.y_m, box.z_m]).T
        inside = np.clip(position_m, low, high)
        return np.linalg.norm(position_m - inside, axis=1)

    def _box(self, name: str, position_m: Array) -> None:
        """Beyond the box, and beyond where the arm was when it was activated."""
        out = self._outside(position_m)
        begun = np.array([t.anchored for t in self._told]) | np.append(True, np.diff(self._at) > 1)
        # The stream's own first place where it begins; where it goes on it was there before.
        commanded = self._outside(self._position_m)
        excused = commanded[np.maximum.accumulate(np.where(begun, np.arange(len(begun)), 0))]
        self._tell(name, out - excused, OUTSIDE_M, "mm", 1e3)

    def _goals(self) -> None:
        told = [
            (i, t.goal, t.record)
            for i, t in enumerate(self._told)
            if t.goal is not None and t.state == "active"
        ]
        if not told:
            return
        where = np.array([i for i, _, _ in told])
        goal_m = np.array([goal.position_m for _, goal, _ in told])
        goal_rotation = np.array([goal.rotation for _, goal, _ in told])
        whole_m = np.array(self._position_m)
        whole_m[where] = goal_m
        self._box("goal outside the box", whole_m)
        ahead_m = np.linalg.norm(goal_m - self._position_m[where], axis=1)
        turn = log_of(np.einsum("nij,nkj->nik", goal_rotation, self._rotation[where]))
        if self._case.in_joints and self._case.joint:
            return  # its leash is on the joints
        # Where a late tick takes the arm is foreseen with the acceleration it had.
        late_s = np.diff(self._time_s, prepend=self._time_s[:1])[where]
        foreseen = motion_limits(self._limits).translation[2] * late_s**3 / 3
        for name, values, limit, tolerance, unit, factor in (
            ("lead_m", ahead_m, self._limits.lead_m, LEAD_M, "mm over", 1e3),
            ("lead_rad", norms(turn)[:, 0], self._limits.lead_rad, LEAD_RAD, "mrad over", 1e3),
        ):
            sizes = np.zeros(len(self._told))
            sizes[where] = np.maximum(values - limit - foreseen, 0.0)
            self._tell(f"goal leads: {name}", sizes, tolerance, unit, factor)

    # -- stops --------------------------------------------------------------------------------
    def _stop_s(self, twist: Array, acceleration: Array) -> Array:
        """(n,) what the limits need to come to rest, each axis by itself."""
        box = axis_limits(self._limits)
        spun = np.einsum("nji,nj->ni", self._rotation, twist[:, 3:])
        change = np.einsum("nji,nj->ni", self._rotation, acceleration[:, 3:])
        v, a = np.hstack([twist[:, :3], spun]), np.hstack([acceleration[:, :3], change])
        return (
            stop_time_s(v, a, box).max(axis=1)
            + STOP_S
            + 2 * (1.0 / self._case.profile.timing.command_hz)
        )

    def _stops(self, needed_s: Array, speed: Array, rest: float) -> None:
        sizes = np.zeros(len(self._told))
        ends = np.flatnonzero(self._active[:-1] & ~self._active[1:]) + 1
        for at in ends:
            later = np.flatnonzero(self._active[at:] | np.append(False, ~self._goes_on[at:]))
            end = at + int(later[0]) if len(later) else len(sizes)
            due_s = self._time_s[at - 1] + needed_s[at - 1]
            moving = (self._time_s[at:end] > due_s) & (speed[at:end] > rest)
            moving &= ~np.logical_or.accumulate(self._retreats[at:end])
            sizes[at:end] = np.where(moving, speed[at:end], 0.0)
        self._tell("still moves after a stop", sizes, 0.0, "m/s or rad/s")

    def _slower(self, over: Array, applies: Any, needed_s: Array) -> None:
        """Nothing is `over` what a speed allows, as soon as a stop would have been done.

        A retreat has a speed of its own, and so has the brake at its end.
        """
        retreats = np.array([t.retreats for t in self._told])
        ended = np.flatnonzero(retreats)
        for at in ended[np.append(np.diff(ended) > 1, True)[: len(ended)]]:
            retreats |= (np.arange(len(over)) > at) & (
                self._time_s <= self._time_s[at] + needed_s[at] + SLOWER_S
            )
        percent = np.array([t.percent for t in self._told])
        set_at = np.append(0, np.flatnonzero(np.diff(percent) != 0) + 1)
        sizes = np.zeros(len(over))
        for at, end in zip(set_at, [*set_at[1:], len(over)], strict=True):
            due_s = self._time_s[at] + needed_s[max(at - 1, 0)] + SLOWER_S
            late = (self._time_s[at:end] > due_s) & (applies & ~retreats)[at:end]
            sizes[at:end] = np.where(late, over[at:end], 0.0)
        self._tell("faster than the speed that was set", sizes, 1e-5, "over")

    def _over_speed(self, twist: Array) -> Array:
        """(n,) share of the speed limits beyond what the speed in force allows."""
        most = motion_limits(self._limits)
        share = np.maximum(
            np.abs(twist[:, :3]).max(axis=1) / most.translation[0],
            norms(twist[:, 3:])[:, 0] / most.rotation[0],
        )
        percent = np.array([t.percent for t in self._told])
        return share - percent / 100.0 * (1 + JERK_RTOL)

    # -- paths --------------------------------------------------------------------------------
    def _goal_arrays(self) -> tuple[Array, Array]:
        goal_m, rotation = np.array(self._position_m), np.array(self._rotation)
        for index, tick in enumerate(self._told):
            if tick.goal is not None:
                goal_m[index], rotation[index] = tick.goal
        return goal_m, rotation

    def _wandering(self, twist: Array, acceleration: Array) -> None:
        """An axis that stands at its goal and is told to stay stays."""
        goal_m, goal_rotation = self._goal_arrays()
        usable = self._active & np.append(True, self._goes_on)
        sizes = np.zeros(len(goal_m))
        for axis in range(3):
            columns = (goal_m, self._position_m, twist, acceleration)
            away = wander(*(column[:, axis] for column in columns), usable)
            sizes = np.maximum(sizes, away)
        self._tell("an axis at its goal wanders", sizes, WANDER_M, "mm", 1e3)
        # Rotation as a whole: how far it is from a goal that stays.
        turns = log_of(np.einsum("nji,njk->nik", goal_rotation[:-1], goal_rotation[1:]))
        drift = np.append(0.0, np.cumsum(norms(turns)[:, 0]))
        off = norms(log_of(np.einsum("nji,njk->nik", goal_rotation, self._rotation)))[:, 0]
        spin, change = norms(twist[:, 3:])[:, 0], norms(acceleration[:, 3:])[:, 0]
        away = wander(drift, drift + off, spin, change, usable)
        self._tell("a rotation at its goal wanders", away, WANDER_RAD, "mrad", 1e3)

    def _ways(self, twist: Array, acceleration: Array) -> None:
        """Every axis stays between its start, its goal and where a brake would have ended."""
        goal_m, goal_rotation = self._goal_arrays()
        usable = self._active & np.append(False, self._goes_on)
        usable &= np.append(False, self._active[:-1])
        fresh = np.append(True, np.abs(np.diff(goal_m, axis=0)).max(axis=1) > 1e-10)
        turned = log_of(np.einsum("nji,njk->nik", self._rotation[:-1], goal_rotation[1:]))
        fresh |= np.append(True, norms(np.diff(goal_rotation.reshape(-1, 9), axis=0))[:, 0] > 1e-10)
        percent = np.array([tick.percent for tick in self._told])
        fresh |= np.append(True, ~usable[:-1]) | np.append(True, np.diff(percent) != 0)
        fresh &= usable
        begins = np.flatnonzero(fresh)
        if not len(begins):
            return
        before = begins - 1
        body = self._rotation[before].transpose(0, 2, 1)
        place = self._position_m[before]
        motion = [
            np.hstack([part[before, :3], np.einsum("nij,nj->ni", body, part[before, 3:])])
            for part in (twist, acceleration)
        ]
        ahead = np.hstack([goal_m[begins] - place, turned[before]])
        limits = axis_limits(self._limits)
        low, high = ends_of(*motion, ahead, limits)
        # At a lower speed the same path takes longer: braking takes the way it takes at full speed.
        shares = percent[begins] / 100.0
        for share in set(shares.tolist()) - {0.0, 1.0}:
            its = shares == share
            slow = limits * share ** np.array([[1.0], [2.0], [3.0]])
            moved = [part[its] for part in (*motion, ahead)]
            for more in (None, unreversed(*moved[:2], slow, limits)):
                down, up = ends_of(*moved, slow, more)
                low[its], high[its] = np.minimum(low[its], down), np.maximum(high[its], up)
        # An axis whose own goal stays keeps the ends it had.
        stays = np.abs(goal_m[begins[1:]] - goal_m[begins[1:] - 1]) <= 1e-10
        stays &= usable[begins[1:] - 1, None]
        low, high = low[:, :3] + place, high[:, :3] + place
        for n, kept in enumerate(stays):
            low[n + 1] = np.where(kept, np.minimum(low[n], low[n + 1]), low[n + 1])
            high[n + 1] = np.where(kept, np.maximum(high[n], high[n + 1]), high[n + 1])
        which = np.cumsum(fresh) - 1
        inside = usable & (which >= 0)
        where = self._position_m[inside]
        beyond = np.maximum(low[which[inside]] - where, where - high[which[inside]])
        sizes = np.zeros(len(goal_m))
        sizes[inside] = beyond.max(axis=1)
        self._tell("a way leaves its ends", sizes, WANDER_M, "mm", 1e3)

    def _lines(self, twist: Array) -> None:
        """While goals stay on a line from where the arm stood, so does the arm."""
        goal_m, goal_rotation = self._goal_arrays()
        # A motion turns round at the speed override's part of the speed.
        speed = np.array([tick.percent for tick in self._told]) / 100.0
        stands = np.abs(twist[:, :3]).max(axis=1) <= STILL * speed
        # The arm does not turn meanwhile: what turns it may take its own time.
        turns = np.append(True, norms(np.diff(goal_rotation.reshape(-1, 9), axis=0))[:, 0] > SAME)
        turns |= np.abs(twist[:, 3:]).max(axis=1) > STILL
        moves = np.append(True, norms(np.diff(goal_m, axis=0))[:, 0] > 1e-9)
        sizes = np.zeros(len(goal_m))
        origin = line = None
        for i in range(1, len(goal_m)):
            on = self._active[i] and self._active[i - 1] and self._goes_on[i - 1]
            if turns[i] or not on:
                origin = line = None
                continue
            place = self._position_m[i]
            if origin is None:
                before = self._position_m[i - 1]
                if stands[i - 1] and np.abs(before - goal_m[i - 1]).max() < THERE and moves[i]:
                    origin, line = before, None
            if origin is None:
                continue
            if moves[i] or line is None:
                ahead = goal_m[i] - origin
                length = float(np.linalg.norm(ahead))
                if line is None:
                    line = ahead / length if length > 1e-3 else None
                if line is None or np.linalg.norm(ahead - (ahead @ line) * line) > SAME / 2:
                    origin = line = None
                    continue
            apart = place - origin
            sizes[i] = np.linalg.norm(apart - (apart @ line) * line)
        self._tell("a straight motion leaves its line", sizes, WANDER_M, "mm", 1e3)

    # -- the guard ----------------------------------------------------------------------------
    def _guard(self) -> None:
        trace, dt_s = self._trace, 1.0 / self._case.guard_hz
        if self._case.joint:
            place = np.array([r.position_rad for r in trace.references])
            limits = joint_motion_limits(self._case.profile, BRAKE_MARGIN)
            self._guard_rows("joint", np.diff(place, axis=0), limits, np.abs, dt_s)
            return
        place = np.array([r.position_m for r in trace.references])
        rotation = np.array([r.rotation for r in trace.references])
        turned = log_of(np.einsum("nij,nkj->nik", rotation[1:], rotation[:-1]))
        most = motion_limits(self._limits)
        for name, moved, limits, size in (
            ("translation", np.diff(place, axis=0), most.translation, np.abs),
            ("rotation", turned, most.rotation, norms),
        ):
            doubled = [BRAKE_MARGIN * value for value in limits]
            self._guard_rows(name, moved, doubled, size, dt_s)

    def _guard_rows(self, name: str, moved: Array, limits: Any, size: Any, dt_s: float) -> None:
        if not np.isfinite(moved).all():
            self.found.append(Violation("guard gives NaN", 0, 1.0, ""))
            return
        for order, word in enumerate(("velocity", "acceleration", "jerk")):
            values = np.diff(moved, order, axis=0) / dt_s ** (order + 1)
            share = (size(values) / np.asarray(limits[order])).max(axis=1)
            more = GUARD_TURN[word] if name == "rotation" else GUARD_RTOL
            many = int((share > 1 + more).sum())
            if many:
                at = int(share.argmax())
                tick = max(self._trace.guard_tick[at + order + 1], 0)
                self.found.append(
                    Violation(f"guard {name} {word}", tick, float(share[at]), "x limit", many)
                )


# -- arithmetic -------------------------------------------------------------------------------
def norms(vectors: Array) -> Array:
    """(n, 1) lengths."""
    return np.linalg.norm(vectors, axis=1, keepdims=True)


def from_quat(quat_xyzw: Array) -> Array:
    """(n, 3, 3)."""
    x, y, z, w = (quat_xyzw / norms(quat_xyzw)).T
    rows = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)),
        (2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)),
        (2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)),
    )
    return np.array(rows).transpose(2, 0, 1)


def log_of(rotation: Array) -> Array:
    """(n, 3) rotation vectors, of angles below pi."""
    skew = 0.5 * np.stack(
        [
            rotation[:, 2, 1] - rotation[:, 1, 2],
            rotation[:, 0, 2] - rotation[:, 2, 0],
            rotation[:, 1, 0] - rotation[:, 0, 1],
        ],
        axis=1,
    )
    sine = np.linalg.norm(skew, axis=1)
    angle = np.arctan2(sine, 0.5 * (np.trace(rotation, axis1=1, axis2=2) - 1.0))
    return skew * np.where(sine > 1e-9, angle / np.maximum(sine, 1e-300), 1.0)[:, None]


def axis_limits(limits: Any) -> Array:
    """(3, 6) velocity, acceleration and jerk of every axis."""
    most = motion_limits(limits)
    return np.array(
        [[t] * 3 + [r * ROTATION_BOX] * 3 for t, r in zip(*most, strict=True)], dtype=np.float64
    )


def stop_time_s(v: Array, a: Array, limits: Array) -> Array:
    """What the shortest jerk-limited stop of each axis takes, or a little more."""
    _, most, jerk = limits
    left = np.abs(v + a * np.abs(a) / (2 * jerk))
    long = left * jerk > most * most
    turn_s = np.where(long, left / most + most / jerk, 2 * np.sqrt(left / jerk))
    return np.abs(a) / jerk + turn_s


def brake_range(p: Array, v: Array, a: Array, limits: Array) -> tuple[Array, Array]:
    """The places (n,) between which the shortest stop of one axis goes.

    Args:
        p: (n,) where.
        v: (n,) how fast.
        a: (n,) acceleration.
        limits: (3,) of the axis.
    """
    _, most, jerk = limits
    # To no acceleration by full jerk: what is left of the speed says which way to brake.
    left = v + a * np.abs(a) / (2 * jerk)
    way = np.where(np.abs(left) > 1e-12, -np.sign(left), 0.0)
    # That way the acceleration goes to a peak, stays there, and falls back to zero.
    peak = np.minimum(np.sqrt(np.maximum(0.5 * a * a - way * v * jerk, 0.0)), most)
    first_s, last_s = np.abs(peak - way * a) / jerk, peak / jerk
    gained = 0.5 * (way * a + peak) * first_s + 0.5 * peak * last_s
    flat_s = np.maximum(-way * v - gained, 0.0) / most
    push = np.sign(peak - way * a) * way * jerk
    # Nothing is left: full jerk against the acceleration alone.
    alone = way == 0.0
    first_s = np.where(alone, np.abs(a) / jerk, first_s)
    flat_s, last_s = np.where(alone, 0.0, flat_s), np.where(alone, 0.0, last_s)
    push = np.where(alone, -np.sign(a) * jerk, push)
    low, high = np.array(p), np.array(p)
    for phase_s, rate in ((first_s, push), (flat_s, 0.0 * push), (last_s, -way * jerk)):
        for part in np.linspace(0.0, 1.0, 33)[1:]:
            t = part * phase_s
            at = p + v * t + 0.5 * a * t * t + rate * t**3 / 6
            low, high = np.minimum(low, at), np.maximum(high, at)
        p = p + v * phase_s + 0.5 * a * phase_s**2 + rate * phase_s**3 / 6
        v = v + a * phase_s + 0.5 * rate * phase_s**2
        a = a + rate * phase_s
    return low, high


def unreversed(v: Array, a: Array, limits: Array, most: Array) -> Array:
    """(n, 6) how much of the jerk of `limits` ends each acceleration before its axis reverses.

    At least 1, and no more than there is in `most`. An axis that reverses with less jerk may take
    it, and goes further with it than if it reversed.
    """
    slows = v * a < 0
    needed = np.where(slows, a * a / (2 * np.maximum(np.abs(v), 1e-6)), 0.0)
    return np.clip(needed, limits[2], most[2]) / limits[2]


def ends_of(
    v: Array, a: Array, ahead: Array, limits: Array, jerks: Array | None = None
) -> tuple[Array, Array]:
    """Between what ends, from where it is, each axis stays on the way to a goal, (n, 6) each.

    That is here, the goal, and where a brake would end: each axis by itself, or, of a motion that
    is straight and told to stay so, all together within the limits of the tightest.

    Args:
        v: (n, 6) how fast.
        a: (n, 6) acceleration.
        ahead: (n, 6) way to the goal.
        limits: (3, 6).
        jerks: (n, 6) factors of the limits of jerk.
    """
    low, high = np.minimum(ahead, 0.0), np.maximum(ahead, 0.0)
    shares = [np.ones(v.shape)]
    # All of it, or translation or rotation alone; what is beside the way takes 2 % of the limits.
    for axes, beside in ((slice(0, 6), 0.0), (slice(0, 3), 0.02), (slice(3, 6), 0.02)):
        parts = [part[:, axes] for part in (v, a, ahead)]
        scale = [np.linalg.norm(part, axis=1) for part in parts]
        along = np.where((scale[0] > 1e-9)[:, None], parts[0], parts[2])
        along = along / np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-300)
        straight = np.ones(len(v), bool)
        for order, (part, length) in enumerate(zip(parts, scale, strict=True)):
            off = part - (part * along).sum(axis=1, keepdims=True) * along
            little = beside * limits[order, axes].min() if order < 2 else beside * length + SAME
            straight &= np.linalg.norm(off, axis=1) <= 1e-6 * length + 1e-9 + little
        ratio = np.abs(along) / limits[1, axes]
        together = ratio / np.maximum(ratio.max(axis=1, keepdims=True), 1e-300) * (1 - beside)
        share = np.ones(v.shape)
        share[:, axes] = np.where(straight[:, None], np.maximum(together, 1e-9), 1.0)
        shares.append(share)
    for share in shares:
        for axis in range(v.shape[1]):
            scaled = limits[:, axis, None] * share[:, axis]
            if jerks is not None:
                scaled[2] *= jerks[:, axis]
            down, up = brake_range(np.zeros(len(v)), v[:, axis], a[:, axis], scaled)
            low[:, axis] = np.minimum(low[:, axis], down)
            high[:, axis] = np.maximum(high[:, axis], up)
    return low, high


def wander(goal: Array, place: Array, speed: Array, change: Array, usable: Any) -> Array:
    """(n,) how far what stood at its goal is from it while the goal stays."""
    away = np.zeros(len(goal))
    at, there = 0.0, False
    stands = (np.abs(speed) < STILL) & (np.abs(change) < CALM) & (np.abs(place - goal) < THERE)
    for i, (g, p, use, still) in enumerate(
        zip(goal.tolist(), place.tolist(), usable.tolist(), stands.tolist(), strict=True)
    ):
        if not use or abs(g - at) > SAME:
            there = False
        if use and still and not there:
            there, at = True, g
        elif there:
            away[i] = abs(p - g)
    return away
