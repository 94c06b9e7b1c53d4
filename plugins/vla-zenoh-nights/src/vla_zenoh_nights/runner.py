"""Runs an unattended trial: task by task, until all is judged or a rule stops."""

from __future__ import annotations

import queue
import threading
import time
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager
from dataclasses import asdict
from pathlib import Path
from typing import Any

from vla_zenoh_trial.runner import TrialRunner

from vla_zenoh.client.client import Client
from vla_zenoh.errors import NodeError, OutputError, RecordingError, SessionError
from vla_zenoh.lab.episode import Interrupted
from vla_zenoh_nights.judge import Judge, make_judge, post_json
from vla_zenoh_nights.operator import TrialStopped, UnattendedOperator
from vla_zenoh_nights.trial import UnattendedTrial, write_page

PATIENCE_S, ATTEMPTS, BACK_OFF_S = 5.0, 3, 1.0
MAX_WAITING = 50


class Webhook:
    """Posts messages on a thread of its own, in order; a full queue drops the newest.

    Args:
        url: where to; empty: nowhere.
        warn: called with what could not be sent.
    """

    def __init__(self, url: str, warn: Callable[[str], None]) -> None:
        self._url, self._warn = url, warn
        self._waiting: queue.Queue[dict[str, Any] | None] = queue.Queue(MAX_WAITING)
        self._thread = threading.Thread(target=self._send, name="webhook", daemon=True)
        if url:
            self._thread.start()

    def tell(self, what: str, fields: Mapping[str, Any]) -> None:
        """Post ``{"what": what, "time": Unix seconds, ...}``."""
        if not self._url:
            return
        try:
            self._waiting.put_nowait({"what": what, "time": round(time.time(), 3), **fields})
        except queue.Full:
            self._warn(f"webhook: too many messages wait, dropped {what!r}")

    def close(self, timeout_s: float = 2 * PATIENCE_S) -> None:
        """Send what waits, for `timeout_s` at most."""
        if self._url:
            try:
                self._waiting.put(None, timeout=timeout_s)
            except queue.Full:
                return
            self._thread.join(timeout_s)

    def _send(self) -> None:
        while (message := self._waiting.get()) is not None:
            for left in reversed(range(ATTEMPTS)):
                try:
                    post_json(self._url, message, PATIENCE_S)
                    break
                except (OSError, ValueError) as error:
                    if left:
                        time.sleep(BACK_OFF_S)
                    else:
                        self._warn(f"webhook: {message['what']!r} was not delivered: {error}")


RETRY_S, MAX_TROUBLE = 5.0, 20
"""Between two attempts after trouble, and how many without an episode in between."""


def run_unattended(
    trial: UnattendedTrial,
    open_client: Callable[[], AbstractContextManager[Client]],
    plan_folder: Path,
    stop: threading.Event,
    warn: Callable[[str], None],
) -> str:
    """Run what is due; why it stopped, empty: every episode is judged.

    Args:
        trial: its folder is locked by this process.
        open_client: a client of the running robot; opened again after trouble.
        plan_folder: where a Python judge is looked for.

    Raises:
        NodeError, SessionError: trouble that does not end.
        Interrupted: Ctrl-C; the arm is at rest.
        RecordingError, OutputError: the disk is full or broken.
    """
    judge = make_judge(trial.plan.judge, plan_folder)
    hook = Webhook(trial.plan.webhook, warn)
    trial.begin()
    hook.tell("begun", _summary(trial))
    try:
        why = _run(trial, open_client, judge, stop, warn, hook)
        trial.note("stopped" if why else "finished", why)
        hook.tell("stopped" if why else "finished", {"why": why, **_summary(trial)})
        return why
    except (NodeError, SessionError, RecordingError, OutputError) as error:
        hook.tell("failed", {"why": str(error), **_summary(trial)})
        raise
    finally:
        write_page(trial)
        hook.close()


def _run(
    trial: UnattendedTrial,
    open_client: Callable[[], AbstractContextManager[Client]],
    judge: Judge | None,
    stop: threading.Event,
    warn: Callable[[str], None],
    hook: Webhook,
) -> str:
    def due_to_stop() -> str:
        write_page(trial)
        return trial.due_to_stop()

    for task in trial.plan.tasks:
        folder, plan = trial.trial(task)
        folder.path.mkdir(exist_ok=True)
        if folder.plan() is None:
            folder.begin(plan)
        trouble, before = 0, -1
        while plan.next_due(folder.episodes()) is not None:
            if stop.is_set():
                raise Interrupted
            if why := trial.due_to_stop():
                return why
            try:
                with open_client() as client:
                    operator = UnattendedOperator(
                        client, trial.plan, task, plan, folder, judge, stop, due_to_stop, warn
                    )
                    try:
                        TrialRunner(client, plan, folder, operator, stop).run()
                    finally:
                        operator.close()
            except TrialStopped as stopped:
                return str(stopped)
            except (NodeError, SessionError) as error:
                judged = sum(each.verdict != "void" for each in folder.episodes())
                trouble, before = (1 if judged > before else trouble + 1), judged
                warn(f"trouble {trouble} of {MAX_TROUBLE}: {error}")
                trial.note("trouble", str(error)[:500])
                hook.tell("trouble", {"why": str(error)[:500], **_summary(trial)})
                if trouble >= MAX_TROUBLE:
                    raise
                if stop.wait(RETRY_S):
                    raise Interrupted from error
    return ""


def _summary(trial: UnattendedTrial) -> dict[str, Any]:
    return {
        "robot": trial.robot,
        "folder": str(trial.path),
        "tasks": {
            task.name: {
                "done": found.done,
                "of": found.of,
                "workers": {each.worker: asdict(each) for each in found.workers},
            }
            for task, found, _ in trial.scores()
        },
    }
