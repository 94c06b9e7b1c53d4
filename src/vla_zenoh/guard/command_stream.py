"""Whose commands a controller follows, which of them are new, and what time each is meant for."""

from __future__ import annotations

from typing import Generic, TypeVar

from vla_zenoh.types import Header, Stamped

CLOCK_DRIFT = 1e-3
"""Share by which two clocks may drift apart; a real one does by a tenth of that."""
ACCELERATE_S = 0.02
"""For how long a command's acceleration is believed; its velocity is until the stream times out."""
BRAKE_MARGIN = 2.0
"""The robot's own stop may use this multiple of the stream's limits."""

Command = TypeVar("Command")


class CommandStream(Generic[Command]):
    """The commands of one writer at a time.

    Args:
        timeout_s: silence after which the stream has ended.
    """

    def __init__(self, timeout_s: float) -> None:
        self.newest: Stamped[Command] | None = None
        self._timeout_s = timeout_s
        self._source: str | None = None
        self._last_seq = -1
        self._base_ns = 0
        self._delay_ns = 0
        self._ticked_ns = 0
        self._anew = False

    def objection(self, header: Header, received_ns: int) -> str | None:
        """Why a command is not taken: ``foreign``, ``replayed``, ``late``, or nothing.

        Late is what was longer on its way than the stream may be silent: who followed a link that
        gets slower and slower would go on long after its writer has braked.
        """
        if self.newest is not None and header.source != self._source:
            return "foreign"
        if header.source == self._source and header.seq <= self._last_seq:
            return "replayed"
        if self.newest is not None and self._late(header, received_ns):
            went_back = header.stamp_wall_ns < self.newest.header.stamp_wall_ns
            return None if went_back else "late"  # stamps of a stream go back when a clock was set
        return None

    def _shortest_ns(self, received_ns: int) -> int:
        passed_ns = 0 if self.newest is None else received_ns - self.newest.received_ns
        return self._delay_ns + int(CLOCK_DRIFT * passed_ns)

    def _late(self, header: Header, received_ns: int) -> bool:
        late_ns = received_ns - header.stamp_wall_ns - self._shortest_ns(received_ns)
        return late_ns >= self._timeout_s * 1e9

    def take(self, command: Stamped[Command]) -> None:
        """Follow `command`: it is put on our clock by its stamp, because arrival times jitter.

        The difference of both clocks is the shortest delay seen: a command that was held up on its
        way is not taken for one that is meant later.
        """
        stamp_ns = command.header.stamp_wall_ns
        delay_ns = command.received_ns - stamp_ns
        # Later than a stream may be silent: not a hold-up, one of the clocks was set.
        if self.newest is not None and not self._late(command.header, command.received_ns):
            delay_ns = min(delay_ns, self._shortest_ns(command.received_ns))
        self._delay_ns = delay_ns
        self._base_ns = stamp_ns + delay_ns
        self._anew = True
        self.newest, self._source, self._last_seq = (
            command,
            command.header.source,
            command.header.seq,
        )

    def may_step(self, now_ns: int, dt_s: float) -> bool:
        """Whether this tick may be told something else than the one before foretold.

        That is after a new command, or where this tick is not `dt_s` later.
        """
        late_s = (now_ns - self._ticked_ns) / 1e9 - dt_s
        anew, self._anew, self._ticked_ns = self._anew, False, now_ns
        return anew or abs(late_s) > 0.5 * dt_s

    def live(self, now_ns: int) -> Command | None:
        """The newest command, None where there is none or the stream has fallen silent."""
        if self.newest is None or now_ns - self.newest.received_ns > self._timeout_s * 1e9:
            return None
        return self.newest.record

    def ahead_s(self, now_ns: int) -> float:
        """How far `now_ns` is past the time the newest command is meant for.

        The stream is a function of time, so a late command meets the path its predecessors
        foretold. Nothing bounds it but the end of the stream, which comes a time-out after the
        command did: a bound that is met before that, as by the last command where it was held up
        on its way, would stop the reference in one tick.
        """
        return max((now_ns - self._base_ns) / 1e9, 0.0)

    def end(self) -> None:
        """Follow nobody; what was heard already is not new when it comes again."""
        self.newest = None

    def forget(self) -> None:
        """Follow nobody, and know nobody."""
        self.newest, self._source, self._last_seq = None, None, -1
