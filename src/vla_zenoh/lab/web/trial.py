"""A trial that a person at a page runs and judges, blind to the model.

It is `vla-zenoh trial` with buttons in place of lines: the same plan, order, folder and files.
"""

from __future__ import annotations

import queue
import threading
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from typing import Any

from vla_zenoh.bus.session import open_session
from vla_zenoh.client.client import Client
from vla_zenoh.errors import NodeError, VlaZenohError
from vla_zenoh.keys import key_chunk, worker_node
from vla_zenoh.lab.cli.output_path import RUNS
from vla_zenoh.lab.episode import Interrupted
from vla_zenoh.lab.trial.episode_fsm import EpisodeFsm, Phase
from vla_zenoh.lab.trial.folder import TrialFolder
from vla_zenoh.lab.trial.plan import TrialPlan
from vla_zenoh.lab.trial.runner import TrialRunner
from vla_zenoh.lab.trial.score import score
from vla_zenoh.lab.trial.verdict import END_WORDS, EpisodeVerdict
from vla_zenoh.profile import Profile

WAIT_S = 0.1
WATCHED_S = 2.0
"""An episode ends when the page that runs it has not echoed a tick for so long."""
NO_PAGE = 0
MAX_NOTES = 20
UNMASKED = frozenset({"is", "phase"})


