"""The end of a robot's node: what it moves is braked first, for as long as that may take."""

from __future__ import annotations

from collections.abc import Callable

from vla_zenoh.bus.clock import FixedRate, Tick
from vla_zenoh.bus.node import Node
from vla_zenoh.guard.arm_guard import max_braking_time_s
from vla_zenoh.robots.command_follower import CommandFollower
from vla_zenoh.sanitize import one_line
from vla_zenoh.types import Event

FAILURES = 3
"""Once so many turns in a row have raised, nothing brakes the arm any more."""
LEAST_S, SLACK_S = 1.0, 0.2
"""It is waited for so long at least, and for so much longer than the limits say: loops are late."""
MAX_WORDS = 300


class ShutdownBrake:
    """See the module.

    Args:
        node: that ends.
        lead: of its arm.
    """

    def __init__(self, node: Node, lead: CommandFollower) -> None:
        self._node, self._lead = node, lead
        self._patience_s = max(LEAST_S, max_braking_time_s(node.profile) + SLACK_S)
        self._until_ns = 0

    def over(self, mono_ns: int) -> bool:
        """Whether the node may end. Ask after each turn: from the first time on nobody is obeyed.

        Args:
            mono_ns: of the turn, on the monotonic clock.
        """
        self._lead.deafen()
        if not self._lead.sending:
            return True
        self._until_ns = self._until_ns or mono_ns + round(self._patience_s * 1e9)
        if mono_ns < self._until_ns:
            return False
        self._tell(
            f"after {self._patience_s:.1f} s it is still being braked, and left where it is: the "
            "loop came too late too often"
        )
        return True

    def wind_down(self, pace: FixedRate, turn: Callable[[Tick], None]) -> bool:
        """Brake after something went wrong, by nothing but `turn`, which may fail now and then.

        Returns:
            whether the arm was led to rest.
        """
        self._lead.deafen()
        failures = 0
        while self._lead.sending:
            tick = pace.wait()
            try:
                turn(tick)
                failures = 0
            except Exception as error:
                failures += 1
                if failures == FAILURES:
                    self._tell(f"it cannot be braked: {one_line(error, MAX_WORDS)}")
                    return False
            if self.over(tick.nominal_ns):
                break
        return not self._lead.sending

    def _tell(self, why: str) -> None:
        self._node.emit(Event("error", "fault", "not_braked", why))
