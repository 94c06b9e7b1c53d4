"""Contact: the external load on the arm, whether it is too much, and the retreat from it.

A robot may measure the external wrench at its TCP (`PoseState.wrench`) and efforts of its joints
(`JointState.effort_nm`), which count only if they are external too. Each load is filtered, and its
bias removed::

    f' = (measured - f) / FILTER_S                  noise, and impacts that are over at once
    b' = (f - b) / DRIFT_S,  |b - b_0| <= slow      a load that was picked up, a sensor that drifts

with ``b_0`` the load at activation, at most ``slow``: a load in the gripper, a sensor that was not
zeroed. Sizes are norms, for joints the greatest one. Above ``slow`` the arm has a share of its
speed, ``(stop - |f - b|) / (stop - slow)``. It must stop where ``max(|f|, |f - b_0|) > stop``: a
bias that followed a slowly rising force would let the force rise by as much, so for the stop there
is none, and what the sensor reports is the force itself. A force that rises at r N/s is larger than
``f`` by ``r FILTER_S``, and by what it rises until the next tick: at 100 N/s by 3 N.

A controller presses with the distance between command and arm, and with what its integral action
has accumulated. So after the brake the command of a blocked arm moves

1. from the end of the brake, inside the obstacle, to the pose measured then, once: it does not
   follow an arm that is pushed about;
2. to the pose at which the contact was detected, and on along the path on which the arm came,
   `STEP_M` at a time, until nothing presses any more, but `RELIEF_M` at most.

Without a measured wrench the contact cannot be seen: then it moves all of `RELIEF_M` at once.

An arm that brakes for another loss, and comes to rest with a load above ``slow``, retreats as well.
Where it was asked to stand, or may resume, an event `pressed` tells of the load.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from vla_zenoh.control.commander_io import make_event
from vla_zenoh.control.limits import Slowdown, in_steps, slowest
from vla_zenoh.control.monitor import Brake, Monitor, PartSnapshot
from vla_zenoh.kinematics.so3 import Pose, interpolate, norm3, pose_distance
from vla_zenoh.profile import ContactLimits, Limits
from vla_zenoh.types import Event, FloatArray, JointState, PoseState, Stamped

FILTER_S = 0.02
"""Shorter: impacts that are over at once stop the arm; longer: a rising force is seen late."""
DRIFT_S = 10.0
"""Shorter: a push slows the arm down for a moment only; longer: a load just picked up does."""
LONGEST_S = 0.1
"""Longest time between two states that the filters integrate."""
FROZEN_M, FROZEN_RAD = 0.05, 0.2
"""A wrench that stays the same to the last bit while the TCP moves this far is not measured, nor
are efforts while the joints move this far (m for those that slide)."""
UNTOUCHED = 0.2
"""Part of ``slow`` below which the arm is not in contact."""

STEP_M = 0.005
"""A retreat looks at the load after each of these: longer ones go back further than needed."""
RISE = 0.1
"""A retreat ends where a load is above its stop and rose by this part of it since the last step:
something is behind the arm. Less: a sensor's noise ends it."""
RELIEF_M = 0.02
"""As far as an arm of 2000 N/m is pressed into what stops it at 40 N."""
LOAD_SETTLES_NS = 50_000_000
"""Time that the external load has to settle, once the command stands."""
SPARE_NS = 4_000_000_000
"""Time that a retreat may take beyond that of its path."""
SPACE_M = 0.002
"""Distance between the poses of a trail."""
GAP_M = 0.1
"""Two poses further apart are no motion in between: 2 m/s at 20 Hz."""
TRAIL_POSES = 60
"""Of a trail: 0.12 m, so that a detour of up to this is left out."""
RAD_AS_M = 0.05
"""A rotation by 1 rad counts as this distance."""
STRAY_M, STRAY_RAD = 0.01, 0.05
"""An arm further away than when it was blocked, plus the brake and this, does not retreat."""


