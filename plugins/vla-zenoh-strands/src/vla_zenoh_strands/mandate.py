"""Who may move the arm, and whose order is in force. No Zenoh, no clock.

Anybody may stop it; only a peer that was named may move it, one at a time, for as long as that peer
is heard.
"""

from __future__ import annotations

import math
from collections import OrderedDict
from dataclasses import dataclass, field

from vla_zenoh_strands.identity import Authorities, speaks_for
from vla_zenoh_strands.wire import EVERYBODY, Command, Message, Order, RefusalError, order_of

SILENT_S = 2.0
"""A commander announces itself every 0.5 s; after four that are missing the arm brakes."""
MAX_AGE_S = 5.0
"""An order that is older, or this far in the future, is refused."""
MAX_TURNS = 4096
"""Orders that are remembered, so that none is carried out twice."""


@dataclass
class Mandate:
    """Judges orders.

    Args:
        us: our peer's name.
        obeyed: peers that may give orders.
        authorities: who issues their certificates; None: names are believed.
        longest_s: of one order.
    """

    us: str
    obeyed: frozenset[str]
    authorities: Authorities | None = None
    longest_s: float = 60.0
    commander: str = ""
    """Whose order is in force; empty: nobody's."""
    _until_s: float = 0.0
    _heard_s: dict[str, float] = field(default_factory=dict)
    _turns: OrderedDict[str, None] = field(default_factory=OrderedDict)

    def hear(self, presence: Message, wall_s: float, now_s: float) -> None:
        """A peer announces itself.

        Args:
            presence: what it says.
            wall_s: wall clock.
            now_s: monotonic clock.

        Raises:
            RefusalError: its certificate does not speak for it.
        """
        name = presence.get("robot_id")
        if not isinstance(name, str) or name not in self.obeyed:
            return
        self._require_signature(presence, name, wall_s)
        self._heard_s[name] = now_s

    def judge(self, command: Command, wall_s: float, now_s: float) -> Order:
        """The order of a command, which is in force from now on.

        Raises:
            RefusalError: it may not be carried out; nothing has changed.
        """
        who = command.sender
        if who not in self.obeyed:
            named = "no peer is" if not self.obeyed else "others are"
            raise RefusalError("not_obeyed", f"{who or 'no sender'}: {named} obeyed here")
        once = self._require_signature(command.body, who, wall_s)
        target = command.body.get("target_id", self.us)
        if target not in (self.us, EVERYBODY):
            raise RefusalError("not_for_us", f"it is for {target!r:.80}")
        if command.sent_s is None or abs(wall_s - command.sent_s) > MAX_AGE_S:
            raise RefusalError(
                "stale",
                f"it was not sent within the last {MAX_AGE_S:g} s; synchronise the clocks",
            )
        once = once or f"{who} {command.turn}"
        if once in self._turns:
            raise RefusalError("replayed", "it came before")
        if now_s - self._heard_s.get(who, -SILENT_S) >= SILENT_S:
            raise RefusalError(
                "unheard", f"{who} has not announced itself within the last {SILENT_S:g} s"
            )
        if self.commander:
            raise RefusalError("busy", f"an order of {self.commander} is in force")
        order = order_of(command.fields, self.longest_s)
        self._turns[once] = None
        while len(self._turns) > MAX_TURNS:
            self._turns.popitem(last=False)
        self.commander, self._until_s = who, math.inf
        return order

    def begin(self, order: Order, now_s: float) -> None:
        """The arm is active: its time runs."""
        self._until_s = now_s + order.duration_s

    def over(self, now_s: float) -> str:
        """Why the order has to end: ``completed``, ``silent``; empty: it has not."""
        if now_s - self._heard_s[self.commander] >= SILENT_S:
            return "silent"
        return "completed" if now_s >= self._until_s else ""

    def end(self) -> None:
        """No order is in force."""
        self.commander = ""

    def _require_signature(self, message: Message, peer: str, wall_s: float) -> str:
        """What names a signed message, empty where none is needed."""
        if self.authorities is None:
            return ""
        found = self.authorities.verify(message, wall_s)
        if not speaks_for(found.name, peer):
            raise RefusalError(
                "unsigned", f"the certificate of {found.name} does not speak for {peer}"
            )
        return found.once
