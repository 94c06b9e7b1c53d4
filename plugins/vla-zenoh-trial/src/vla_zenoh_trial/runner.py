"""Runs a trial on a robot: activates, records every episode, and keeps the operator's verdicts."""

from __future__ import annotations

import threading
import time
from contextlib import suppress
from dataclasses import asdict, replace
from typing import Protocol

import numpy as np

from vla_zenoh.client.client import Client
from vla_zenoh.errors import NodeError, SessionError
from vla_zenoh.keys import worker_node
from vla_zenoh.lab.episode import EpisodeRunner, EpisodeView, Interrupted
from vla_zenoh.lab.newest_records import NewestRecords
from vla_zenoh.lab.recording.recorder import Recorder
from vla_zenoh.lab.recording.verdict import FACT
from vla_zenoh.types import PoseState
from vla_zenoh_trial.episode_fsm import EpisodeFsm, Phase
from vla_zenoh_trial.folder import TrialFolder
from vla_zenoh_trial.plan import DueEpisode, TrialPlan
from vla_zenoh_trial.verdict import End, EpisodeVerdict

POLL_S = 0.05
REST_PATIENCE_S = 5.0
SPEC_PATIENCE_S = 3.0
"""A spec is published once a second, and a recording without it cannot become a dataset."""
TASK_PATIENCE_S = 5.0
INACTIVE_PATIENCE_S = 0.5
RECORDER_PATIENCE_S = 2.0
GRACE_S = 2.0
"""The watchdog ends an episode this long after its time limit."""
START_TOLERANCE_M = 0.01
"""The operator is warned when the arm starts further than this from where the trial began."""
NOT_AT_REST = "the command node does not report that the arm is at rest; see `vla-zenoh status`"


class Operator(Protocol):
    """The person, or script, that sets scenes up and judges episodes."""

    def ask(self, episode: EpisodeFsm) -> str:
        """Wait for a line in phase SETUP, BLOCKED or JUDGE. Raises Interrupted: Ctrl-C."""
        ...

    def poll_line(self) -> str | None:
        """A line entered while the arm moves; None: none."""
        ...

    def reject_line(self, line: str, phase: Phase) -> None:
        """The line has no meaning in this phase."""
        ...

    def show(self, episode: EpisodeFsm) -> None:
        """The running episode; called often."""
        ...

    def show_end(self, episode: EpisodeFsm) -> None:
        """The episode is over, and the arm was braked."""
        ...

    def notify(self, text: str) -> None:
        """A warning."""
        ...


