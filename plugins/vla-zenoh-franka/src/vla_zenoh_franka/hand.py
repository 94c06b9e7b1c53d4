"""The Franka Hand: moves and grasps in threads of its own; the newest request wins."""

from __future__ import annotations

import threading
import time
from typing import Any, NamedTuple

from vla_zenoh.errors import in_words
from vla_zenoh.runtime.process import realtime_links

CLEARLY_M = 0.002
"""Less is not a closing motion; fingers further than this from the request hold an object; so do
those that are further than this from each other."""
SHUT_M, STROKE_M = 0.005, 0.08
WAIT_S = 0.02
JOIN_S = 0.3
RETRY_S = 0.5
NO_STOP_S = 2.0
"""A motion that has not ended this long after a stop is asked to stop again."""


class GripRequest(NamedTuple):
    width_m: float
    speed_m_s: float
    force_n: float


class HandState(NamedTuple):
    width_m: float
    moving: bool
    holding: bool


class Hand:
    """Runs the motions of a hand: calls of franky's `gripper` block until the fingers arrive.

    A new request interrupts the one in progress; requests in between are dropped.

    Attributes:
        fault: why the hand does not answer; empty: it does.
        failed: reason of the last failed motion.
    """

    def __init__(self, gripper: Any) -> None:
        self._gripper: Any = gripper
        self._newest: GripRequest | None = None
        self._running: GripRequest | None = None
        self._changed, self._end = threading.Condition(), threading.Event()
        self.fault = self.failed = ""
        self._read()
        self._threads = [
            threading.Thread(target=body, name=f"hand {name}", daemon=True)
            for name, body in (("motions", self._run), ("state", self._watch))
        ]
        with realtime_links():  # they share the GIL with the arm's loop
            for thread in self._threads:
                thread.start()

    def ask(self, width_m: float, speed_m_s: float, force_n: float) -> None:
        """Replace the newest request; returns at once."""
        with self._changed:
            self._newest = GripRequest(width_m, speed_m_s, force_n)
            self._changed.notify()

    def state(self) -> HandState:
        """The newest state, at once."""
        moving = self._running is not None or self._newest is not None
        # A grasp takes any width: the hand also calls it one when the fingers meet.
        holds = self._grasped and self._width_m > CLEARLY_M and not moving
        return HandState(self._width_m, moving, holds)

    def close(self) -> None:
        """End the threads; the fingers keep what they hold."""
        self._end.set()
        with self._changed:
            self._changed.notify()
        for thread in self._threads:
            thread.join(JOIN_S)
        self._gripper = None  # the hand serves one client

    # -- threads ------------------------------------------------------------------------------
    def _watch(self) -> None:
        while not self._end.is_set():
            try:
                self._read()
            except Exception as error:
                self.fault = in_words(error)
                self._end.wait(RETRY_S)
                continue
            self.fault = ""

    def _run(self) -> None:
        while not self._end.is_set():
            with self._changed:
                self._changed.wait_for(lambda: self._newest is not None or self._end.is_set())
                self._running, self._newest = self._newest, None
            if self._running is not None:
                self._carry_out(self._running)
            self._running = None

    def _carry_out(self, request: GripRequest) -> None:
        """Move until the fingers arrive, or a newer request ends it.

        A grasp closes until the fingers meet resistance, whatever its width. It is used to close
        fully, and after an object kept the fingers from their target.
        """
        closes = request.width_m < self._width_m - CLEARLY_M
        try:
            if not (closes and request.width_m < SHUT_M):
                self._wait(self._gripper.move_async(request.width_m, request.speed_m_s))
                self._read()
                closes = closes and self._width_m > request.width_m + CLEARLY_M
            if closes and not self._superseded():
                # Succeeds on whatever is between the fingers: its thickness is unknown.
                self._wait(self._gripper.grasp_async(*request, STROKE_M, STROKE_M))
                self._read()  # the state before it would say that nothing is held
        except Exception as error:  # an interrupted motion raises; the state has the width
            if not self._superseded():
                self.failed = in_words(error)

    def _wait(self, motion: Any) -> None:
        stop_s = -NO_STOP_S
        while not motion.wait(WAIT_S):
            if self._superseded() and time.monotonic() - stop_s > NO_STOP_S:
                stop_s = time.monotonic()
                self._gripper.stop_async()
        motion.get()

    def _read(self) -> None:
        state = self._gripper.state  # waits for the next one
        self._width_m, self._grasped = float(state.width), bool(state.is_grasped)

    def _superseded(self) -> bool:
        return self._newest is not None or self._end.is_set()
