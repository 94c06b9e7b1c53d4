"""Who holds the arm active: somebody who lets it obey only for as long as he is there himself.

A deadman's handle on the bus. His token is gone with his process, his computer or his network, and
then the arm brakes, as it does when a worker is gone.
"""

from __future__ import annotations

from collections.abc import Set as AbstractSet

from vla_zenoh.keys import NO_DEADMAN_TOKEN


class Deadman:
    """See the module. `name` is whose hand it is, empty while nobody's is needed."""

    def __init__(self) -> None:
        self.name = ""

    def begin(self, holder: str) -> None:
        """An activation begins, which `holder` holds, if not empty."""
        self.name = holder

    def refused(self, holder: str, there: AbstractSet[str], *, obeying: bool = False) -> list[str]:
        """Why `holder` cannot hold the arm active, empty when he can.

        Args:
            holder: empty: nobody, which is no reason.
            there: whose tokens are there.
            obeying: the arm obeys already.
        """
        reasons = []
        if holder and holder not in there:
            reasons.append(f"{holder!r}, who is to hold the arm active, {NO_DEADMAN_TOKEN}")
        if obeying and holder and self.name and holder != self.name:
            reasons.append(f"it obeys already, while {self.name!r} holds it; deactivate it first")
        return reasons

    def lost(self, there: AbstractSet[str]) -> str:
        """Why the arm must brake, empty when it need not."""
        if not self.name or self.name in there:
            return ""
        return f"{self.name!r}, who held the arm active, is gone"
