"""The teacher: the next action from the true poses. Its only memory is `Hand.swept_m`.

A function of the present alone, so every state has a right answer, also states that only a learner
reaches. Heights are funnels over the distance to the goal, so small errors in the learner's
perception cause small errors in its actions; it never waits for a time that no image shows.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

from vla_zenoh.lab.tasks.order import DIRECTIONS

HORIZON = 8
DT_S = 0.1
STEP_M, PUSH_STEP_M, STEP_RAD = 0.035, 0.025, 0.16
OPEN_M, BRICK_M = 0.08, 0.0318
HEIGHT_M = 0.0192
LOWEST_M = 0.0135
"""Just above the lowest goal the command node allows."""
RETREAT_M = 0.20
HOVER_M = 0.085
CARRY_M, RELEASE_M = 0.125, 0.082
PUSH_LOW_M, PUSH_HOVER_M = 0.016, 0.085
PUSH_START_M, PUSH_WAY_M = 0.058, 0.105
PUSH_RAMP_M = 0.010
"""Within this height, a little above that of a push, the next part of the path begins."""
CONTACT_M = 0.027
"""From the middle of the shut fingers to that of a brick that they push."""
LOW_M = 0.035
"""Below this height the hand's path counts as a push, see `Hand.swept_m`."""
FOLLOWS = 0.5
"""Share of the distance to its waypoint that the hand covers in a step, about as Ruckig does."""
UP_M = 0.05
"""Above this height an interrupted push begins again."""


class Point(NamedTuple):
    """A position and a rotation about the vertical, in the base frame."""

    x_m: float
    y_m: float
    z_m: float
    yaw_rad: float = 0.0


@dataclass(frozen=True, slots=True)
class Hand:
    """The TCP and the gripper, as the robot reports them.

    Args:
        x_m: of the TCP, base frame.
        y_m: of the TCP, base frame.
        z_m: of the TCP, base frame.
        yaw_rad: turn about the vertical, 0 at home.
        width_m: opening.
        swept_m: distance of the hand from where it came down, below `LOW_M`. It distinguishes a
            completed push from a coming one: above `UP_M` less than a push is forgotten.
        down: where it came down; None while it is above.
    """

    x_m: float
    y_m: float
    z_m: float
    yaw_rad: float
    width_m: float
    swept_m: float = 0.0
    down: tuple[float, float] | None = None

    def swept(self) -> Hand:
        """The same with `swept_m` updated."""
        if self.z_m >= LOW_M:
            again = self.z_m > UP_M and self.swept_m < PUSH_WAY_M
            return replace(self, down=None, swept_m=0.0 if again else self.swept_m)
        down = self.down or (self.x_m, self.y_m)
        way_m = math.hypot(self.x_m - down[0], self.y_m - down[1])
        return replace(self, down=down, swept_m=max(self.swept_m, way_m))


class Wish(NamedTuple):
    """Target of the hand, and whether the gripper should be open."""

    x_m: float
    y_m: float
    z_m: float
    turn_rad: float
    opened: bool
    step_m: float = STEP_M


def quarter(angle_rad: float) -> float:
    """The equivalent angle within an eighth of a turn, for a square."""
    return (angle_rad + math.pi / 4) % (math.pi / 2) - math.pi / 4


def clip(value: float, low: float, high: float) -> float:
    return min(max(value, low), high)


def is_held(hand: Hand, brick: Point) -> bool:
    """The brick is between fingers that are shut on it."""
    near = math.hypot(brick.x_m - hand.x_m, brick.y_m - hand.y_m) < 0.022
    return near and abs(brick.z_m - hand.z_m) < 0.02 and hand.width_m < 0.0375


def wish(family: str, hand: Hand, target: Point, goal: Point, direction: str) -> Wish:
    """The next target.

    Args:
        family: ``put``, ``stack`` or ``push``.
        hand: now.
        target: the brick to move.
        goal: the box, or the brick to stack on; unused for a push.
        direction: of a push.
    """
    if family == "push":
        return _push(hand, target, *DIRECTIONS[direction])
    to_x, to_y = goal.x_m - target.x_m, goal.y_m - target.y_m
    near = math.hypot(target.x_m - hand.x_m, target.y_m - hand.y_m)
    beside = abs(target.z_m - hand.z_m)
    if family == "put":
        off = max(abs(to_x), abs(to_y))
        done = off < 0.064 and target.z_m < 0.05
        above = off < 0.045 and target.z_m >= 0.05
    else:
        off = math.hypot(to_x, to_y)
        done = off < 0.0135 and abs(target.z_m - goal.z_m - HEIGHT_M) < 0.0045
        above = False
    if done or (above and not is_held(hand, target)):
        if near < 0.04 and beside < 0.03 and hand.width_m < 0.055:
            return Wish(hand.x_m, hand.y_m, hand.z_m, 0.0, True)
        return Wish(hand.x_m, hand.y_m, max(RETREAT_M, hand.z_m), 0.0, True)
    if is_held(hand, target):
        return _carry(family, hand, target, goal, off)
    return _approach(hand, target, near)