class Load:
    """One kind of load, filtered and without its bias: a value in N or Nm, and its limits."""

    def __init__(
        self,
        name: str,
        unit: str,
        slow: float | None,
        stop: float | None,
        size: Callable[[FloatArray], float],
    ) -> None:
        self.name, self.unit = name, unit  # of the limit
        self.stop = math.inf if stop is None else stop
        self.slow = self.stop if slow is None else slow
        self._size = size
        self.known, self._stamp_ns = False, 0
        self._filtered = self._bias = self._start_bias = np.zeros(0)
        self.value = 0.0
        """The size of the load without its bias, in N or Nm."""
        self.most = 0.0
        """The size of the load that counts for the stop, in N or Nm: no bias follows it."""

    def __str__(self) -> str:
        return f"{self.name} {self.most:.1f} {self.unit}"

    def update(self, measured: FloatArray | None, stamp_ns: int, *, drifts: bool) -> None:
        """Add what was measured at `stamp_ns`, None: nothing; `drifts`: let the bias follow."""
        if measured is None:
            self.known = False
            return
        dt_s = min(max((stamp_ns - self._stamp_ns) / 1e9, 0.0), LONGEST_S)
        self._stamp_ns = stamp_ns
        if not self.known or len(measured) != len(self._filtered):
            self.known = True
            self._filtered = measured
            self._bias = self._start_bias = np.zeros(len(measured))
        share = -math.expm1(-dt_s / FILTER_S)
        self._filtered = self._filtered + share * (measured - self._filtered)
        if drifts:
            drifted = self._bias + dt_s / DRIFT_S * (self._filtered - self._bias)
            self._bias = self._near(drifted, self._start_bias)
        self._measure()

    def zero(self) -> None:
        """Take the present load for the bias, as far as `slow`."""
        self._bias = self._start_bias = self._near(self._filtered, np.zeros(len(self._filtered)))
        self._measure()

    def _measure(self) -> None:
        self.value = self._size(self._filtered - self._bias)
        since_start = self._size(self._filtered - self._start_bias)
        self.most = max(since_start, self._size(self._filtered))

    def _near(self, values: FloatArray, middle: FloatArray) -> FloatArray:
        """`values`, no further than `slow` from `middle`."""
        apart = self._size(values - middle)
        if apart <= self.slow:
            return values
        return middle + self.slow / apart * (values - middle)


def _norm(values: FloatArray) -> float:
    return math.hypot(*values.tolist())  # faster than NumPy's for so few


def _greatest(values: FloatArray) -> float:
    return float(np.abs(values).max(initial=0.0))


class Repetition:
    """Whether a reading is of no sensor: it never was anything but zeros, or stays the same to the
    last bit while the arm moves further than `most`.

    Args:
        most: in the unit of the place.
        simulated: zeros are of an arm that touches nothing; a real sensor has noise.
    """

    def __init__(self, most: float, *, simulated: bool = False) -> None:
        self._most, self._simulated = most, simulated
        self._first: tuple[FloatArray, FloatArray] | None = None
        self._only_zeros = True

    def add(self, reading: FloatArray, place: FloatArray) -> bool:
        """Add a reading that was taken at this place (n,)."""
        zeros = not reading.any()
        if zeros and self._simulated:
            self._first = None
            return False
        self._only_zeros &= zeros
        first = self._first
        if first is None or not np.array_equal(reading, first[0]):
            self._first = first = reading, place
        return self._only_zeros or _norm(place - first[1]) > self._most


