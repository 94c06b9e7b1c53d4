"""What is to be done."""

from __future__ import annotations

from dataclasses import dataclass

from vla_zenoh.types.checks import boolean, integer, number, set_field, text

LEAST_PERCENT = 1.0


@dataclass(frozen=True, slots=True)
class Task:
    """What is to be done now, as the command node has agreed to it.

    Args:
        episode: grows with every activation and every change of prompt or worker; a policy
            starts afresh with it and a chunk of an older episode is refused.
        active: the arm obeys the worker.
        prompt: plain text.
        worker: name of the worker whose chunks are obeyed.
        rate_hz: chunks per second asked of the workers.
        speed_percent: of the speed that is planned, so much is driven; 0: the arm stands, active.
    """

    episode: int
    active: bool
    prompt: str
    worker: str
    rate_hz: float
    speed_percent: float = 100.0

    def __post_init__(self) -> None:
        set_field(self, "episode", integer("episode", self.episode))
        set_field(self, "active", boolean("active", self.active))
        text("prompt", self.prompt)
        text("worker", self.worker, 128)
        set_field(self, "rate_hz", number("rate_hz", self.rate_hz, 0.01, 1000.0))
        set_field(self, "speed_percent", number("speed_percent", self.speed_percent, 0.0, 100.0))

    @property
    def speed(self) -> float:
        """Plan seconds per second, 0 to 1: a percent at least, or the arm stands."""
        return self.speed_percent / 100.0 if self.speed_percent >= LEAST_PERCENT else 0.0

    @property
    def requested_hz(self) -> float:
        """Chunks per second asked of the worker now: at half the speed half as many, 0 where the
        arm stands. A worker that is not obeyed is asked at the full rate."""
        return self.rate_hz * (self.speed if self.active else 1.0)