def _carry(family: str, hand: Hand, target: Point, goal: Point, off: float) -> Wish:
    hang = hand.z_m - target.z_m
    if family == "put":
        least, most = RELEASE_M, CARRY_M
        height = least + clip((off - 0.03) * 1.2, 0.0, most - least)
        let_go = off < 0.032 and hand.z_m < RELEASE_M + 0.022
    else:
        least = goal.z_m + HEIGHT_M + 0.0015 + hang
        most = least + 0.075
        height = least + clip((off - 0.004) * 3.0, 0.0, most - least)
        let_go = False
    # Over possible obstacles first: sideways only near the height that belongs to the place.
    free = clip((hand.z_m - height + 0.015) / 0.012, 0.0, 1.0)
    if let_go:
        return Wish(hand.x_m, hand.y_m, hand.z_m, 0.0, True)
    return Wish(
        hand.x_m + free * (goal.x_m - target.x_m),
        hand.y_m + free * (goal.y_m - target.y_m),
        height,
        0.0,
        False,
    )


def _approach(hand: Hand, target: Point, near: float) -> Wish:
    turn = quarter(target.yaw_rad - hand.yaw_rad)
    grip_z = max(target.z_m + 0.003, LOWEST_M)
    # Wider once it has begun to shut, so that it does not waver.
    slack = 1.0 if hand.width_m > 0.07 else 2.2
    if near < 0.007 * slack and abs(hand.z_m - grip_z) < 0.007 * slack and abs(turn) < 0.25 * slack:
        return Wish(target.x_m, target.y_m, grip_z, turn, False)
    height = grip_z + clip((near - 0.004) * 3.5 + max(abs(turn) - 0.12, 0.0) * 0.4, 0.0, HOVER_M)
    if hand.width_m < 0.068:
        height = max(height, target.z_m + 0.05)
    free = clip(1.0 - (height - hand.z_m - 0.02) / 0.03, 0.0, 1.0)
    return Wish(
        hand.x_m + free * (target.x_m - hand.x_m),
        hand.y_m + free * (target.y_m - hand.y_m),
        height,
        turn * free,
        True,
    )


def _push(hand: Hand, target: Point, u_x: float, u_y: float) -> Wish:
    turn = -clip(hand.yaw_rad, -0.6, 0.6)
    if hand.swept_m >= PUSH_WAY_M:
        return Wish(hand.x_m, hand.y_m, max(RETREAT_M, hand.z_m), 0.0, False)
    rel_x, rel_y = hand.x_m - target.x_m, hand.y_m - target.y_m
    along, beside = rel_x * u_x + rel_y * u_y, -rel_x * u_y + rel_y * u_x
    if hand.z_m < LOW_M:
        if abs(beside) < 0.022 and along < -0.012 and hand.width_m < 0.02:
            # Continue along the line through the brick; an arm that lags would else slide over it.
            over = hand.z_m - PUSH_LOW_M - 0.4 * PUSH_RAMP_M
            ahead = PUSH_STEP_M * clip(1.0 - over / PUSH_RAMP_M, 0.0, 1.0)
            return Wish(
                hand.x_m + ahead * u_x + beside * u_y,
                hand.y_m + ahead * u_y - beside * u_x,
                PUSH_LOW_M,
                turn,
                False,
                PUSH_STEP_M,
            )
        return Wish(hand.x_m, hand.y_m, PUSH_HOVER_M, 0.0, False)
    start_x, start_y = target.x_m - PUSH_START_M * u_x, target.y_m - PUSH_START_M * u_y
    far = math.hypot(start_x - hand.x_m, start_y - hand.y_m)
    height = PUSH_LOW_M + clip((far - 0.008) * 3.5 + abs(turn) * 0.2, 0.0, PUSH_HOVER_M)
    if hand.width_m > 0.012:
        height = max(height, 0.07)
    free = clip(1.0 - (height - hand.z_m - 0.02) / 0.03, 0.0, 1.0)
    return Wish(
        hand.x_m + free * (start_x - hand.x_m),
        hand.y_m + free * (start_y - hand.y_m),
        height,
        turn * free,
        False,
        clip(0.4 * (hand.z_m - PUSH_LOW_M), 0.5 * PUSH_STEP_M, STEP_M),
    )


