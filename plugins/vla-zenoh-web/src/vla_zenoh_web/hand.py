"""A person at the page as a worker: teleoperation with the buttons of a page."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any

import zenoh
from vla_zenoh_teleop.policy import OperatorInput, TeleopPolicy, speeds_of

from vla_zenoh.bus.session import open_session
from vla_zenoh.client.client import Client
from vla_zenoh.errors import NodeError
from vla_zenoh.keys import worker_node
from vla_zenoh.nodes.worker.node import WorkerNode
from vla_zenoh.policy import Frame
from vla_zenoh.profile import Profile
from vla_zenoh.security.roles import TELEOP
from vla_zenoh.types import Task

START_S = 5.0


class HandWorker:
    """The worker ``teleop``, while a person has taken the arm on the page.

    Attributes:
        parts: of the robot, of which one is moved at a time; of one arm one without a name.
    """

    def __init__(self, profile: Profile, client: Client, read: Callable[[], OperatorInput]) -> None:
        self._profile, self._client, self._read = profile, client, read
        self._lock = threading.Lock()
        self._other_worker = profile.task.worker
        self._frame: Frame = "base"
        self._level = self._part = 0
        self._thread: threading.Thread | None = None
        self._stop = threading.Event()
        self._session: zenoh.Session | None = None
        self.parts = profile.part_names
        self.speeds_m_s = [speed.translation_m_s for speed in speeds_of(profile)]

    @property
    def has_arm(self) -> bool:
        """Whether the arm follows this worker."""
        task = self._client.task
        return self._thread is not None and task is not None and task.worker == TELEOP

    @property
    def chosen(self) -> dict[str, Any]:
        """What every page shows, whichever chose it."""
        return {"frame": self._frame, "level": self._level, "part": self.parts[self._part]}

    def take(self, frame: Frame, level: int, part: str) -> Task:
        """Select this worker, to move `part`; it starts, or again with other axes.

        Raises:
            NodeError: a worker of this name runs elsewhere, or the robot has no such part.
            SecurityError: this computer has no certificate for it.
            SessionError: it was not selected.
        """
        if part not in self.parts:
            raise NodeError(f"the robot has no part {part!r}; it has {', '.join(self.parts)}")
        with self._lock:
            self._level, self._part = level, self.parts.index(part)
            if self._thread is None or frame != self._frame:
                self._end()
                self._begin(frame)
            task = self._client.task
            if task is not None and task.worker != TELEOP:
                self._other_worker = task.worker
            return self._client.set_worker(TELEOP)

    def give_back(self) -> Task:
        """Select the worker that had the arm before."""
        with self._lock:
            task = self._client.set_worker(self._other_worker)
            self._end()
            return task

    def close(self) -> None:
        with self._lock:
            self._end()

    def _begin(self, frame: Frame) -> None:
        self._frame, self._stop = frame, threading.Event()
        self._session = open_session(self._profile.session, identity=worker_node(TELEOP))

        def read() -> OperatorInput:
            return self._read()._replace(part=self._part)

        policy = TeleopPolicy(self._profile, TELEOP, read, lambda: self._level, frame=frame)
        try:
            node = WorkerNode(self._profile, self._session, policy, TELEOP)
        except NodeError:
            self._end()
            raise
        self._thread = threading.Thread(target=node.run, args=(self._stop,), name=TELEOP)
        self._thread.start()
        if not self._client.wait_for(lambda: worker_node(TELEOP) in self._client.alive, START_S):
            raise NodeError("the worker teleop did not start in time: try again")

    def _end(self) -> None:
        self._stop.set()
        if self._thread is not None:
            self._thread.join()
            self._thread = None
        if self._session is not None:
            self._session.close()
            self._session = None
