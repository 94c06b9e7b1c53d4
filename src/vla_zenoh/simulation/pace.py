"""How a simulated world keeps to real time, and what gives way on a computer that is too slow.

A tick computes control once and then steps the world: at least twice from a command or state to
the next, or every 4 ms where these are rare. A late tick steps further than others, which
costs little: controllers and everything around them take most of the time. If that is not enough,
simulated time slips: the world goes slower than real time. The arm still follows its commands at
the time they are meant for: they are a path in real time, and in the time of the world that path is
faster by the factor `PacedTick.stretch`.
"""

from __future__ import annotations

from typing import NamedTuple

from vla_zenoh.simulation.scene import STEP_S

STEP_NS = round(STEP_S * 1e9)
CONTROL_STEPS, MAX_STEPS = 2, 4
"""Steps of the world for one computation of the controllers: on time at the shipped rates, and at
most."""
SLIP_AFTER_NS, SLIP_NS = 20_000_000, 20_000_000
"""Time slips if a tick is later than the first; by a factor of 2 if it is later than their sum."""
MAX_STRETCH = 3.0
STRETCH_PER_STEP = 0.05
"""The stretch changes slowly: the speed of the reference changes with it."""
GIVE_UP_NS = 100_000_000
"""A tick that is later still was a pause of the whole process: the world has stood still."""
WINDOW_NS = 1_000_000_000


def control_steps(rate_hz: float) -> int:
    """Steps for one computation on time, where commands and states come at `rate_hz` at most."""
    return min(max(int(1e9 / STEP_NS / (2 * rate_hz)), CONTROL_STEPS), MAX_STEPS)


class PacedTick(NamedTuple):
    """One tick: steps of the world, and what they stand for in real time.

    Args:
        steps: of 1 ms.
        period_s: real time that this tick covers.
        time_ns: its end, on the clock given to `Pace`.
        wait_ns: how long to wait before it; below 0: how late it is.
        given_up_ns: time before it in which the world stood still.
    """

    steps: int
    period_s: float
    time_ns: int
    wait_ns: int
    given_up_ns: int

    @property
    def stretch(self) -> float:
        """Real time over simulated time: 1 on a computer that keeps up."""
        return self.period_s / (self.steps * STEP_S)


class Pace:
    """Ticks of a simulated world from `now_ns` on, of so many `steps` on time.

    Attributes:
        factor: simulated over real time in the last full `WINDOW_NS`, 1.0 before the first.
    """

    def __init__(self, now_ns: int, steps: int = CONTROL_STEPS) -> None:
        self._steps = steps
        self._time_ns = self._window_ns = now_ns
        self._stretch = 1.0
        self._stepped = 0
        self.factor = 1.0

    def next(self, now_ns: int) -> PacedTick:
        """The next tick, asked for when the one before is over."""
        late_ns = now_ns - self._time_ns - self._steps * STEP_NS
        given_up_ns = late_ns if late_ns > GIVE_UP_NS else 0
        self._time_ns += given_up_ns
        late_ns -= given_up_ns
        more = min(max(late_ns // STEP_NS, 0), MAX_STEPS - self._steps)
        steps = self._steps + int(more)
        self._follow(late_ns, steps)
        period_ns = round(steps * STEP_NS * self._stretch)
        self._time_ns += period_ns
        self._count(steps)
        wait_ns = self._time_ns - now_ns
        return PacedTick(steps, period_ns / 1e9, self._time_ns, wait_ns, given_up_ns)

    def _follow(self, late_ns: int, steps: int) -> None:
        wanted = 1.0 + max(late_ns - SLIP_AFTER_NS, 0) / SLIP_NS
        change = min(wanted, MAX_STRETCH) - self._stretch
        most = STRETCH_PER_STEP * steps
        self._stretch += min(max(change, -most), most)

    def _count(self, steps: int) -> None:
        self._stepped += steps
        elapsed_ns = self._time_ns - self._window_ns
        if elapsed_ns >= WINDOW_NS:
            self.factor = self._stepped * STEP_NS / elapsed_ns
            self._window_ns, self._stepped = self._time_ns, 0
