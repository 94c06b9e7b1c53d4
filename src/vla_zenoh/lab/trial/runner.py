"""Carries a trial out on a robot: a person's puts, a recording of each episode, and the verdicts.

The machine that says what comes next is `vla_zenoh.lab.trial.episode_fsm`; here are clock,
session and recorder. Whatever ends a run, the arm is braked first.
"""

from __future__ import annotations

import threading
import time
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path
from typing import Protocol

import numpy as np
import zenoh

from vla_zenoh.bus.buffers import LatestSample
from vla_zenoh.bus.client import Client
from vla_zenoh.bus.payload_limits import bytes_of
from vla_zenoh.codec import records
from vla_zenoh.errors import CodecError, NodeError, SessionError
from vla_zenoh.keys import worker_node
from vla_zenoh.lab.episode import Interrupted
from vla_zenoh.lab.recording.recorder import Recorder
from vla_zenoh.lab.trial.episode_fsm import EpisodeFsm, EpisodeView, Phase
from vla_zenoh.lab.trial.folder import TrialFolder
from vla_zenoh.lab.trial.plan import DueEpisode, TrialPlan
from vla_zenoh.lab.trial.verdict import FACT, End, EpisodeVerdict
from vla_zenoh.types import PoseState, Task

COMMAND = "command"
LOOK_S = 0.05
STAND_PATIENCE_S = 5.0
SPEC_PATIENCE_S = 3.0
"""A spec is said once a second, and a recording without it cannot become a dataset."""
HEAR_PATIENCE_S = 5.0
LET_GO_S = 0.5
GONE_PATIENCE_S = 2.0
GRACE_S = 2.0
"""An episode that goes on for so long after its time is ended by the guard."""
FURTHER_M = 0.01
"""Where an arm begins may differ by this much before it is told."""
DOES_NOT_STAND = "the command node does not say that the arm stands; look at `vla-zenoh status`"


