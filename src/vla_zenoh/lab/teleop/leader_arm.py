"""Reads a leader arm: a class of the robot contract (`vla_zenoh.robot`) in a Python file."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from vla_zenoh.errors import NodeError, PeerError, in_words
from vla_zenoh.lab.teleop.leader import LeaderState
from vla_zenoh.policy.loader import make_robot
from vla_zenoh.robot import Reading, numbers

READ_S = 0.01
KEPT_S = 2.0
"""Of the leader's path; a chunk asks for the last period of the rate."""
LOST_S = 0.5
"""A leader that reads nothing new for this long is gone."""


class LeaderArm:
    """A leader that is read on a thread of its own.

    Args:
        path: Python file with the class.
        options: of its constructor.
        joints: number of the arm's joints, which is the leader's.

    Raises:
        WorkerError: no such file or class.
        NodeError: it cannot be connected to.
    """

    def __init__(self, path: Path, options: Mapping[str, str], joints: int) -> None:
        self.name = path.name
        self._robot, self._joints = make_robot(path, options), joints
        try:
            getattr(self._robot, "connect", lambda: None)()
        except Exception as error:
            raise NodeError(f"leader {self.name}: connect: {in_words(error)}") from error
        self._path: deque[LeaderState] = deque(maxlen=round(KEPT_S / READ_S))
        self._lock, self._end, self._why = threading.Lock(), threading.Event(), ""
        self._thread = threading.Thread(target=self._read_all, name="leader", daemon=True)
        self._thread.start()

    def _read_all(self) -> None:
        while not self._end.wait(READ_S):
            try:
                reading = self._robot.read()
                if reading is not None:
                    self._take(reading)
            except Exception as error:
                self._why = in_words(error)
                return

    def _take(self, reading: Reading) -> None:
        position_rad = numbers("position_rad", reading.position_rad, self._joints)
        if np.isfinite(position_rad).all():
            with self._lock:
                self._path.append(LeaderState(time.monotonic(), position_rad, reading.width_m))

    def path(self) -> list[LeaderState]:
        """Its last seconds, oldest first.

        Raises:
            PeerError: it is gone.
        """
        with self._lock:
            path = list(self._path)
        silent = not path or time.monotonic() - path[-1].time_s > LOST_S
        if self._why or silent:
            why = self._why or "it reads nothing new"
            raise PeerError("device_lost", f"leader {self.name}: {why}")
        return path

    def close(self) -> None:
        """End the thread, and disconnect."""
        self._end.set()
        self._thread.join()
        getattr(self._robot, "close", lambda: None)()