def advance(goal: Hand, hand: Hand, wished: Wish) -> Hand:
    """The next waypoint, one step from the last one towards the wished target."""
    x, y, z = wished.x_m - goal.x_m, wished.y_m - goal.y_m, wished.z_m - goal.z_m
    share = min(1.0, wished.step_m / max(math.sqrt(x * x + y * y + z * z), 1e-9))
    turn = clip(hand.yaw_rad + wished.turn_rad - goal.yaw_rad, -STEP_RAD, STEP_RAD)
    return replace(
        goal,
        x_m=goal.x_m + share * x,
        y_m=goal.y_m + share * y,
        z_m=goal.z_m + share * z,
        yaw_rad=goal.yaw_rad + turn,
    )


def follow(hand: Hand, goal: Hand, share: float) -> Hand:
    """The hand one step later, without the gripper: it lags behind the waypoints."""
    return replace(
        hand,
        x_m=hand.x_m + share * (goal.x_m - hand.x_m),
        y_m=hand.y_m + share * (goal.y_m - hand.y_m),
        z_m=hand.z_m + share * (goal.z_m - hand.z_m),
        yaw_rad=hand.yaw_rad + share * (goal.yaw_rad - hand.yaw_rad),
    )


Row = tuple[float, float, float, float, float]
"""A waypoint: x, y, z, yaw relative to the hand at the start, and 1 for an open gripper."""


def foretell(
    family: str,
    hand: Hand,
    target: Point,
    goal: Point,
    direction: str,
    committed: Sequence[Row] = (),
) -> list[Row]:
    """The next `HORIZON` waypoints; the first ones are the committed ones.

    Targets are computed for the predicted hand, not for its waypoint: the arm is smoothed, and
    deciding at a corner that it has not reached would cut that corner. A push is short and
    straight; there both count as the same.

    A held object moves with the hand. The prediction does not change the fingers: only the robot
    can show whether they have gripped, so nothing is lifted before that.
    """
    begin, way, out = hand, hand, []
    share = 1.0 if family == "push" else FOLLOWS
    for index in range(HORIZON):
        wished = wish(family, hand, target, goal, direction)
        if index < len(committed):
            x, y, z, yaw, opened = committed[index]
            way = replace(
                way,
                x_m=begin.x_m + x,
                y_m=begin.y_m + y,
                z_m=begin.z_m + z,
                yaw_rad=begin.yaw_rad + yaw,
            )
            wished = wished._replace(opened=opened > 0.5)
        else:
            way = advance(way, hand, wished)
        after = follow(hand, way, share)
        if is_held(hand, target) and not wished.opened:
            target = Point(
                target.x_m + after.x_m - hand.x_m,
                target.y_m + after.y_m - hand.y_m,
                target.z_m + after.z_m - hand.z_m,
                target.yaw_rad + after.yaw_rad - hand.yaw_rad,
            )
        elif family == "push" and after.z_m < LOW_M:
            target = _pushed(after, target, *DIRECTIONS[direction])
        hand = after.swept()
        out.append(
            (
                way.x_m - begin.x_m,
                way.y_m - begin.y_m,
                way.z_m - begin.z_m,
                way.yaw_rad - begin.yaw_rad,
                float(wished.opened),
            )
        )
    return out


def _pushed(hand: Hand, target: Point, u_x: float, u_y: float) -> Point:
    """Pose of the brick once the hand is there."""
    rel_x, rel_y = hand.x_m - target.x_m, hand.y_m - target.y_m
    along, beside = rel_x * u_x + rel_y * u_y, -rel_x * u_y + rel_y * u_x
    if abs(beside) > 0.022 or not -CONTACT_M < along < 0.0:
        return target
    far = along + CONTACT_M
    return target._replace(x_m=target.x_m + far * u_x, y_m=target.y_m + far * u_y)
