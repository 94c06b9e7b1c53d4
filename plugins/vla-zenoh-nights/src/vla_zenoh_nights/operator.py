"""The operator of an unattended trial: resets the scene, follows the arm, and judges."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path

import numpy as np
from vla_zenoh_trial.episode_fsm import EpisodeFsm, Phase
from vla_zenoh_trial.folder import TrialFolder
from vla_zenoh_trial.plan import TrialPlan

from vla_zenoh.client.client import Client
from vla_zenoh.client.primitives import ask
from vla_zenoh.codec.image import encode_jpeg
from vla_zenoh.errors import NodeError, RecordingError
from vla_zenoh.lab.durable import write_whole, writing
from vla_zenoh.lab.episode import EpisodeRunner
from vla_zenoh.lab.newest_records import NewestRecords, StreamSlot
from vla_zenoh.lab.tasks.judge import TaskJudge
from vla_zenoh.lab.video import decoded_at_height
from vla_zenoh.types import GripperState, Image, ObjectPoses, PoseState
from vla_zenoh_nights.judge import Frame, Judge, JudgedEpisode, StateSample
from vla_zenoh_nights.plan import UnattendedPlan, UnattendedTask, is_contact_loss

FRAME_S, STATE_S = 1.0, 0.05
MAX_STATES, MAX_FRAMES = 40_000, 1_000
RETRY_S, REFUSED_S = 2.0, 60.0
"""Between two attempts to activate, and how long they are made."""
FRESH_S, STATE_PATIENCE_S = 0.3, 5.0
STRIP_HEIGHT_PX = 160
HOLDER = "trial"


class TrialStopped(Exception):
    """A rule, or a person, ended the unattended trial; says which."""


class UnattendedOperator:
    """Implements `Operator` without a person.

    Args:
        task: whose episodes are run.
        judge: of finished episodes; None: the simulator's.
        due_to_stop: called before each episode: why the trial has to stop, empty: go on.
    """

    def __init__(
        self,
        client: Client,
        plan: UnattendedPlan,
        task: UnattendedTask,
        trial: TrialPlan,
        folder: TrialFolder,
        judge: Judge | None,
        stop: threading.Event,
        due_to_stop: Callable[[], str],
        warn: Callable[[str], None],
    ) -> None:
        self._client, self._plan, self._task, self._trial = client, plan, task, trial
        self._folder, self._judge, self._warn = folder, judge, warn
        self._due_to_stop = due_to_stop
        self._runner = EpisodeRunner(client, stop)
        keys, session = client.keys, client.session
        wanted: dict[type, str] = {PoseState: keys.state_pose, GripperState: keys.state_gripper}
        if judge is None:
            wanted[ObjectPoses] = keys.sim_objects
        self._states = NewestRecords(session, wanted)
        self._pictures = {camera: StreamSlot() for camera in client.profile.cameras}
        self._subscribers = [
            slot.subscribe(session, keys.camera_jpeg(camera))
            for camera, slot in self._pictures.items()
        ]
        self._seen = JudgedEpisode(task.prompt)
        self._poses: TaskJudge | None = None
        self._poses_ns = 0
        self._source, self._began_s = "", 0.0
        self._episode: EpisodeFsm | None = None
        self._refused_s: float | None = None
        self._over = ""

    def close(self) -> None:
        self._states.close()
        for subscriber in self._subscribers:
            subscriber.undeclare()

    # -- Operator -----------------------------------------------------------------------------
    def ask(self, episode: EpisodeFsm) -> str:
        """See `Operator`.

        Raises:
            TrialStopped: a rule, or a person.
            NodeError: no reset, or no verdict.
        """
        if episode.phase is Phase.SETUP:
            return self._set_up(episode)
        if episode.phase is Phase.BLOCKED:
            return self._try_again(episode)
        return self._verdict(episode)

    def poll_line(self) -> str | None:
        """The verdict of the simulator's judge, as soon as it is certain."""
        self._sample()
        if self._poses is None:
            return None
        header, objects = self._states.read(ObjectPoses)
        if header.stamp_wall_ns <= self._poses_ns:
            return None
        self._poses_ns = header.stamp_wall_ns
        width_m = self._states.read(GripperState)[1].opening_m
        tcp_m = self._states.read(PoseState)[1].position_m
        verdict = self._poses.update(objects, width_m, self._time_s(), tcp_m)
        if verdict is None or self._robot_changed():
            return None
        assert self._episode is not None
        self._keep_strip(self._episode)
        return "y" if verdict.success else f"n {verdict.failure}"

    def reject_line(self, line: str, phase: Phase) -> None:
        raise NodeError(f"{line!r} in phase {phase}")

    def show(self, episode: EpisodeFsm) -> None:
        """See `Operator`."""

    def show_end(self, episode: EpisodeFsm) -> None:
        if episode.end == "stopped":
            self._over = f"an emergency stop: {episode.why}"
        elif episode.end == "taken":
            self._over = f"another client: {episode.why}"

    def notify(self, text: str) -> None:
        self._warn(text)

    # -- phases -------------------------------------------------------------------------------
    def _set_up(self, episode: EpisodeFsm) -> str:
        if why := self._over or self._due_to_stop():
            raise TrialStopped(why)
        if latched := self._client.latch_reason():
            raise TrialStopped(f"the robot is latched: {latched}")
        runner, reset = self._runner, self._plan.reset
        runner.wait_until_ready(episode.due.worker, self._states)
        if reset.simulator:
            runner.reset_simulator(self._plan.seed + episode.due.setup)
        elif reset.primitive:
            answer = ask(self._client, reset.primitive, {}, who=HOLDER)
            if not answer.ok:
                raise NodeError(f"{reset.primitive}: {answer.reason} {answer.why}".strip())
        else:
            self._reset_by_policy()
        since_s = time.monotonic()
        runner.pause(FRESH_S)
        runner.wait(
            lambda: not self._states.missing(since_s), STATE_PATIENCE_S, "no state after the reset"
        )
        self._begin(episode)
        return ""

    def _reset_by_policy(self) -> None:
        client, reset = self._client, self._plan.reset
        client.set_worker(reset.worker)
        client.set_prompt(reset.prompt)
        self._runner.activate(HOLDER)
        end_s = time.monotonic() + reset.seconds
        try:
            while time.monotonic() < end_s:
                view = self._runner.view()
                if view.state == "stopped":
                    raise TrialStopped(f"an emergency stop during the reset: {view.why}")
                if not (view.active and view.ours):
                    raise NodeError(f"the reset by {reset.worker} was broken off: {view.why}")
                if view.done:
                    return
                self._runner.pause(STATE_S)
        finally:
            client.deactivate()

    def _begin(self, episode: EpisodeFsm) -> None:
        self._seen, self._began_s = JudgedEpisode(self._task.prompt), 0.0
        self._episode = episode
        self._refused_s = None
        header, _ = self._states.read(PoseState)
        self._source = header.source
        if self._judge is None and self._task.order is not None:
            objects_header, objects = self._states.read(ObjectPoses)
            tcp_m = self._states.read(PoseState)[1].position_m
            self._poses = TaskJudge(self._task.order, objects, tcp_m)
            self._poses_ns = objects_header.stamp_wall_ns

    def _try_again(self, episode: EpisodeFsm) -> str:
        now_s = time.monotonic()
        self._refused_s = self._refused_s or now_s
        latched = self._client.latch_reason()
        if latched:
            self._over = f"the robot is latched: {latched}"
        if latched or now_s - self._refused_s > REFUSED_S:
            return f"x {episode.reasons.splitlines()[0][:200]}"
        self._runner.pause(RETRY_S)
        return ""

    def _verdict(self, episode: EpisodeFsm) -> str:
        self._sample(last=True)
        if episode.end == "lost" and is_contact_loss(episode.why) and not self._robot_changed():
            self._keep_strip(episode)
            return f"n {episode.why[:200]}"
        if episode.end not in ("policy", "time"):
            return f"x {episode.why[:200]}"
        self._keep_strip(episode)
        if self._judge is None:
            assert self._poses is not None
            verdict = self._poses.end()
            return "y" if verdict.success else f"n {verdict.failure}"
        self._seen.end = episode.end
        success, note = self._judge(self._seen)
        return f"{'y' if success else 'n'} {note}"

    def _robot_changed(self) -> bool:
        """The robot's node is silent, or another process than at the start of the episode."""
        since_s = time.monotonic()
        with suppress(NodeError):
            self._runner.wait(
                lambda: self._states.received_s(PoseState) > since_s, FRESH_S, "silent"
            )
            return self._states.read(PoseState)[0].source != self._source
        return True

    # -- what a judge sees --------------------------------------------------------------------
    def _time_s(self) -> float:
        if not self._began_s:
            self._began_s = time.monotonic()
        return time.monotonic() - self._began_s

    def _sample(self, *, last: bool = False) -> None:
        seen, now_s = self._seen, self._time_s()
        states, frames = seen.states, seen.frames
        if len(states) < MAX_STATES and (not states or now_s - states[-1].time_s >= STATE_S):
            with suppress(NodeError):
                pose = self._states.read(PoseState)[1]
                states.append(StateSample(now_s, pose, self._states.read(GripperState)[1]))
        due = last or not frames or now_s - frames[-1].time_s >= FRAME_S
        if due and len(frames) < MAX_FRAMES:
            jpegs = {name: slot.payload() for name, slot in self._pictures.items()}
            frames.append(Frame(now_s, {name: jpeg for name, jpeg in jpegs.items() if jpeg}))

    def _keep_strip(self, episode: EpisodeFsm) -> None:
        """Write the film strip of an episode beside its recording."""
        strip = film_strip(self._seen.chosen())
        if strip is None:
            return
        path = strip_path(self._folder, episode.due.setup, episode.due.worker)
        with writing(path, RecordingError):
            write_whole(path, strip)


def strip_path(folder: TrialFolder, setup: int, worker: str) -> Path:
    """Path of the film strip of an episode."""
    return folder.path / f"setup-{setup:04d}-{worker}.jpg"


def film_strip(frames: Sequence[Frame]) -> bytes | None:
    """A JPEG with the frames from left to right, cameras below each other; None: no picture."""
    rows = []
    for camera in sorted({name for frame in frames for name in frame.jpegs}):
        jpegs = [frame.jpegs[camera] for frame in frames if camera in frame.jpegs]
        rows.append(np.hstack([decoded_at_height(jpeg, STRIP_HEIGHT_PX) for jpeg in jpegs]))
    if not rows:
        return None
    width = max(row.shape[1] for row in rows)
    padded = [np.pad(row, ((0, 0), (0, width - row.shape[1]), (0, 0))) for row in rows]
    return encode_jpeg(Image(np.ascontiguousarray(np.vstack(padded))))
