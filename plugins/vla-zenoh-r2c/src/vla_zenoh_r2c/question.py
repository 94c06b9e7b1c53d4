"""The question that a policy was asked last, and what came back. No Zenoh, no clock."""

from __future__ import annotations

from dataclasses import dataclass

from vla_zenoh.errors import CodecError, PeerError
from vla_zenoh.types import FloatArray
from vla_zenoh_r2c import wire
from vla_zenoh_r2c.declared import Numbers


@dataclass(slots=True)
class Question:
    """Knows which answer is wanted.

    Args:
        numbers: of the robot.
        horizon: longest chunk that is wanted.
        id: of the newest question.
        ignored: answers to earlier questions, and messages that are none.
        complaint: what was wrong with the last of those; empty: nothing.
        twice: an observation that was answered twice; 0: none was.
    """

    numbers: Numbers
    horizon: int
    id: int = 0
    ignored: int = 0
    complaint: str = ""
    twice: int = 0
    _answered: int = 0

    def ask(self, wall_ms: int) -> int:
        """The id of a new question.

        It grows across restarts, so no answer to an earlier process is taken for one to this.
        """
        self.id, self.complaint = max(self.id + 1, wall_ms), ""
        return self.id

    def ignore(self, why: str, times: int = 1) -> None:
        """Count what cannot be an answer."""
        self.ignored, self.complaint = self.ignored + times, why

    def take(self, payload: bytes) -> FloatArray | None:
        """(H, n) numbers in declared order of the answer to the newest question; None: it is not.

        Raises:
            PeerError: it is, and cannot be used.
        """
        try:
            steps = wire.decode_actions(payload)
        except CodecError as error:
            self.ignore(str(error))
            return None
        if steps.id == self._answered:
            self.twice = steps.id
        if steps.id != self.id or steps.id == self._answered:
            self.ignore(f"an answer to {steps.id}, asked was {self.id}")
            return None
        self._answered = steps.id
        if len(steps.position) > self.horizon:
            raise PeerError(
                "peer_reply",
                f"the answer has {len(steps.position)} steps, declared are at most {self.horizon} "
                "(horizon)",
            )
        try:
            return self.numbers.ordered(steps.names, steps.position)
        except CodecError as error:
            raise PeerError("peer_reply", f"the answer's {error}") from error
