"""Takes of the guide as recordings in one folder, and the data set at their end."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from vla_zenoh.client.client import Client
from vla_zenoh.errors import NodeError, VlaZenohError
from vla_zenoh.lab.cli.output_path import RUNS
from vla_zenoh.profile import Profile
from vla_zenoh_web.episode_guide import EpisodeGuide
from vla_zenoh_web.recordings import Recordings
from vla_zenoh_web.requests import GuideRequest

BEFORE_S = 1.5
"""A recording runs this long before the arm does: it has to have the spec of the model."""
DATASET = "dataset"


class Episodes:
    """The guide at a robot. Its methods may be called from several threads."""

    def __init__(
        self,
        profile: Profile,
        client: Client,
        recordings: Recordings,
        brake: Callable[[], object],
        runs: Path = RUNS,
    ) -> None:
        self._profile, self._client, self._recordings = profile, client, recordings
        self._brake, self._runs, self._folder = brake, runs, runs
        self._guide, self._lock = EpisodeGuide(), threading.Lock()

    @property
    def records(self) -> bool:
        """Whether the recording that runs is a take."""
        return self._guide.step in ("take", "judge")

    def observe(self, *, by_hand: bool) -> dict[str, Any]:
        """Follow what the arm does; returns the guide as the page shows it."""
        task = self._client.task
        obeyed = task.worker if task is not None and task.active else ""
        self._guide.observe(obeyed, by_hand=by_hand)
        return self._guide.described()

    def do(self, asked: GuideRequest) -> str:
        """Go one step on.

        Raises:
            NodeError: it has no place in this step, or no prompt.
            VlaZenohError: the robot, or the recording, rejected it.
        """
        with self._lock:
            return self._do(asked)

    def _do(self, asked: GuideRequest) -> str:
        guide, name = self._guide, asked.step
        match name:
            case "success" | "failure" | "void":
                guide.require("judge")
                kept = self._recordings.end(guide.worker, name, "")
                guide.judge(name)
                self._export_when_due()
                return kept
            case "begin":
                self._begin(asked)
            case "scene":
                guide.require("scene")
                if self._profile.robot.driver != "sim":
                    raise NodeError("only a simulated scene puts itself back")
                self._client.publish(self._client.keys.sim_reset, "")
            case "take":
                guide.require("take")
                path = self._folder / f"{len(guide.verdicts) + 1:02d}.mcap"
                self._recordings.begin(path)
                time.sleep(BEFORE_S)
                guide.take()
            case "again":
                guide.require("again")
                guide.take()
            case "end":
                guide.end()
                self._brake()
            case "finish":
                guide.finish()
                self._export_when_due()
            case "cancel":
                guide.require("cancel")
                if self.records:
                    self._recordings.end(guide.worker, "void", "")
                guide.cancel()
        return guide.described()["text"] or "the guide has ended; its takes are kept"

    def _begin(self, asked: GuideRequest) -> None:
        self._guide.require("begin")
        task = self._client.task
        if not asked.prompt and (task is None or not task.prompt):
            raise NodeError("write the prompt of these episodes")
        if asked.prompt:
            self._client.set_prompt(asked.prompt)
        self._folder = self._runs / time.strftime("episodes-%Y%m%d-%H%M%S")
        try:
            self._folder.mkdir(parents=True)
        except OSError as error:
            raise NodeError(f"{self._folder}: {error.strerror}") from error
        self._guide.begin(asked.count)

    def _export_when_due(self) -> None:
        """Make the data set on a thread: it takes longer than a page should wait."""
        if self._guide.step == "export":
            threading.Thread(target=self._export, name="export", daemon=True).start()

    def _export(self) -> None:
        try:
            self._guide.exported(export_dataset(self._folder))
        except VlaZenohError as error:
            self._guide.exported(f"The takes are in {self._folder}, without a data set: {error}")


def export_dataset(folder: Path) -> str:
    """``vla-zenoh dataset export`` of the takes in `folder`; returns what it says.

    Raises:
        NodeError: it failed, or its package is not installed; in its own words.
    """
    words = ["dataset", "export", str(folder), "-o", str(folder / DATASET)]
    done = subprocess.run(
        [sys.executable, "-m", "vla_zenoh", *words],
        capture_output=True,
        text=True,
        env={**os.environ, "NO_COLOR": "1", "COLUMNS": "400"},
        check=False,
    )
    if done.returncode:
        raise NodeError(done.stderr.strip() or f"dataset export ended with {done.returncode}")
    return done.stdout.strip()