class PageTrial:
    """The trial that runs, if one does; implements `Operator`. Safe to use from several threads."""

    def __init__(self, profile: Profile) -> None:
        self._profile = profile
        self._lock = threading.Lock()
        self._thread: threading.Thread | None = None
        self._stop = threading.Event()
        self._plan: TrialPlan | None = None
        self._answers: queue.SimpleQueue[tuple[int, str]] = queue.SimpleQueue()
        self._number = 0
        self._phase: Phase | None = None
        self._shown: dict[str, Any] = {}
        self._notes: dict[str, None] = {}
        self._page, self._watched_s = NO_PAGE, 0.0

    # -- for pages ----------------------------------------------------------------------------
    @property
    def runs(self) -> bool:
        return self._thread is not None and self._thread.is_alive()

    def state(self) -> dict[str, Any]:
        """What pages show; empty before the first trial."""
        return {**self._shown, "on": self.runs} if self._shown else {}

    def masked(self, message: dict[str, Any]) -> dict[str, Any] | None:
        """A message to pages without the names of models, while a blind trial runs.

        Also without what would tell one of them from the others: rows, log and pictures of workers.
        None: nothing of it may be told.
        """
        plan = self._plan
        if plan is None or not plan.blind or not self.runs:
            return message
        nodes = {worker_node(worker) for worker in plan.workers}
        if message.get("node") in nodes:
            return None
        if "nodes" in message:
            rows = [row for row in message["nodes"] if row["name"] not in nodes]
            message = {**message, "nodes": rows}
        if "seen" in message:
            message = {**message, "seen": []}
        return _masked(message, plan.hide)

    def begin(self, page: int, name: str, asked: Mapping[str, Any]) -> str:
        """Begin or continue the trial in the folder `name` of the runs.

        Args:
            asked: fields of its plan, None: as the folder has them.

        Raises:
            NodeError: one runs already.
            ProfileError: `name` is not one name.
            RecordError: a value of the plan is not allowed.
            RecordingError: the folder has another plan, or cannot be read or written.
        """
        folder = TrialFolder(RUNS / key_chunk(name, "trial"))
        with self._lock:
            if self.runs:
                raise NodeError("a trial runs already")
            if folder.plan() is None and not (asked["workers"] and asked["prompt"]):
                raise NodeError(f"{folder.path} holds no trial yet: say models and prompt")
            RUNS.mkdir(exist_ok=True)
            with folder.lock():
                plan = folder.agreed({**asked, "robot": self._profile.robot.name})
                found = folder.episodes()
            if plan.next_due(found) is None:
                return _result(plan, found)
            self._plan, self._stop = plan, threading.Event()
            self._notes = dict.fromkeys(each.note for each in found if each.note)
            self._page, self._watched_s = page, time.monotonic()
            self._shown = {"folder": str(folder.path), "prompt": plan.prompt, "of": plan.episodes}
            self._thread = threading.Thread(target=self._run, args=(folder, plan), name="trial")
            self._thread.start()
        return f"{folder.path}: {score(plan, found).done} of {plan.episodes} episodes done"

    def _run(self, folder: TrialFolder, plan: TrialPlan) -> None:
        try:
            with folder.lock(), open_session(self._profile.session) as session:
                client = Client(self._profile, session).subscribe()
                found = TrialRunner(client, plan, folder, self, self._stop).run()
            self._show(None, text=_result(plan, found))
        except Interrupted:
            self._show(None, text="ended; begin it again to continue")
        except VlaZenohError as error:
            self._show(None, text=f"ended: {error}; begin it again to continue")

    def answer(self, page: int, number: int, line: str) -> None:
        """A line of the person, to the question `number`; an answer to an older one is nothing."""
        self._page, self._watched_s = page, time.monotonic()
        self._answers.put((number, line))

    def watched(self, page: int, sent_s: float) -> None:
        """The page that runs it got what was sent at `sent_s` (monotonic)."""
        now_s = time.monotonic()
        if page == self._page and now_s - WATCHED_S < sent_s <= now_s:
            self._watched_s = sent_s

    def gone(self, page: int) -> None:
        if page == self._page:
            self._page = NO_PAGE

    def end(self) -> str:
        """Brake the arm, and end the trial; it can be continued."""
        self._stop.set()
        return "ending the trial"

    def close(self) -> None:
        """End it, and wait for that."""
        self._stop.set()
        if self._thread is not None:
            self._thread.join()

    # -- as the operator of the runner --------------------------------------------------------
    def _show(self, episode: EpisodeFsm | None, **more: Any) -> None:
        """Tell pages about an episode; None: the trial is over."""
        with self._lock:
            kept = {name: self._shown.get(name) for name in ("folder", "prompt", "of")}
            phase = None if episode is None else episode.phase
            if phase is not self._phase:
                self._number, self._phase = self._number + 1, phase
                self._watched_s = time.monotonic()
            kept |= {"number": self._number, "phase": phase or "over", "text": "", **more}
            if episode is not None and self._plan is not None:
                plan, due, view = self._plan, episode.due, episode.view
                kept |= {
                    "at": (due.setup - 1) * len(plan.workers) + due.turn,
                    "setup": due.setup,
                    "words": plan.words(due.setup),
                    "worker": "" if plan.blind else due.worker,
                    "time_s": round(episode.time_s, 1),
                    "seconds": episode.seconds,
                    "chunks": view.chunks,
                    "state": view.state,
                    "notes": list(self._notes)[-MAX_NOTES:],
                }
            self._shown = kept

    def _text(self) -> str:
        return self._shown.get("text", "")

    def ask(self, episode: EpisodeFsm) -> str:
        text = self._text()
        if episode.phase is Phase.BLOCKED:
            text = episode.reasons
        elif episode.phase is Phase.SETUP and episode.needs_confirmation:
            text = "the arm was deactivated: check that it may move"
        self._show(episode, text=text)
        while not self._stop.is_set():
            line = self._next(WAIT_S)
            if line is not None:
                return line
        raise Interrupted

    def _next(self, timeout_s: float) -> str | None:
        """An answer to the question that is open."""
        with suppress(queue.Empty):
            number, line = self._answers.get(timeout=timeout_s)
            if number == self._number:
                note = line.partition(" ")[2].strip()
                if note:
                    self._notes[note] = None
                return line
        return None

    def poll_line(self) -> str | None:
        """See `Operator`; an episode without a watching page is ended."""
        if self._page == NO_PAGE or time.monotonic() - self._watched_s > WATCHED_S:
            self.notify("ended: the page that ran it was closed, hidden or not connected")
            return ""
        return self._next(0.001)

    def reject_line(self, line: str, phase: Phase) -> None:
        self.notify(f"{line[:80]!r} is not valid in phase {phase}")

    def show(self, episode: EpisodeFsm) -> None:
        self._show(episode)

    def show_end(self, episode: EpisodeFsm) -> None:
        assert episode.end is not None
        said = f"{self._text()}; " if self._text() else ""
        why = f": {episode.why}" if episode.why else ""
        text = f"{said}{END_WORDS[episode.end]}{why}; {episode.time_s:.1f} s"
        self._show(episode, text=text)

    def notify(self, text: str) -> None:
        with self._lock:
            self._shown = {**self._shown, "text": text}


def _result(plan: TrialPlan, episodes: list[EpisodeVerdict]) -> str:
    """How often each worker succeeded, of a trial that is over."""
    rows = (
        f"{each.worker} {each.successes} of {each.episodes}"
        for each in score(plan, episodes).workers
    )
    return f"finished: {', '.join(rows)}"


def _masked(value: Any, hide: Callable[[str], str]) -> Any:
    if isinstance(value, str):
        return hide(value)
    if isinstance(value, Mapping):
        return {k: v if k in UNMASKED else _masked(v, hide) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [_masked(each, hide) for each in value]
    return value
