"""A gripper behind a franka-node: when to set a width and when to grasp; no Zenoh, no clock."""

from __future__ import annotations

from typing import NamedTuple

from vla_zenoh_franka_node.wire import GRASP, WIDTH, HandState

CLEARLY_M = 0.002
"""Less is no closing motion, and fingers further than this from the request are on an object."""
SHUT_M = 0.005
"""A narrower request grasps at once."""
STARTS_S = 0.3
"""A motion shows in the states within this time."""


class HandCommand(NamedTuple):
    """A record for the key ``gripper/target``."""

    kind: int
    width_m: float
    force_n: float


class Hand:
    """Turns openings that are asked for into commands, and states into what we publish."""

    def __init__(self) -> None:
        self.newest: HandState | None = None
        self._asked: HandCommand | None = None
        self._asked_s = 0.0
        self._closes = False

    def ask(self, width_m: float, force_n: float, now_s: float) -> HandCommand:
        """The command for an opening."""
        at_m = width_m if self.newest is None else self.newest.width_m
        self._closes = width_m < at_m - CLEARLY_M
        kind = GRASP if self._closes and width_m < SHUT_M else WIDTH
        self._asked, self._asked_s = HandCommand(kind, width_m, force_n), now_s
        return self._asked

    def follow_up(self, now_s: float) -> HandCommand | None:
        """The grasp of what kept closing fingers from their width, once."""
        asked, seen = self._asked, self.newest
        if asked is None or seen is None or asked.kind == GRASP or not self._closes:
            return None
        if self.moving(now_s) or seen.width_m <= asked.width_m + CLEARLY_M:
            return None
        self._asked, self._asked_s = asked._replace(kind=GRASP), now_s
        return self._asked

    def moving(self, now_s: float) -> bool:
        """The fingers move, or are about to."""
        seen = self.newest
        return seen is not None and (seen.moving or now_s - self._asked_s < STARTS_S)

    def holding(self, now_s: float) -> bool:
        """There is something between the fingers."""
        asked, seen = self._asked, self.newest
        if seen is None or self.moving(now_s) or seen.width_m <= CLEARLY_M:
            return False
        if seen.grasped:
            return True
        return asked is not None and self._closes and seen.width_m > asked.width_m + CLEARLY_M