class TrialRunner:
    """Runs the episodes of a trial that have no verdict yet.

    Args:
        folder: created, and locked by this process.
    """

    def __init__(
        self,
        client: Client,
        plan: TrialPlan,
        folder: TrialFolder,
        operator: Operator,
        stop: threading.Event,
    ) -> None:
        self._client, self._plan, self._folder = client, plan, folder
        self._operator, self._stop = operator, stop
        self._runner = EpisodeRunner(client, stop)
        self._done = folder.episodes()
        self._recorder: Recorder | None = None
        self._number = 0
        self._last_end: End | None = None
        self._over = threading.Event()
        self._states = NewestRecords(client.session, {PoseState: client.keys.state_pose})

    def run(self) -> list[EpisodeVerdict]:
        """Run what is due; the verdicts of the whole trial.

        Raises:
            Interrupted: Ctrl-C; the arm is at rest.
            SessionError: no command node.
            NodeError: another recorder is running.
            RecordingError: the disk is full or broken.
        """
        try:
            if not self._client.wait_for(lambda: self._client.task is not None, TASK_PATIENCE_S):
                raise SessionError("no task received from a command node")
            for worker in self._plan.workers:
                if worker_node(worker) not in self._client.alive:
                    self._operator.notify(f"worker {worker!r} is not alive")
            while (due := self._plan.next_due(self._done)) is not None:
                self._episode(due)
        finally:
            self._states.close()
        return self._done

    # -- one episode --------------------------------------------------------------------------
    def _episode(self, due: DueEpisode) -> None:
        episode, self._last_end = EpisodeFsm(due, self._plan.seconds, self._last_end), None
        try:
            while episode.phase is not Phase.OVER:
                self._step(episode)
        except BaseException:
            # Brake first, even where the terminal is gone or the disk full.
            at_rest = True
            try:
                if episode.phase in (Phase.START, Phase.RUN, Phase.BRAKE):
                    at_rest = self._brake()
            finally:
                if episode.began_ns:
                    episode.abort()
                    self._keep(episode)
                else:
                    self._discard()
            if not at_rest:
                self._operator.notify(NOT_AT_REST)
            raise
        self._last_end = episode.end
        self._keep(episode)

    def _step(self, episode: EpisodeFsm) -> None:
        if self._stop.is_set():
            raise Interrupted
        if episode.phase is Phase.START:
            self._start(episode)
        elif episode.phase is Phase.RUN:
            self._follow(episode)
        elif episode.phase is Phase.BRAKE:
            at_rest = self._brake()
            episode.stopped(self._view())
            self._operator.show_end(episode)
            if not at_rest:
                self._operator.notify(NOT_AT_REST)
        else:
            if episode.phase is Phase.SETUP:
                self._compare_start_pose()
            line = self._operator.ask(episode)
            if not episode.enter(line):
                self._operator.reject_line(line, episode.phase)

    def _start(self, episode: EpisodeFsm) -> None:
        client, worker = self._client, episode.due.worker
        # The task of the last episode may be a little older than the status of its end.
        client.wait_for(lambda: client.task is None or not client.task.active, INACTIVE_PATIENCE_S)
        task = client.task
        if task is not None and task.active:
            episode.rejected(
                f"the arm already follows worker {task.worker!r}: another client uses it, or left "
                "it active (`vla-zenoh deactivate`)"
            )
            return
        self._record(worker)
        if self._stop.is_set():
            raise Interrupted
        try:
            client.set_worker(worker)
            client.set_prompt(self._plan.prompt)
            began_ns, start_m = time.time_ns(), self._tcp_m()
            self._runner.activate("trial")
        except SessionError as error:
            self._brake()  # a late reply may still activate
            self._discard()
            episode.rejected(str(error))
            return
        episode.started(time.monotonic(), began_ns, start_m)
        self._over = threading.Event()
        threading.Thread(target=self._watchdog, args=(self._over,), daemon=True).start()

    def _watchdog(self, over: threading.Event) -> None:
        """Deactivate on its own thread: a terminal that blocks output would hold up the other."""
        end_s = time.monotonic() + self._plan.seconds + GRACE_S
        while not over.wait(POLL_S):
            if self._stop.is_set() or time.monotonic() > end_s:
                self._client.publish(self._client.keys.active, "false")
                return

    def _follow(self, episode: EpisodeFsm) -> None:
        episode.update(self._view(), time.monotonic())
        if episode.phase is not Phase.RUN:
            return
        self._operator.show(episode)
        line = self._operator.poll_line()
        if line is not None:
            episode.enter(line)
        else:
            self._stop.wait(POLL_S)

    def _view(self) -> EpisodeView:
        failure = self._recorder.recorded.failure if self._recorder else ""
        return replace(self._runner.view(), recording=failure)

    def _brake(self) -> bool:
        """Deactivate; whether the arm is at rest."""
        at_rest = self._client.deactivate(REST_PATIENCE_S)
        self._over.set()
        if self._recorder is not None:
            self._recorder.stop_listening()
        return at_rest

    # -- recording and verdict ----------------------------------------------------------------
    def _record(self, worker: str) -> None:
        client = self._client
        self._number = self._folder.next_number(self._done)
        self._recorder = recorder = self._new_recorder().start()
        spec = client.keys.spec(worker)
        client.wait_for(
            lambda: recorder.recorded.samples[spec] or self._stop.is_set(), SPEC_PATIENCE_S
        )

    def _new_recorder(self) -> Recorder:
        """A recorder, also where the router still announces the last one."""
        path = self._folder.recording(self._number)
        give_up_s = time.monotonic() + RECORDER_PATIENCE_S
        while True:
            try:
                return Recorder(self._client.profile, self._client.session, path)
            except NodeError:
                if time.monotonic() > give_up_s:
                    raise
            self._runner.pause(POLL_S)

    def _discard(self) -> None:
        """Remove the recording of an episode that did not start."""
        recorder, self._recorder = self._recorder, None
        if recorder is not None:
            recorder.close()
            recorder.recorded.path.unlink(missing_ok=True)

    def _keep(self, episode: EpisodeFsm) -> None:
        """Write the verdict to the folder, then to the end of the recording."""
        recorder, self._recorder = self._recorder, None
        if recorder is None:
            verdict = episode.verdict(self._folder.next_number(self._done), "", 0)
        else:
            recorded = recorder.recorded
            dropped = recorded.dropped.total()
            verdict = episode.verdict(self._number, recorded.path.name, dropped)
        try:
            self._folder.append(verdict)
        finally:
            if recorder is not None:
                plan = self._plan
                words = plan.words(verdict.setup)
                recorder.close({FACT: {**asdict(verdict), "prompt": plan.prompt, "words": words}})
        self._done.append(verdict)
        if recorder is not None and recorder.recorded.failure:
            self._operator.notify(f"the recording: {recorder.recorded.failure}")
        if verdict.dropped:
            self._operator.notify(f"{verdict.recording} lacks {verdict.dropped} samples")

    # -- start pose ---------------------------------------------------------------------------
    def _tcp_m(self) -> tuple[float, float, float] | None:
        with suppress(NodeError):
            _, pose = self._states.read(PoseState)
            x_m, y_m, z_m = (round(float(value), 4) for value in pose.position_m)
            return x_m, y_m, z_m
        return None

    def _compare_start_pose(self) -> None:
        """Warn where the arm is far from the start of the first episode."""
        first_m = next((each.start_m for each in self._done if each.start_m is not None), None)
        here_m = self._tcp_m()
        if first_m is None or here_m is None:
            return
        apart_m = float(np.linalg.norm(np.subtract(here_m, first_m)))
        if apart_m > START_TOLERANCE_M:
            self._operator.notify(
                f"the arm is {apart_m * 1e3:.0f} mm from the start pose of the first episode"
            )