class Contact(Monitor):
    """The external load on the arm, as far as the robot measures it.

    Args:
        limits: slow and stop of each kind of load.
        simulated: the robot is, so a wrench of zeros is measured.
    """

    def __init__(self, limits: ContactLimits, *, simulated: bool = False) -> None:
        self._force = Load("contact_force", "N", limits.force_slow_n, limits.force_stop_n, _norm)
        self._torque = Load(
            "contact_torque", "Nm", limits.torque_slow_nm, limits.torque_stop_nm, _norm
        )
        self._effort = Load(
            "contact_effort", "Nm", limits.effort_slow_nm, limits.effort_stop_nm, _greatest
        )
        self._all = (self._force, self._torque, self._effort)
        self.wants_effort = limits.effort_stop_nm is not None
        """The efforts of the joints are monitored."""
        self._active = False
        self._begun: list[Load] = []
        self._reported = True
        """What was told last about `known`."""
        self._wrenches = Repetition(FROZEN_M, simulated=simulated)
        self._efforts = Repetition(FROZEN_RAD)

    @property
    def measured(self) -> list[Load]:
        """The loads that the robot measures."""
        return [load for load in self._all if load.known]

    # -- measurements -------------------------------------------------------------------------
    def update_pose(self, state: Stamped[PoseState]) -> None:
        """Add the newest pose, with the wrench if the robot measures one."""
        wrench, stamp_ns = state.record.wrench, state.header.stamp_wall_ns
        if wrench is not None and self._wrenches.add(wrench, state.record.position_m):
            wrench = None
        force, torque = (None, None) if wrench is None else (wrench[:3], wrench[3:])
        for load, measured in ((self._force, force), (self._torque, torque)):
            load.update(measured, stamp_ns, drifts=self._active)

    def update_joints(self, state: Stamped[JointState]) -> None:
        """Add the newest joints; used if a limit of the profile says that efforts are external."""
        if self.wants_effort:
            joint, stamp_ns = state.record, state.header.stamp_wall_ns
            effort = joint.effort_nm
            if effort is not None and self._efforts.add(effort, joint.position_rad):
                effort = None
            self._effort.update(effort, stamp_ns, drifts=self._active)

    def begin(self) -> None:
        """Start an activation: the present load is not a contact."""
        self._active, self._begun = True, self.measured
        for load in self._begun:
            load.zero()

    def end(self) -> None:
        """End the activation: the bias follows the load no longer."""
        self._active = False

    # -- contact ------------------------------------------------------------------------------
    @property
    def known(self) -> bool:
        """The robot measures external loads."""
        return any(load.known for load in self._all)

    def news(self) -> Event | None:
        """Event when the robot begins or ceases to measure external loads; once each time."""
        if self.known is self._reported:
            return None
        self._reported = self.known
        if self.known:
            why = "the robot measures external loads"
            return make_event("info", "notice", "contact_told", why)
        why = (
            "the robot measures no external wrench: limits.contact has no effect, and a "
            "blocked arm is detected by limits.tracking_m alone"
        )
        return make_event("warning", "notice", "contact_not_told", why)

    @property
    def lost(self) -> str:
        """Which load the robot measured when the activation began and does not now."""
        for load in self._begun:
            if not load.known:
                return (
                    f"the robot no longer measures {load.name}, which limits.contact needs: it "
                    "reports none, or the same numbers while it moves (one without a sensor should "
                    "report none)"
                )
        return ""

    def reasons(self, part: PartSnapshot) -> list[str]:
        return self.missing

    def check(self, part: PartSnapshot) -> Brake | None:
        load = self.overload()
        if load is None or part.commanded is None or not part.published:
            return Brake(self.lost) if self.lost else None
        event = make_event("warning", "limit", load.name, "stopped", load.most, load.stop)
        why = (
            f"something presses against the arm: {load}, "
            f"at most {load.stop:g} {load.unit}; it retreats"
        )
        return Brake(why, event, retreats=True)

    @property
    def missing(self) -> list[str]:
        """Reasons against an activation: loads above their stop, or with a limit and unknown."""
        reasons = [
            f"{load.name} is {load.most:.1f} {load.unit} at rest, which is more than its stop of "
            f"{load.stop:g} {load.unit}: free the arm, or zero the robot's sensor"
            for load in self.measured
            if load.most > load.stop
        ]
        if self.wants_effort and not self._effort.known:
            reasons.append(
                "limits.contact.effort_stop_nm is set, and the robot reports no joint efforts, or "
                "only zeros; take the limit out (effort_slow_nm: null, effort_stop_nm: null), or "
                "let the robot report its external joint torques"
            )
        return reasons

    @property
    def force_n(self) -> float | None:
        """External force, None where it is not measured."""
        return self._force.value if self._force.known else None

    @property
    def torque_nm(self) -> float | None:
        """External torque about the TCP, None where it is not measured."""
        return self._torque.value if self._torque.known else None

    @property
    def pressing(self) -> float:
        """The greatest load as a part of its stop."""
        return max((load.most / load.stop for load in self.measured), default=0.0)

    @property
    def quiet(self) -> bool:
        """No contact, as far as the robot measures it."""
        return all(load.value <= UNTOUCHED * load.slow for load in self.measured)

    def overload(self) -> Load | None:
        """The load above its stop limit, None without one."""
        return next((load for load in self.measured if load.most > load.stop), None)

    def touching(self) -> Load | None:
        """The load furthest above its slow limit, None without one."""
        loads = [load for load in self.measured if load.value > load.slow]
        return max(loads, key=lambda load: load.value / load.slow, default=None)

    @property
    def slowdown(self) -> Slowdown | None:
        """The slowdown of the greatest load, None without one."""
        slower: Slowdown | None = None
        for load in self.measured:
            if load.value <= load.slow:
                continue
            left = max((load.stop - load.value) / max(load.stop - load.slow, 1e-9), 0.0)
            share = in_steps(left)
            if share < 1.0:
                slower = slowest(slower, Slowdown(load.name, share, load.value, load.slow, ""))
        return slower


