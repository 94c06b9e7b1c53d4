"""Judges whether a task was done, and the kind of failure, from true poses."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from vla_zenoh.errors import RecordError
from vla_zenoh.kinematics.so3 import rotation_from_quat
from vla_zenoh.lab.tasks.order import (
    BOX,
    COLOURS,
    DIRECTIONS,
    LIFT,
    PUSH,
    PUT,
    STACK,
    STAY,
    Order,
    brick,
)
from vla_zenoh.types import FloatArray, ObjectPoses

LIMIT_S = 30.0
"""Time limit of a task; a policy that can do it needs about a third."""
SETTLED_S = 0.5
"""The goal has to hold for this long."""

IN_BOX_M, IN_BOX_HEIGHT_M = 0.067, 0.05
"""A brick in the box: distance of centres along either axis, and height."""
BRICK_HEIGHT_M = 0.0192
ON_TOP_M, ON_TOP_HEIGHT_M = 0.0159, 0.004
"""A brick on another: horizontal distance of centres, and tolerance on its height."""
PUSHED_M = 0.05
"""A pushed brick: distance along the direction, and less than half of it beside."""
RELEASED_M = 0.045
"""Gripper width at which a brick (of 0.032 m) is released."""
LIFTED_M = 0.03
MOVED_M = 0.02
DISTURBED_M = 0.04
"""Another brick may be brushed, but not moved this far."""
SHUT_M = 0.02
TABLE_EDGE_Z_M = -0.01
STAYED_M = 0.01

WRONG_BRICK, FELL, DROPPED, MISSED_GRASP = "wrong_brick", "fell", "dropped", "missed_grasp"
KNOCKED, OFF_COURSE, NOT_MOVED, TIMEOUT = "knocked", "off_course", "not_moved", "timeout"
MOVED, TILTED = "moved", "tilted"
FAILURES = {
    WRONG_BRICK: "another brick was lifted, moved or put in the box",
    FELL: "a brick fell off the table",
    DROPPED: "the brick was lifted, but is not at its goal",
    MISSED_GRASP: "the gripper closed on nothing and the brick was never lifted",
    KNOCKED: "the brick was moved, but never lifted",
    OFF_COURSE: "the brick was pushed, but not far enough or in another direction",
    NOT_MOVED: "no brick was moved",
    TIMEOUT: "the time limit was reached while the brick was held",
    TILTED: "the bar was not level: one arm lifted its end alone, or lost it",
    MOVED: "the arm had to stay, and it or a brick moved",
}
"""Kinds of failure and their meaning."""


@dataclass(frozen=True, slots=True)
class Verdict:
    """How an episode ended.

    Args:
        failure: one of `FAILURES`; empty after a success.
        time_s: of the verdict, on the caller's clock.
    """

    success: bool
    failure: str
    time_s: float


class TaskJudge:
    """Judges one task from the poses of the objects.

    Args:
        tcp_m: (3,) TCP at the start; only ``stay`` needs it.

    Raises:
        RecordError: an object of the scene is missing.
    """

    def __init__(self, order: Order, before: ObjectPoses, tcp_m: FloatArray | None = None) -> None:
        self.order = order
        self._before = _places(before)
        wanted = [brick(c) for c in COLOURS] + [BOX]
        missing = [name for name in wanted if name not in self._before]
        if missing:
            raise RecordError(
                f"there is no {', '.join(missing)} among the objects {', '.join(before.names)}; "
                "tasks are done in the scene 'bricks'"
            )
        self._tcp_m = None if tcp_m is None else np.array(tcp_m, float)
        self._now = self._before
        self._time_s = 0.0
        self._good_since_s: float | None = None
        self._lifted: set[str] = set()
        self._was_shut = self._tcp_moved = False
        self._width_m = 1.0

    def update(
        self, objects: ObjectPoses, width_m: float, time_s: float, tcp_m: FloatArray | None = None
    ) -> Verdict | None:
        """Process the current state; call it several times a second.

        Args:
            time_s: monotonic.
            tcp_m: (3,) measured TCP; only ``stay`` needs it.

        Returns:
            The verdict as soon as it is certain, else None.
        """
        self._now, self._time_s, self._width_m = _places(objects), time_s, width_m
        self._was_shut |= width_m < SHUT_M
        if self._tcp_m is not None and tcp_m is not None:
            self._tcp_moved |= bool(np.linalg.norm(tcp_m - self._tcp_m) > STAYED_M)
        for colour in COLOURS:
            name = brick(colour)
            if self._now[name][2] - self._before[name][2] > LIFTED_M:
                self._lifted.add(colour)
        if any(self._now[brick(colour)][2] < TABLE_EDGE_Z_M for colour in COLOURS):
            return Verdict(False, FELL, time_s)
        if self._wrong_brick():
            return Verdict(False, WRONG_BRICK, time_s)
        if self.order.family == STAY:
            return None
        if not self._done():
            self._good_since_s = None
        elif self._good_since_s is None:
            self._good_since_s = time_s
        elif time_s - self._good_since_s >= SETTLED_S:
            return Verdict(True, "", time_s)
        return None

    def end(self) -> Verdict:
        """The verdict at the time limit."""
        failure = self._failure()
        return Verdict(not failure, failure, self._time_s)

    def _failure(self) -> str:
        order = self.order
        if order.family == STAY:
            moved = self._tcp_moved or any(self._moved_m(colour) > STAYED_M for colour in COLOURS)
            return MOVED if moved else ""
        way_m = self._moved_m(order.target)
        if order.family == PUSH:
            return OFF_COURSE if way_m > STAYED_M else NOT_MOVED
        height_m = self._now[brick(order.target)][2] - self._before[brick(order.target)][2]
        if self._width_m < RELEASED_M and height_m > STAYED_M:
            return TIMEOUT
        if order.target in self._lifted:
            return TIMEOUT if self._done() else DROPPED
        if self._was_shut:
            return MISSED_GRASP
        return KNOCKED if way_m > MOVED_M else NOT_MOVED

    def _wrong_brick(self) -> bool:
        if self.order.family == STAY:
            return False
        for colour in COLOURS:
            if colour == self.order.target:
                continue
            if colour in self._lifted or self._moved_m(colour) > DISTURBED_M:
                return True
        return False

    def _moved_m(self, colour: str) -> float:
        """Horizontal distance of a brick from its start."""
        name = brick(colour)
        return float(np.hypot(*(self._now[name] - self._before[name])[:2]))

    def _done(self) -> bool:
        order, place = self.order, self._now[brick(self.order.target)]
        if order.family == PUSH:
            way = (place - self._before[brick(order.target)])[:2]
            along = float(way @ np.array(DIRECTIONS[order.direction]))
            beside = float(np.hypot(*(way - along * np.array(DIRECTIONS[order.direction]))))
            return along > PUSHED_M and beside < along / 2
        if self._width_m < RELEASED_M:
            return False
        if order.family == PUT:
            apart = np.abs(place - self._now[BOX])
            return bool(apart[:2].max() < IN_BOX_M and place[2] < IN_BOX_HEIGHT_M)
        assert order.family == STACK
        apart = place - self._now[brick(order.onto)]
        near = float(np.hypot(apart[0], apart[1])) < ON_TOP_M
        return near and abs(apart[2] - BRICK_HEIGHT_M) < ON_TOP_HEIGHT_M


def _places(objects: ObjectPoses) -> dict[str, FloatArray]:
    return dict(zip(objects.names, objects.position_m, strict=True))


BAR = "bar"
BAR_LIFTED_M = 0.10
"""The middle of a bar that counts as lifted is this much higher than at first."""
LEVEL_RAD = 0.1
"""Its tilt then, at most."""
HELD_S = 1.0
"""So long it has to stay lifted and level."""
TOUCHED_M = 0.01


class BarJudge:
    """Judges ``lift the bar``; used as a `TaskJudge`.

    Raises:
        RecordError: there is no bar.
    """

    def __init__(self, order: Order, before: ObjectPoses) -> None:
        self.order = order
        if BAR not in before.names:
            raise RecordError(
                f"there is no {BAR} among the objects {', '.join(before.names)}; it is lifted in "
                "the scene 'pair'"
            )
        self._z_m = self._begin_z_m = self._highest_m = self._pose(before)[0][2]
        self._tilt_rad = self._time_s = 0.0
        self._good_since_s: float | None = None

    def update(
        self, objects: ObjectPoses, width_m: float, time_s: float, tcp_m: FloatArray | None = None
    ) -> Verdict | None:
        """The verdict as soon as it is certain; only the objects matter."""
        position_m, rotation = self._pose(objects)
        self._z_m, self._time_s = float(position_m[2]), time_s
        self._highest_m = max(self._highest_m, self._z_m)
        self._tilt_rad = math.asin(min(abs(float(rotation[2, 0])), 1.0))
        if self._z_m < TABLE_EDGE_Z_M:
            return Verdict(False, FELL, time_s)
        lifted = self._z_m - self._begin_z_m > BAR_LIFTED_M
        if not lifted or self._tilt_rad > LEVEL_RAD:
            self._good_since_s = None
        elif self._good_since_s is None:
            self._good_since_s = time_s
        elif time_s - self._good_since_s >= HELD_S:
            return Verdict(True, "", time_s)
        return None

    def end(self) -> Verdict:
        """The verdict at the time limit."""
        if self._good_since_s is not None:
            return Verdict(False, TIMEOUT, self._time_s)
        if self._tilt_rad > LEVEL_RAD:
            return Verdict(False, TILTED, self._time_s)
        touched = self._highest_m - self._begin_z_m > TOUCHED_M
        return Verdict(False, DROPPED if touched else NOT_MOVED, self._time_s)

    @staticmethod
    def _pose(objects: ObjectPoses) -> tuple[FloatArray, FloatArray]:
        index = objects.names.index(BAR)
        return np.array(objects.position_m[index]), rotation_from_quat(objects.quat_xyzw[index])


def judge_of(
    order: Order, before: ObjectPoses, tcp_m: FloatArray | None = None
) -> TaskJudge | BarJudge:
    """The judge of a goal; see `TaskJudge` for the arguments and errors."""
    return BarJudge(order, before) if order.family == LIFT else TaskJudge(order, before, tcp_m)
