"""What a trial wants of the person at it."""

from __future__ import annotations

from typing import Protocol

from vla_zenoh.lab.trial.episode_fsm import EpisodeFsm, Phase


class Operator(Protocol):
    """Who lays setups and judges."""

    def ask(self, conduct: EpisodeFsm) -> str:
        """A line for phase LAY, REPAIR or JUDGE; waits for it.

        Raises:
            Interrupted: Ctrl-C.
        """
        ...

    def typed(self) -> str | None:
        """A line that was typed while the arm moves; None: none was."""
        ...

    def misunderstood(self, line: str, phase: Phase) -> None:
        """It means nothing in this phase."""
        ...

    def watch(self, conduct: EpisodeFsm) -> None:
        """The arm moves; called often."""
        ...

    def ended(self, conduct: EpisodeFsm) -> None:
        """The episode is over, and the arm was braked."""
        ...

    def tell(self, text: str) -> None:
        """Something else that has to be known."""
        ...