# -- retreat ------------------------------------------------------------------------------------
class CommandTrail:
    """The path on which the arm came: measured poses, `SPACE_M` apart, newest last.

    Detours that came back to a pose of the path are left out, so it never reverses.
    """

    def __init__(self) -> None:
        self._poses: list[Pose] = []
        self._places: list[FloatArray] = []
        self._newest: Pose | None = None

    def add(self, pose: Pose) -> None:
        """Add a measured pose."""
        if pose is self._newest:
            return
        self._newest, place = pose, _place(pose)
        if self._places:
            way_m = _norm(place - self._places[-1])
            if way_m < SPACE_M:
                return
            near = np.linalg.norm(np.array(self._places) - place, axis=1) < SPACE_M
            if way_m > GAP_M:
                self.clear()
            elif near.any():
                keep = int(np.argmax(near)) + 1
                del self._poses[keep:], self._places[keep:]
                return
            else:
                self._fill(pose, math.ceil(way_m / (5 * SPACE_M)))
        self._poses.append(pose)
        self._places.append(place)
        del self._poses[:-TRAIL_POSES], self._places[:-TRAIL_POSES]

    def _fill(self, pose: Pose, pieces: int) -> None:
        """Add poses on the way to `pose`: of a fast arm few are measured."""
        before = self._poses[-1]
        between = [interpolate(before, pose, piece / pieces) for piece in range(1, pieces)]
        self._poses += between
        self._places += map(_place, between)

    def clear(self) -> None:
        """Drop all poses."""
        self._poses.clear()
        self._places.clear()

    def back(self, way_m: float) -> list[Pose]:
        """Poses of the last `way_m`, newest first, without the present one."""
        found: list[Pose] = []
        gone_m = 0.0
        for index in range(len(self._poses) - 2, -1, -1):
            gone_m += _norm(self._places[index] - self._places[index + 1])
            if gone_m > way_m + SPACE_M / 2:
                break
            found.append(self._poses[index])
        return found


def _place(pose: Pose) -> FloatArray:
    # The Frobenius norm of a difference of rotations is sqrt(2) times their small angle.
    turned = (pose.rotation * (RAD_AS_M / math.sqrt(2))).ravel()
    return np.concatenate([pose.position_m, turned])


