"""An episode: a prompt that the arm follows until something ends it."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

from vla_zenoh.client.client import Client
from vla_zenoh.errors import NodeError, SessionError
from vla_zenoh.keys import CRASHED, STARTING, worker_node
from vla_zenoh.lab.newest_records import NewestRecords
from vla_zenoh.types import Task

COMMAND, SIM = "command", "sim"
READY_PATIENCE_S = 60.0
LOAD_PATIENCE_S = 600.0
"""While the worker reports that it loads; it may be building its environment."""
SETTLE_PATIENCE_S = 15.0
"""For cameras and worker to have data; then activation names what is missing."""
UNSETTLED = {STARTING, "waiting", "degraded"}
ACTIVATE_PATIENCE_S, ACTIVATE_PERIOD_S = 15.0, 0.2
RESET_PATIENCE_S, RESET_PERIOD_S = 8.0, 1.0
POLL_S, WATCH_S = 0.03, 0.1


class Interrupted(Exception):
    """Ctrl-C: brake, then write what there is."""


@dataclass(frozen=True, slots=True)
class EpisodeView:
    """State of an episode, as the command node reports it.

    Args:
        ours: it still is the episode that was started, with its worker and prompt.
        done: the policy reports its end, and the arm is at rest.
        holds: times the command node braked for want of a chunk.
        recording: what is wrong with the recording, empty: nothing.
    """

    active: bool = True
    ours: bool = True
    state: str = "active"
    why: str = ""
    done: bool = False
    chunks: int = 0
    steps: int = 0
    holds: int = 0
    deactivated: bool = False
    recording: str = ""


class EpisodeLimit:
    """Ends an episode by its time limit, or once the policy has been done for a while.

    Args:
        done_s: how long `EpisodeView.done` has to hold.
    """

    def __init__(self, limit_s: float, done_s: float) -> None:
        self._limit_s, self._done_s = limit_s, done_s
        self._done_since_s: float | None = None

    def update(self, time_s: float, *, done: bool) -> Literal["policy", "time"] | None:
        """What ends the episode now, `time_s` after its start; None: nothing."""
        if not done:
            self._done_since_s = None
        elif self._done_since_s is None:
            self._done_since_s = time_s
        if self._done_since_s is not None and time_s - self._done_since_s >= self._done_s:
            return "policy"
        return "time" if time_s >= self._limit_s else None


class EpisodeRunner:
    """Starts episodes on a running robot and follows them.

    Args:
        watch: called while waiting; raises `NodeError` when the nodes cannot be kept alive.
    """

    def __init__(
        self, client: Client, stop: threading.Event, watch: Callable[[], None] = lambda: None
    ) -> None:
        self.client, self._stop, self._watch = client, stop, watch
        self._task: Task | None = None
        self._holds, self._deactivated = 0, False

    def wait_until_ready(self, worker: str, streams: NewestRecords) -> None:
        """Wait until the worker has loaded its model and all nodes have data.

        Args:
            streams: of each of which there has to be a record.

        Raises:
            NodeError: the nodes do not come up in time; with the state of each.
        """
        began_s = time.monotonic()
        while True:
            status = self.client.status(worker_node(worker))
            loading = status is None or status.state == STARTING
            crashed = status is not None and status.state == CRASHED
            missing = streams.missing()
            waited_s = time.monotonic() - began_s
            settled = waited_s > SETTLE_PATIENCE_S or self._settled()
            up = settled and self.client.status(COMMAND) is not None
            if up and not (missing or loading or crashed):
                return
            if waited_s > (READY_PATIENCE_S if missing or not loading else LOAD_PATIENCE_S):
                lacking = f"; not received: {', '.join(missing)}" if missing else ""
                raise NodeError(
                    f"the nodes did not come up in {waited_s:.0f} s{lacking}; {self._states()}"
                )
            self.pause(0.1)

    def reset_simulator(self, seed: int | None = None) -> None:
        """Reset the simulator; it refuses while it still follows the end of a command stream.

        Args:
            seed: of the layout; None: the objects stay.

        Raises:
            NodeError: it does not reset.
        """
        client, before = self.client, self._resets()
        client.wait_for(lambda: not self._sim_follows(), RESET_PERIOD_S)
        give_up_s = time.monotonic() + RESET_PATIENCE_S
        while self._resets() == before:
            client.publish(client.keys.sim_reset, "" if seed is None else str(seed))
            client.wait_for(lambda: self._resets() > before, RESET_PERIOD_S)
            if time.monotonic() > give_up_s:
                raise NodeError(
                    f"the simulator did not reset within {RESET_PATIENCE_S:g} s; {self._states()}"
                )
            self.pause(0.0)

    def start(self, prompt: str, rate_hz: float | None = None) -> Task:
        """Publish the prompt and activate, again and again while something is still missing.

        Raises:
            SessionError: activation is rejected to the end, or latched; with every reason.
        """
        if rate_hz is not None:
            self.client.set_rate(rate_hz)
        give_up_s = time.monotonic() + ACTIVATE_PATIENCE_S
        while True:
            try:
                self.client.set_prompt(prompt)
                return self.activate()
            except SessionError:
                if time.monotonic() > give_up_s or self.client.latch_reason():
                    raise
                self.pause(ACTIVATE_PERIOD_S)

    def activate(self, holder: str = "") -> Task:
        """Activate once; from here on `view` is about this episode.

        Args:
            holder: name of this client, whose end brakes the arm; empty: the arm stays active.

        Raises:
            SessionError: it was rejected, with every reason.
        """
        client = self.client
        client.pop_events()
        self._task, self._holds, self._deactivated = None, 0, False
        self._task = client.activate_with_deadman(holder) if holder else client.activate()
        return self._task

    def prompt(self, text: str) -> Task:
        """Publish another prompt while the arm is active; from here on `view` is about it.

        Raises:
            SessionError: it was rejected.
        """
        self._task = self.client.set_prompt(text)
        return self._task

    def view(self) -> EpisodeView:
        """State of the episode that was activated or prompted last."""
        for node, _, event in self.client.pop_events():
            if node == COMMAND and event.kind == "transition":
                if event.what == "active->holding":
                    self._holds += event.count
                elif event.what.endswith("->inactive"):
                    self._deactivated = event.level == "info"
        task, status, started = self.client.task, self.client.status(COMMAND), self._task
        if task is None or status is None or started is None:
            return EpisodeView(False, state="", why="no status of the command node received")
        detail, ours = status.detail, task.episode == started.episode
        current = detail.get("episode") == started.episode
        why = str(detail.get("why", "")) if task.active else self.client.why_inactive()
        inactive = not task.active and status.state in ("active", "holding")
        return EpisodeView(
            active=task.active,
            ours=ours,
            state="inactive" if inactive else status.state,
            why=why if ours else _changed(started, task),
            done=bool(current and detail.get("policy_done") and detail.get("at_rest")),
            chunks=int(detail.get("accepted_chunks", 0)) if current else 0,
            steps=int(detail.get("accepted_steps", 0)) if current else 0,
            holds=self._holds,
            deactivated=self._deactivated,
        )

    def wait(self, condition: Callable[[], bool], timeout_s: float, otherwise: str) -> None:
        """Wait for `condition`.

        Raises:
            NodeError: it did not hold within `timeout_s`; with `otherwise` and every node's state.
        """
        give_up_s = time.monotonic() + timeout_s
        while not condition():
            if time.monotonic() > give_up_s:
                raise NodeError(f"{otherwise}; {self._states()}")
            self.pause(POLL_S)

    def pause(self, seconds: float) -> None:
        """Let `seconds` pass. Raises NodeError: the nodes cannot be kept alive."""
        end_s = time.monotonic() + seconds
        while True:
            self._watch()
            left_s = max(end_s - time.monotonic(), 0.0)
            if self._stop.wait(min(left_s, WATCH_S)):
                raise Interrupted
            if left_s <= WATCH_S:
                return

    def _settled(self) -> bool:
        states = {found[0].state for found in self.client.snapshot().values()}
        return states.isdisjoint(UNSETTLED)

    def _resets(self) -> int:
        status = self.client.status(SIM)
        return int(status.counters.get("sim.resets", 0)) if status else 0

    def _sim_follows(self) -> bool:
        status = self.client.status(SIM)
        return bool(status and status.detail.get("following"))

    def _states(self) -> str:
        states: list[str] = []
        for name, (status, _, _) in self.client.snapshot().items():
            why = status.detail.get("complaint") or status.detail.get("why") or ""
            states.append(f"{name} is {status.state}" + (f" ({why})" if why else ""))
        return "; ".join(states) or "no node sends a status"


def _changed(started: Task, now: Task) -> str:
    if (now.worker, now.prompt) != (started.worker, started.prompt):
        return f"the worker is {now.worker!r} now, the prompt {now.prompt!r}"
    return "another episode began: another client activated, or the command node was restarted"
