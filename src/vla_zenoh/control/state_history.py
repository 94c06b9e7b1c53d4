"""Measured states of the last seconds: where the arm was when an observation was taken."""

from __future__ import annotations

from bisect import bisect_right
from collections import deque
from typing import Generic, TypeVar

from vla_zenoh.types import JointState, PoseState, Stamped

State = TypeVar("State", PoseState, JointState)

KEPT_NS = 2_500_000_000
"""Longer than any observation that is not rejected as stale by default."""
MOST = 2500
"""Of a robot that publishes its state at up to 1 kHz all are kept."""


class StateHistory(Generic[State]):
    """States by the time they were measured."""

    def __init__(self) -> None:
        self._stamps: deque[int] = deque(maxlen=MOST)
        self._states: deque[State] = deque(maxlen=MOST)

    def restart(self, measured: Stamped[State] | None) -> None:
        """Drop all states but this one."""
        self._stamps.clear()
        self._states.clear()
        if measured is not None:
            self._stamps.append(measured.header.stamp_wall_ns)
            self._states.append(measured.record)

    def add(self, measured: Stamped[State], tolerance_ns: int) -> None:
        """Add a state; if time goes back, a clock was set, and only this state is kept.

        Args:
            measured: with the time of its measurement.
            tolerance_ns: the stamp may be later than the arrival by this at most.
        """
        stamp_ns = measured.header.stamp_wall_ns
        if stamp_ns > measured.received_ns + tolerance_ns:
            return
        if self._stamps and stamp_ns <= self._stamps[-1]:
            if stamp_ns < self._stamps[-1]:
                self.restart(measured)
            return
        self._stamps.append(stamp_ns)
        self._states.append(measured.record)
        while self._stamps[0] < stamp_ns - KEPT_NS:
            self._stamps.popleft()
            self._states.popleft()

    def around(self, t_ns: int, gap_ns: int) -> tuple[State, State, float] | None:
        """The states measured next before and after `t_ns`, and the share of time between them.

        Args:
            t_ns: on the clock of the stamps.
            gap_ns: a state measured longer before `t_ns` than this is not used.

        Returns:
            None where no state was measured within `gap_ns` before; the last one before it twice,
            with a share of 0, where none was measured after it.
        """
        index = bisect_right(self._stamps, t_ns)
        if index == 0 or t_ns - self._stamps[index - 1] > gap_ns:
            return None
        before = self._states[index - 1]
        if index == len(self._stamps) or self._stamps[index - 1] == t_ns:
            return before, before, 0.0
        since_ns, until_ns = self._stamps[index - 1], self._stamps[index]
        return before, self._states[index], (t_ns - since_ns) / (until_ns - since_ns)