class TrialRunner:
    """See the module.

    Args:
        client: already hears the nodes.
        plan: what is to be done.
        folder: begun, and nobody else's while this runs.
        person: who judges.
        stop: set by Ctrl-C.
    """

    def __init__(
        self,
        client: Client,
        plan: TrialPlan,
        folder: TrialFolder,
        person: Operator,
        stop: threading.Event,
    ) -> None:
        self._client, self._plan, self._folder = client, plan, folder
        self._person, self._stop = person, stop
        self._done = folder.episodes()
        self._recorder: Recorder | None = None
        self._number = 0
        self._ended: End | None = None
        self._task: Task | None = None
        self._guarded = threading.Event()
        self._holds, self._deactivated = 0, False
        self._pose = LatestSample()
        self._subscriber = client.session.declare_subscriber(
            client.keys.state_pose, zenoh.handlers.Callback(self._pose, indirect=False)
        )

    def run(self) -> list[EpisodeVerdict]:
        """Every episode that is still to be done; all that were ever done.

        Raises:
            Interrupted: Ctrl-C; the arm stands.
            SessionError: there is no command node.
            NodeError: another recorder is at work.
            RecordingError: the disk takes no more.
        """
        try:
            if not self._client.wait_for(lambda: self._client.task is not None, HEAR_PATIENCE_S):
                raise SessionError("no command node is heard")
            for worker in self._plan.workers:
                if worker_node(worker) not in self._client.alive:
                    self._person.tell(f"worker {worker!r} is not alive")
            while (due := self._plan.next_due(self._done)) is not None:
                self._episode(due)
        finally:
            self._subscriber.undeclare()
        return self._done

    # -- one episode --------------------------------------------------------------------------
    def _episode(self, due: DueEpisode) -> None:
        conduct, self._ended = EpisodeFsm(due, self._plan.seconds, self._ended), None
        try:
            while conduct.phase is not Phase.OVER:
                self._step(conduct)
        except BaseException:
            # First of all the arm: also where the terminal is gone, or the disk is full.
            stands = True
            try:
                if conduct.phase in (Phase.GIVE, Phase.RUN, Phase.BRAKE):
                    stands = self._brake()
            finally:
                if conduct.began_ns:
                    conduct.break_off()
                    self._keep(conduct)
                else:
                    self._discard()
            if not stands:
                self._person.tell(DOES_NOT_STAND)
            raise
        self._ended = conduct.end
        self._keep(conduct)

    def _step(self, conduct: EpisodeFsm) -> None:
        if self._stop.is_set():
            raise Interrupted
        if conduct.phase is Phase.GIVE:
            self._give(conduct)
        elif conduct.phase is Phase.RUN:
            self._watch(conduct)
        elif conduct.phase is Phase.BRAKE:
            stands = self._brake()
            conduct.braked(self._look())
            self._person.ended(conduct)
            if not stands:
                self._person.tell(DOES_NOT_STAND)
        else:
            if conduct.phase is Phase.LAY:
                self._tell_where_it_stands()
            line = self._person.ask(conduct)
            if not conduct.typed(line):
                self._person.misunderstood(line, conduct.phase)

    def _give(self, conduct: EpisodeFsm) -> None:
        """Worker, prompt and arm, as any other operator."""
        client, worker = self._client, conduct.due.worker
        # The task of the last episode may be a little older than the status that it ended.
        client.wait_for(lambda: client.task is None or not client.task.active, LET_GO_S)
        task = client.task
        if task is not None and task.active:
            conduct.refused(
                f"the arm obeys {task.worker!r} already: somebody else is at work, or has to "
                "deactivate it (`vla-zenoh deactivate`)"
            )
            return
        self._record(worker)
        if self._stop.is_set():
            raise Interrupted
        self._task = None
        try:
            client.set_worker(worker)
            client.set_prompt(self._plan.prompt)
            client.pop_events()
            self._holds, self._deactivated = 0, False
            began_ns, start_m = time.time_ns(), self._tcp_m()
            self._task = client.activate_with_deadman("trial")
        except SessionError as error:
            self._brake()  # a late answer may still have given the arm
            self._discard()
            conduct.refused(str(error))
            return
        conduct.given(time.monotonic(), began_ns, start_m)
        self._guarded = threading.Event()
        threading.Thread(target=self._guard, args=(self._guarded,), daemon=True).start()

    def _guard(self, over: threading.Event) -> None:
        """Brakes by itself: a terminal that takes no output would hold up everything else."""
        end_s = time.monotonic() + self._plan.seconds + GRACE_S
        while not over.wait(LOOK_S):
            if self._stop.is_set() or time.monotonic() > end_s:
                self._client.publish(self._client.keys.active, "false")
                return

    def _watch(self, conduct: EpisodeFsm) -> None:
        conduct.look(self._look(), time.monotonic())
        if conduct.phase is not Phase.RUN:
            return
        self._person.watch(conduct)
        line = self._person.typed()
        if line is not None:
            conduct.typed(line)
        else:
            self._stop.wait(LOOK_S)

    def _look(self) -> EpisodeView:
        given = self._task
        assert given is not None
        for node, _, event in self._client.pop_events():
            if node != COMMAND or event.kind != "transition":
                continue
            if event.what == "active->holding":
                self._holds += event.count
            elif event.what.endswith("->inactive"):
                self._deactivated = event.level == "info"
        task, status = self._client.task, self._client.status(COMMAND)
        if task is None or status is None:
            return EpisodeView(False, state="", why="no command node is heard")
        ours = task.episode == given.episode
        detail = status.detail
        mine = detail.get("episode") == given.episode
        return EpisodeView(
            active=task.active,
            ours=ours,
            state=status.state,
            why=str(detail.get("why", "")) if ours else _changed(given, task),
            done=bool(mine and detail.get("policy_done") and detail.get("at_rest")),
            chunks=int(detail.get("accepted_chunks", 0)) if mine else 0,
            holds=self._holds,
            deactivated=self._deactivated,
            recording=self._recorder.recorded.failure if self._recorder else "",
        )

    def _brake(self) -> bool:
        """Deactivate; whether the arm stands."""
        stands = self._client.deactivate(STAND_PATIENCE_S)
        self._guarded.set()
        if self._recorder is not None:
            self._recorder.stop_listening()
        return stands

    # -- what is kept of it -------------------------------------------------------------------
    def _record(self, worker: str) -> None:
        client = self._client
        self._number = self._folder.next_number(self._done)
        path = self._folder.recording(self._number)
        self._recorder = recorder = self._new_recorder(path).start()
        spec = client.keys.spec(worker)
        client.wait_for(
            lambda: recorder.recorded.samples[spec] or self._stop.is_set(), SPEC_PATIENCE_S
        )

    def _new_recorder(self, path: Path) -> Recorder:
        """Also where the router has not heard yet that the last one is gone."""
        give_up_s = time.monotonic() + GONE_PATIENCE_S
        while True:
            try:
                return Recorder(self._client.profile, self._client.session, path)
            except NodeError:
                if time.monotonic() > give_up_s:
                    raise
            if self._stop.wait(LOOK_S):
                raise Interrupted

    def _discard(self) -> None:
        """Nothing of it is worth keeping: the arm was not given."""
        recorder, self._recorder = self._recorder, None
        if recorder is not None:
            recorder.close()
            recorder.recorded.path.unlink(missing_ok=True)

    def _keep(self, conduct: EpisodeFsm) -> None:
        """The verdict onto the disk, then the recording's end, where it stands again."""
        recorder, self._recorder = self._recorder, None
        if recorder is None:
            number = self._folder.next_number(self._done)
            judged = conduct.judged(number, "", 0)
        else:
            recorded = recorder.recorded
            name, dropped = recorded.path.name, recorded.dropped.total()
            judged = conduct.judged(self._number, name, dropped)
        try:
            self._folder.append(judged)
        finally:
            if recorder is not None:
                plan = self._plan
                fact = {**asdict(judged), "prompt": plan.prompt, "words": plan.words(judged.setup)}
                recorder.close({FACT: fact})
        self._done.append(judged)
        if recorder is not None and recorder.recorded.failure:
            self._person.tell(f"the recording: {recorder.recorded.failure}")
        if judged.dropped:
            self._person.tell(f"{judged.recording} lacks {judged.dropped} samples")

    # -- where it begins ----------------------------------------------------------------------
    def _tcp_m(self) -> tuple[float, float, float] | None:
        arrival = self._pose.pop()
        if arrival is not None:
            with suppress(CodecError):
                pose = records.decode(PoseState, bytes_of(arrival.sample.payload))
                x_m, y_m, z_m = (round(float(value), 4) for value in pose.position_m)
                return x_m, y_m, z_m
        return None

    def _tell_where_it_stands(self) -> None:
        """Episodes are to begin alike: how far the arm is from where the first of all began."""
        first_m = next((each.start_m for each in self._done if each.start_m is not None), None)
        here_m = self._tcp_m()
        if first_m is None or here_m is None:
            return
        apart_m = float(np.linalg.norm(np.subtract(here_m, first_m)))
        if apart_m > FURTHER_M:
            self._person.tell(
                f"the arm stands {apart_m * 1e3:.0f} mm from where the first episode began"
            )


def _changed(given: Task, now: Task) -> str:
    if (now.worker, now.prompt) != (given.worker, given.prompt):
        return f"the worker is {now.worker!r} now, the prompt {now.prompt!r}"
    return "another episode began: somebody activated, or the command node was started anew"


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
