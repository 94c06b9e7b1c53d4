"""Retreat of a blocked arm: its command moves back to the arm, and on until the contact ends.

A controller presses with the distance between command and arm, and with what its integral action
has accumulated. So after the brake the command moves

1. from the end of the brake, inside the obstacle, to the pose measured then, once: it does not
   follow an arm that is pushed about;
2. to the pose at which the contact was detected, and on along the path on which the arm came,
   `STEP_M` at a time, until nothing presses any more, but `RELIEF_M` at most.

Without a measured wrench the contact cannot be seen: then it moves all of `RELIEF_M` at once.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from vla_zenoh.control.commander_io import make_event
from vla_zenoh.control.contact import Contact
from vla_zenoh.kinematics.so3 import Pose, norm3, pose_distance
from vla_zenoh.profile import Limits
from vla_zenoh.types import Event

STEP_M = 0.005
RELIEF_M = 0.02
SETTLE_NS = 50_000_000
"""Wait after each step, for the external load to settle."""
SPARE_NS = 4_000_000_000
"""Time that a retreat may take beyond that of its path."""
SPACE_M = 0.002
"""Distance between the poses of a trail."""
PLACES = 60
RAD_AS_M = 0.05
"""A rotation by 1 rad counts as this distance."""
STRAY_M, STRAY_RAD = 0.01, 0.05
"""An arm further away than when it was blocked, plus the brake and this, does not retreat."""


class CommandTrail:
    """The path on which the arm came: measured poses, `SPACE_M` apart, newest last.

    Detours that came back to a pose of the path are left out, so it never reverses.
    """

    def __init__(self) -> None:
        self._poses: list[Pose] = []
        self._places: list[list[float]] = []
        self._newest: Pose | None = None

    def add(self, pose: Pose) -> None:
        """Add a measured pose."""
        if pose is self._newest:
            return
        self._newest, place = pose, _place(pose)
        if self._places and math.dist(self._places[-1], place) < SPACE_M:
            return
        if self._places:
            # Plain floats: of so few places numpy takes four times as long to find it.
            apart = [math.dist(known, place) for known in self._places]
            if apart[-1] > 10 * SPACE_M:
                self.clear()  # poses in between are missing
            elif min(apart) < SPACE_M:
                keep = next(at for at, far in enumerate(apart, 1) if far < SPACE_M)
                del self._poses[keep:], self._places[keep:]
                return
        self._poses.append(pose)
        self._places.append(place)
        del self._poses[:-PLACES], self._places[:-PLACES]

    def clear(self) -> None:
        """Drop all poses."""
        self._poses.clear()
        self._places.clear()

    def back(self, way_m: float) -> list[Pose]:
        """Poses of the last `way_m`, newest first, without the present one."""
        found: list[Pose] = []
        gone_m = 0.0
        for index in range(len(self._poses) - 2, -1, -1):
            gone_m += math.dist(self._places[index], self._places[index + 1])
            if gone_m > way_m + SPACE_M / 2:
                break
            found.append(self._poses[index])
        return found


def _place(pose: Pose) -> list[float]:
    # The Frobenius norm of a difference of rotations is sqrt(2) times their small angle.
    turned = (pose.rotation * (RAD_AS_M / math.sqrt(2))).ravel()
    return pose.position_m.tolist() + turned.tolist()


class _Contact(NamedTuple):
    """Poses at which the retreat was requested."""

    commanded: Pose
    measured: Pose


class RetreatStep(NamedTuple):
    """The command of one tick.

    Args:
        target: the pose to move to; None: brake, or stand.
        event: the end of the retreat, None: it continues or did not run.
    """

    target: Pose | None
    event: Event | None = None


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
        self._begun: _Contact | None = None
        self._target: Pose | None = None
        self._ahead: list[Pose] = []
        self._until_ns = self._rest_ns = 0

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
            self._begun = _Contact(commanded, self._measured)
            self._target = None

    def end(self) -> None:
        """Stop the retreat: the arm brakes and stands."""
        self._begun = self._target = None

    def step(self, commanded: Pose, now_ns: int, *, at_rest: bool) -> RetreatStep:
        """The target of this tick.

        Args:
            commanded: the present command.
            now_ns: time of this tick.
            at_rest: the command has reached its target.
        """
        begun, measured = self._begun, self._measured
        if begun is None or measured is None:
            return RetreatStep(None)
        if not at_rest:
            self._rest_ns = now_ns
            if self._target is not None and now_ns > self._until_ns:
                return self._finish("it took too long")
            return RetreatStep(self._target)
        if self._target is None:
            return self._set_out(begun, commanded, measured, now_ns)
        if now_ns - self._rest_ns < SETTLE_NS:
            return RetreatStep(self._target)
        known = self._contact.known
        if known and self._contact.quiet:
            return self._finish("it stands")
        if not self._ahead or now_ns > self._until_ns:
            return self._finish("something still presses" if known else "it stands")
        return RetreatStep(self._step_back(self._target, STEP_M if known else RELIEF_M))

    def _set_out(
        self, begun: _Contact, commanded: Pose, measured: Pose, now_ns: int
    ) -> RetreatStep:
        if self._contact.known and self._contact.quiet:
            return self._finish("no further than the brake, nothing presses any more")
        apart_m, apart_rad = pose_distance(commanded, measured)
        braked_m, braked_rad = pose_distance(begun.commanded, commanded)
        most_m = self._limits.tracking_m + braked_m + STRAY_M
        most_rad = self._limits.tracking_rad + braked_rad + STRAY_RAD
        if apart_m > most_m or apart_rad > most_rad:
            self.end()
            where = f"{apart_m:.3f} m and {apart_rad:.2f} rad from its command"
            why = f"the arm does not retreat: it is {where}"
            return RetreatStep(None, make_event("warning", "notice", "retreat", why))
        on_m = norm3(measured.position_m - begun.measured.position_m)
        # It does not return to a pose from which a person has pushed it away since.
        here = np.array(_place(measured))
        into = _place(commanded) - here
        self._ahead = [
            pose
            for pose in (begun.measured, *self._trail.back(RELIEF_M))
            if (_place(pose) - here) @ into <= 0
        ]
        speed_m_s = self.speed * self._limits.translation.velocity_m_s
        speed_rad_s = self.speed * self._limits.rotation.velocity_rad_s
        way_s = (apart_m + on_m + RELIEF_M) / speed_m_s + apart_rad / speed_rad_s
        self._until_ns = now_ns + round(2e9 * way_s) + SPARE_NS
        self._rest_ns = now_ns
        self._target = measured
        return RetreatStep(measured)

    def _step_back(self, target: Pose, step_m: float) -> Pose:
        start = _place(target)
        while self._ahead:
            target = self._ahead.pop(0)
            if math.dist(_place(target), start) >= step_m:
                break
        self._target = target
        return target

    def _finish(self, why: str) -> RetreatStep:
        self.end()
        force_n = self._contact.force_n
        force = "" if force_n is None else f", external force {force_n:.1f} N"
        why = f"the arm retreated: {why}{force}"
        return RetreatStep(None, make_event("info", "notice", "retreat", why))
