"""State machine of one trial episode, without clock, robot or operator. Pure.

SETUP    the scene is being set up           an empty line                   -> START
START    worker, prompt, activation          started -> RUN, rejected        -> BLOCKED
BLOCKED  activation was rejected             an empty line -> START, x       -> OVER
RUN      the arm is active                   any end                         -> BRAKE
BRAKE    deactivated, until the arm is at rest                               -> JUDGE, OVER
JUDGE    the operator judges                 a verdict                       -> OVER
"""

from __future__ import annotations

from enum import StrEnum

from vla_zenoh.lab.episode import EpisodeLimit, EpisodeView
from vla_zenoh.lab.recording.verdict import Verdict
from vla_zenoh_trial.plan import DueEpisode
from vla_zenoh_trial.verdict import End, EpisodeVerdict, read_verdict

DONE_S = 0.5
"""The episode ends when the policy has been done, and the arm at rest, for this long."""
EXTERNAL_ENDS: frozenset[End] = frozenset({"taken", "stopped", "lost"})
"""Ends that neither the trial, nor its operator, nor the model caused."""


class Phase(StrEnum):
    """Phase of a trial episode."""

    SETUP = "setup"
    START = "start"
    BLOCKED = "blocked"
    RUN = "run"
    BRAKE = "brake"
    JUDGE = "judge"
    OVER = "over"


class EpisodeFsm:
    """State machine of one trial episode."""

    def __init__(self, due: DueEpisode, seconds: float, after: End | None = None) -> None:
        self.due, self.seconds, self.after = due, seconds, after
        self.phase = Phase.SETUP
        self.reasons = ""
        """Why activation was rejected the last time."""
        self.view = EpisodeView()
        self.time_s = 0.0
        self.began_ns = 0
        self.start_m: tuple[float, float, float] | None = None
        self.end: End | None = None
        self.why = ""
        """The command node's reason for the end; empty for an ordinary one."""
        self._began_s = 0.0
        self._limit = EpisodeLimit(seconds, DONE_S)
        self._verdict: Verdict | None = None
        self._note = ""

    @property
    def needs_confirmation(self) -> bool:
        """A person may be at the arm: ask before it moves again."""
        return self.after in EXTERNAL_ENDS

    # -- transitions --------------------------------------------------------------------------
    def enter(self, line: str) -> bool:
        """A line from the operator; False: it has no meaning in this phase."""
        verdict = read_verdict(line)
        if self.phase in (Phase.SETUP, Phase.BLOCKED) and not line.strip():
            self.phase = Phase.START
        elif self.phase is Phase.BLOCKED and verdict is not None and verdict[0] == "void":
            self.end, self.why = "refused", self.reasons
            self._judge(*verdict)
        elif self.phase is Phase.RUN:  # any line stops a moving arm
            self._end("person")
            if verdict is not None:
                self._verdict, self._note = verdict
        elif self.phase is Phase.JUDGE and verdict is not None:
            self._judge(*verdict)
        else:
            return False
        return True

    def rejected(self, reasons: str) -> None:
        self.reasons, self.phase = reasons, Phase.BLOCKED

    def started(
        self, now_s: float, began_ns: int, start_m: tuple[float, float, float] | None
    ) -> None:
        """The arm is active.

        Args:
            now_s: monotonic clock.
            began_ns: wall clock.
            start_m: (3,) TCP, base frame.
        """
        self._began_s, self.began_ns, self.start_m = now_s, began_ns, start_m
        self.phase = Phase.RUN

    def update(self, view: EpisodeView, now_s: float) -> None:
        """State of the episode while it runs, by the clock of `started`."""
        self.view, self.time_s = view, now_s - self._began_s
        limit = self._limit.update(self.time_s, done=view.done)
        if not view.active:
            self._end("lost")
        elif not view.ours:
            self._end("taken")
        elif view.recording:
            self._end("recording")
        elif limit is not None:
            self._end(limit)

    def stopped(self, view: EpisodeView) -> None:
        """The arm was braked; `view` is from afterwards."""
        self.view = view
        if self.end == "lost":
            if view.state == "stopped":
                self.end = "stopped"
            elif view.deactivated:
                self.end = "taken"
        if self.end == "recording":
            self.why = view.recording
        elif self.end in EXTERNAL_ENDS:
            self.why = view.why
        self.phase = Phase.JUDGE if self._verdict is None else Phase.OVER

    def abort(self) -> None:
        self.end = "broken_off"
        self._judge("void", "")

    def _end(self, end: End) -> None:
        self.end, self.phase = end, Phase.BRAKE

    def _judge(self, verdict: Verdict, note: str) -> None:
        self._verdict, self._note, self.phase = verdict, note, Phase.OVER

    def verdict(self, number: int, recording: str, dropped: int) -> EpisodeVerdict:
        """The record of an episode in phase OVER. `recording`: file name, empty: none."""
        assert self._verdict is not None and self.end is not None
        return EpisodeVerdict(
            number,
            self.due.setup,
            self.due.turn,
            self.due.worker,
            self._verdict,
            self._note,
            self.end,
            self.why,
            round(self.time_s, 3),
            self.view.chunks,
            self.view.holds + (self.end == "lost"),
            self.began_ns,
            self.start_m,
            recording,
            dropped,
        )
