"""Recording a number of episodes in turn: put the scene back, take, judge, next. Pure."""

from __future__ import annotations

from typing import Any, Literal

from vla_zenoh.errors import NodeError
from vla_zenoh.lab.recording.verdict import Verdict

Step = Literal["idle", "scene", "take", "judge", "export", "done"]
NEEDS: dict[str, tuple[Step, ...]] = {
    "begin": ("idle", "done"),
    "scene": ("scene",),
    "take": ("scene",),
    "end": ("take",),
    "again": ("judge",),
    "judge": ("judge",),
    "finish": ("scene",),
    "cancel": ("scene", "take", "judge"),
}
"""Request -> steps in which it is allowed."""


class EpisodeGuide:
    """The way through the takes of one data set.

    Attributes:
        step: idle; put the `scene` back; `take`, the arm is to run; `judge` it; `export`, the data
            set is being made; done.
        worker: the one that the arm obeyed last in this take, on which the verdict is.
    """

    def __init__(self) -> None:
        self.step: Step = "idle"
        self.wanted, self.verdicts, self.worker = 0, list[Verdict](), ""
        self._ran, self._text = False, ""

    @property
    def kept(self) -> int:
        """Takes that count."""
        return sum(verdict != "void" for verdict in self.verdicts)

    def require(self, request: str) -> None:
        """Raises NodeError: `request` has no place in this step; says what has."""
        if self.step not in NEEDS[request]:
            here = ", ".join(name for name, steps in NEEDS.items() if self.step in steps)
            raise NodeError(
                f"{request} has no place in the step {self.step} of the guide; now: "
                f"{here or 'wait until it has ended'}"
            )

    def begin(self, wanted: int) -> None:
        self.require("begin")
        self.wanted, self.verdicts = wanted, []
        self.step = "scene"

    def take(self) -> None:
        """The recording of a take runs, or goes on."""
        self.require("take" if self.step == "scene" else "again")
        if self.step == "scene":
            self.worker = ""
        self.step, self._ran = "take", False

    def observe(self, obeyed: str, *, by_hand: bool) -> None:
        """The worker that the arm obeys now, empty: none. A model's take ends when its run does.

        By hand each direction is a run of its own: the person says when the take ends.
        """
        if self.step != "take":
            return
        if obeyed:
            self._ran, self.worker = True, obeyed
        elif self._ran and not by_hand:
            self.step = "judge"

    def end(self) -> None:
        """A person ends the take."""
        self.require("end")
        self.step = "judge"

    def judge(self, verdict: Verdict) -> None:
        """A void take does not count: it is repeated."""
        self.require("judge")
        self.verdicts.append(verdict)
        self.step = "export" if self.kept >= self.wanted else "scene"

    def finish(self) -> None:
        """Make the data set of the takes so far."""
        self.require("finish")
        if not self.kept:
            raise NodeError("no take counts yet; cancel ends the guide without a data set")
        self.step = "export"

    def exported(self, text: str) -> None:
        """The data set is made, or why not."""
        self.step, self._text = "done", text

    def cancel(self) -> None:
        self.require("cancel")
        self.step = "idle"

    def described(self) -> dict[str, Any]:
        """For the page: step, counts, and a sentence that says what to do."""
        return {
            "step": self.step,
            "wanted": self.wanted,
            "kept": self.kept,
            "void": len(self.verdicts) - self.kept,
            "text": self._sentence(),
        }

    def _sentence(self) -> str:
        number = f"Episode {self.kept + 1} of {self.wanted}"
        match self.step:
            case "scene":
                return f"{number}: put the scene back, then press Take."
            case "take" if self._ran:
                return f"{number} is being recorded: let go, or End the take, when it is done."
            case "take":
                return f"{number} is being recorded: hold to run."
            case "judge":
                return f"{number}: did it succeed?"
            case "export":
                return f"Making the data set of {self.kept} episodes."
            case "done":
                return self._text
            case _:
                return ""
