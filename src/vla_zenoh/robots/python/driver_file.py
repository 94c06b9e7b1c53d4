"""The class in a robot's Python file, as the node calls it; what it raises is told by its name."""

from __future__ import annotations

import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

from vla_zenoh.errors import NodeError
from vla_zenoh.interop.python_reading import MAX_WORDS
from vla_zenoh.policy.loader import make_robot
from vla_zenoh.profile.robot import ArmProfile
from vla_zenoh.robot import Command, Reading
from vla_zenoh.sanitize import one_line

REPORT_S = 0.2


class ArmFile:
    """See the module.

    Args:
        profile: the section arm.

    Attributes:
        name: of the file.
        grips: it has a gripper.

    Raises:
        WorkerError: the file is not there, or has no arm in it.
    """

    def __init__(self, profile: ArmProfile) -> None:
        path = Path(profile.file).expanduser()
        self.name = path.name
        self._robot = make_robot(path, profile.options)
        self.grips = self._method("grip") is not None

    def _method(self, name: str) -> Callable[..., Any] | None:
        method = getattr(self._robot, name, None)
        return method if callable(method) else None

    def _call(self, name: str, *given: Any) -> Any:
        method = self._method(name)
        if method is None:
            return None
        try:
            return method(*given)
        except Exception as error:
            words = one_line(f"{type(error).__name__}: {error}", MAX_WORDS)
            raise NodeError(f"{self.name}: {name}: {words}") from error

    # All of them raise NodeError.
    def connect(self, waiting: Callable[[], None]) -> None:
        """Connect, which may take long; `waiting` is called now and then, by another thread."""
        if self._method("connect") is None:
            return
        done = threading.Event()

        def tell() -> None:
            while not done.wait(REPORT_S):
                waiting()

        teller = threading.Thread(target=tell, name="connecting", daemon=True)
        teller.start()
        try:
            self._call("connect")
        finally:
            done.set()
            teller.join()

    def read(self) -> Reading | None:
        """The newest state."""
        reading = self._call("read")
        if reading is not None and not isinstance(reading, Reading):
            raise NodeError(f"{self.name}: read gave {type(reading).__name__}, wanted a Reading")
        return reading

    def move(self, command: Command) -> None:
        """Be there now."""
        self._call("move", command)

    def grip(self, width_m: float, speed_m_s: float, force_n: float) -> None:
        """Ask for an opening."""
        self._call("grip", width_m, speed_m_s, force_n)

    def close(self) -> None:
        """The end."""
        self._call("close")
