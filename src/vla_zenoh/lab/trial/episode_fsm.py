"""How one episode goes, as a state machine without clock, robot or person.

LAY     the setup is being laid            an empty line            -> GIVE
GIVE    worker, prompt, active are put     given -> RUN, refused    -> REPAIR
REPAIR  somebody repairs what was missing  an empty line -> GIVE, x -> OVER
RUN     the arm obeys                      its end                  -> BRAKE
BRAKE   deactivated, until the arm stands  it stands                -> JUDGE, OVER
JUDGE   the person says how it was         a verdict                -> OVER
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

from vla_zenoh.lab.trial.plan import DueEpisode
from vla_zenoh.lab.trial.verdict import End, EpisodeVerdict, Verdict, read_verdict

DONE_S = 0.5
"""A policy that says it is done while the arm stands for so long means it."""


TAKEN_AWAY: frozenset[End] = frozenset({"taken", "stopped", "lost"})
"""Ends of which neither the trial, nor its person, nor the model was the cause."""


class Phase(StrEnum):
    """See the module."""

    LAY = "lay"
    GIVE = "give"
    REPAIR = "repair"
    RUN = "run"
    BRAKE = "brake"
    JUDGE = "judge"
    OVER = "over"


@dataclass(frozen=True, slots=True)
class EpisodeView:
    """What is seen of the robot while it runs.

    Args:
        active: the arm obeys.
        ours: the episode that was begun, with its worker and prompt.
        state: of the command node, one word.
        why: what that says of it.
        done: the policy says so, and the arm stands.
        chunks: carried out.
        holds: times it braked for want of a chunk, since the beginning.
        deactivated: it obeys no more because somebody said so.
        recording: what is wrong with it, empty: nothing.
    """

    active: bool = True
    ours: bool = True
    state: str = "active"
    why: str = ""
    done: bool = False
    chunks: int = 0
    holds: int = 0
    deactivated: bool = False
    recording: str = ""


class EpisodeFsm:
    """See the module.

    Args:
        due: which episode.
        seconds: it lasts at most so long.
        after: what ended the one before, in the same run.
    """

    def __init__(self, due: DueEpisode, seconds: float, after: End | None = None) -> None:
        self.due, self.seconds, self.after = due, seconds, after
        self.phase = Phase.LAY
        self.reasons = ""
        """Why the arm was not given the last time."""
        self.seen = EpisodeView()
        self.time_s = 0.0
        self.began_ns = 0
        self.start_m: tuple[float, float, float] | None = None
        self._began_s = 0.0
        self._done_since_s: float | None = None
        self._end: End | None = None
        self._why = ""
        self._verdict: Verdict | None = None
        self._note = ""

    @property
    def end(self) -> End | None:
        """What ended it; None: nothing yet."""
        return self._end

    @property
    def needs_confirmation(self) -> bool:
        """Something else than this trial took the arm away before: whoever it was may have his
        hands at it, so that somebody has to say that it may move, whatever was said beforehand."""
        return self.after in TAKEN_AWAY

    @property
    def why(self) -> str:
        """In the command node's words; empty where nothing is to be said."""
        return self._why

    # -- what happens -------------------------------------------------------------------------
    def typed(self, line: str) -> bool:
        """A line of the person; False: it means nothing here."""
        verdict = read_verdict(line)
        if self.phase in (Phase.LAY, Phase.REPAIR) and not line.strip():
            self.phase = Phase.GIVE
        elif self.phase is Phase.REPAIR and verdict is not None and verdict[0] == "void":
            self._end, self._why = "refused", self.reasons
            self._judge(*verdict)
        elif self.phase is Phase.RUN:  # whatever is typed, an arm that moves is to stand
            self._ends("person")
            if verdict is not None:
                self._verdict, self._note = verdict
        elif self.phase is Phase.JUDGE and verdict is not None:
            self._judge(*verdict)
        else:
            return False
        return True

    def refused(self, reasons: str) -> None:
        """The arm was not given."""
        self.reasons, self.phase = reasons, Phase.REPAIR

    def given(
        self, now_s: float, began_ns: int, start_m: tuple[float, float, float] | None
    ) -> None:
        """The arm obeys.

        Args:
            now_s: any clock that only goes on.
            began_ns: wall clock.
            start_m: (3,) where the TCP is, base frame.
        """
        self._began_s, self.began_ns, self.start_m = now_s, began_ns, start_m
        self.phase = Phase.RUN

    def look(self, look: EpisodeView, now_s: float) -> None:
        """The robot was looked at while it runs, by the clock of `given`."""
        self.seen, self.time_s = look, now_s - self._began_s
        if not look.done:
            self._done_since_s = None
        elif self._done_since_s is None:
            self._done_since_s = now_s
        if not look.active:
            self._ends("lost")
        elif not look.ours:
            self._ends("taken")
        elif look.recording:
            self._ends("recording")
        elif self._done_since_s is not None and now_s - self._done_since_s >= DONE_S:
            self._ends("policy")
        elif self.time_s >= self.seconds:
            self._ends("time")

    def braked(self, look: EpisodeView) -> None:
        """It is over, and the arm stands or does not say so; `look` was made afterwards."""
        self.seen = look
        if self._end == "lost":  # what was heard last says why
            if look.state == "stopped":
                self._end = "stopped"
            elif look.deactivated:
                self._end = "taken"
        if self._end == "recording":
            self._why = look.recording
        elif self._end in ("lost", "stopped", "taken"):
            self._why = look.why
        self.phase = Phase.JUDGE if self._verdict is None else Phase.OVER

    def break_off(self) -> None:
        """Nobody will judge it: it is void."""
        self._end = "broken_off"
        self._judge("void", "")

    def _ends(self, end: End) -> None:
        self._end, self.phase = end, Phase.BRAKE

    def _judge(self, verdict: Verdict, note: str) -> None:
        self._verdict, self._note, self.phase = verdict, note, Phase.OVER

    # -- what became of it --------------------------------------------------------------------
    def judged(self, number: int, recording: str, dropped: int) -> EpisodeVerdict:
        """The record of it, in phase OVER.

        Args:
            number: of the attempt.
            recording: file name, empty: none.
            dropped: samples that are missing in it.
        """
        assert self._verdict is not None
        assert self._end is not None
        return EpisodeVerdict(
            number,
            self.due.setup,
            self.due.turn,
            self.due.worker,
            self._verdict,
            self._note,
            self._end,
            self._why,
            round(self.time_s, 3),
            self.seen.chunks,
            self.seen.holds + (self._end == "lost"),
            self.began_ns,
            self.start_m,
            recording,
            dropped,
        )