class Retreat:
    """Where a blocked arm moves to, from `begin` until it is free.

    Args:
        limits: its speed, and how far an arm may be from its command.
        contact: the external load.
    """

    def __init__(self, limits: Limits, contact: Contact) -> None:
        self._limits, self._contact = limits, contact
        self.speed = min(1.0, limits.contact.retreat_m_s / limits.translation.velocity_m_s)
        """Its share of the speed limits."""
        self._trail = CommandTrail()
        self._measured: Pose | None = None
        self._begun: tuple[Pose, Pose] | None = None
        """Poses at which it was requested, commanded and measured."""
        self._target: Pose | None = None
        self._ahead: list[Pose] = []
        self._until_ns = self._rest_ns = 0
        self._pressing = 0.0
        """The load when its last step began."""

    @property
    def busy(self) -> bool:
        """It is running, or waits for the brake to end."""
        return self._begun is not None

    def measure(self, measured: Pose) -> None:
        """Record the measured pose."""
        self._measured = measured
        if not self.busy:
            self._trail.add(measured)

    def begin(self, commanded: Pose) -> None:
        """Retreat from `commanded` after the brake: the arm is blocked or in contact."""
        if self._measured is not None:
            self._begun = commanded, self._measured
            self._target = None

    def end(self) -> None:
        """Stop the retreat: the arm brakes and stands."""
        self._begun = self._target = None

    def step(
        self, commanded: Pose, now_ns: int, *, at_rest: bool
    ) -> tuple[Pose | None, Event | None]:
        """The pose to move to in this tick, None: brake, or stand; and the event of its end.

        `at_rest`: the command has reached its target.
        """
        begun, measured = self._begun, self._measured
        if begun is None or measured is None:
            return None, None
        rises = self._contact.pressing > max(1.0, self._pressing + RISE)
        if self._target is not None and rises:
            return self._finish("something behind it presses")
        if not at_rest:
            self._rest_ns = now_ns
            if self._target is not None and now_ns > self._until_ns:
                return self._finish("it took too long")
            return self._target, None
        if self._target is None:
            return self._set_out(begun, commanded, measured, now_ns)
        if now_ns - self._rest_ns < LOAD_SETTLES_NS:
            return self._target, None
        known = self._contact.known
        if known and self._contact.quiet:
            return self._finish("it stands")
        if not self._ahead or now_ns > self._until_ns:
            return self._finish("something still presses" if known else "it stands")
        self._pressing = self._contact.pressing
        target, step_m = self._target, STEP_M if known else RELIEF_M
        start = _place(target)
        while self._ahead:
            target = self._ahead.pop(0)
            if _norm(_place(target) - start) >= step_m:
                break
        self._target = target
        return target, None

    def _set_out(
        self, begun: tuple[Pose, Pose], commanded: Pose, measured: Pose, now_ns: int
    ) -> tuple[Pose | None, Event | None]:
        if self._contact.known and self._contact.quiet:
            return self._finish("no further than the brake, nothing presses any more")
        apart_m, apart_rad = pose_distance(commanded, measured)
        braked_m, braked_rad = pose_distance(begun[0], commanded)
        most_m = self._limits.tracking_m + braked_m + STRAY_M
        most_rad = self._limits.tracking_rad + braked_rad + STRAY_RAD
        if apart_m > most_m or apart_rad > most_rad:
            self.end()
            where = f"{apart_m:.3f} m and {apart_rad:.2f} rad from its command"
            why = f"the arm does not retreat: it is {where}"
            return None, make_event("warning", "notice", "retreat", why)
        on_m = norm3(measured.position_m - begun[1].position_m)
        # It does not return to a pose from which a person has pushed it away since.
        here = _place(measured)
        into = _place(commanded) - here
        self._ahead = [
            pose
            for pose in (begun[1], *self._trail.back(RELIEF_M))
            if (_place(pose) - here) @ into <= 0
        ]
        speed_m_s = self.speed * self._limits.translation.velocity_m_s
        speed_rad_s = self.speed * self._limits.rotation.velocity_rad_s
        way_s = (apart_m + on_m + RELIEF_M) / speed_m_s + apart_rad / speed_rad_s
        self._until_ns = now_ns + round(2e9 * way_s) + SPARE_NS
        self._rest_ns = now_ns
        self._pressing = self._contact.pressing
        self._target = measured
        return measured, None

    def _finish(self, why: str) -> tuple[Pose | None, Event | None]:
        self.end()
        loads = ", ".join(map(str, self._contact.measured))
        why = f"the arm retreated: {why}{loads and f' ({loads})'}"
        return None, make_event("info", "notice", "retreat", why)
