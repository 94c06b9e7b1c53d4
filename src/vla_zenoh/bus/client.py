"""A person's side of the bus: puts settings, reads what nodes say. What the CLI is made of."""

from __future__ import annotations

import math
import secrets
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import replace
from typing import Any, TypeVar

import zenoh

from vla_zenoh.bus.buffers import bytes_of, header_of
from vla_zenoh.bus.node_registry import MAX_STATUS_BYTES, NodeRegistry
from vla_zenoh.bus.session import QOS
from vla_zenoh.codec import records
from vla_zenoh.codec.settings import encode_deadman_activation
from vla_zenoh.errors import CodecError, SessionError
from vla_zenoh.keys import NO_DEADMAN_TOKEN, Kind, last_chunk
from vla_zenoh.profile import Profile
from vla_zenoh.security.identity import identities
from vla_zenoh.types import Event, Header, NodeStatus, Task

Value = TypeVar("Value")
POLL_S, HOLD_PATIENCE_S = 0.02, 1.0
MAX_EVENTS, MAX_REFUSALS = 4096, 256
MAX_EVENT_BYTES = 64 * 1024
MAX_WHAT, MAX_WHY = 128, 1000
"""Characters of an event that are kept; nodes of ours write no more."""
DROPPED_HINT = (
    "statuses or tokens left out, of more names than are kept or too large: somebody who is no "
    "node of ours writes them"
)


class Client:
    """Puts plain text on setting keys and keeps the newest status of every node.

    Args:
        profile: for its keys.
        session: open session.
    """

    def __init__(self, profile: Profile, session: zenoh.Session) -> None:
        self.profile, self.session, self.keys = profile, session, profile.keys
        self._lock = threading.Lock()
        self._nodes = NodeRegistry(one.node for one in identities(profile))
        self.events: deque[tuple[str, Header, Event]] = deque(maxlen=MAX_EVENTS)
        self.task: Task | None = None
        self._task_heard_s = -1e9
        self._refusals: deque[tuple[float, Event]] = deque(maxlen=MAX_REFUSALS)
        self._subscriptions: list[Any] = []
        self._token: Any = None

    def subscribe(self) -> Client:
        """Begin to listen to status, events, liveliness and the task."""
        liveliness = self.session.liveliness()
        self._subscriptions += [
            self._subscribe(self.keys.all_status, self._on_status),
            self._subscribe(self.keys.all_events, self._on_event),
            self._subscribe(self.keys.task, self._on_task),
            liveliness.declare_subscriber(
                self.keys.all_alive,
                zenoh.handlers.Callback(self._on_alive, indirect=False),
                history=True,
            ),
        ]
        return self

    def _subscribe(self, key: str, callback: Callable[[zenoh.Sample], None]) -> Any:
        return self.session.declare_subscriber(
            key, zenoh.handlers.Callback(callback, indirect=False)
        )

    @staticmethod
    def _decode(
        kind: type[Value], sample: zenoh.Sample, limit: int = records.SMALL_BYTES
    ) -> tuple[Header, Value] | None:
        try:
            return header_of(sample), records.decode(kind, bytes_of(sample.payload, limit))
        except CodecError:
            return None  # a stranger's bytes; the nodes count and tell them

    def _on_status(self, sample: zenoh.Sample) -> None:
        found = self._decode(NodeStatus, sample, MAX_STATUS_BYTES)
        if found is not None:
            self._nodes.status_received(
                last_chunk(str(sample.key_expr)), found[1], len(sample.payload)
            )

    def _on_event(self, sample: zenoh.Sample) -> None:
        found = self._decode(Event, sample, MAX_EVENT_BYTES)
        if found is not None:
            header, event = found
            event = replace(event, what=event.what[:MAX_WHAT], why=event.why[:MAX_WHY])
            with self._lock:
                self.events.append((last_chunk(str(sample.key_expr))[:MAX_WHAT], header, event))
                if event.kind == "refusal":
                    self._refusals.append((time.monotonic(), event))

    def _on_task(self, sample: zenoh.Sample) -> None:
        found = self._decode(Task, sample)
        if found is not None:
            with self._lock:
                self.task, self._task_heard_s = found[1], time.monotonic()

    def _on_alive(self, sample: zenoh.Sample) -> None:
        name = last_chunk(str(sample.key_expr))
        if sample.kind == zenoh.SampleKind.PUT:
            self._nodes.token_appeared(name)
            return
        self._nodes.token_gone(name)
        if name == "command":  # nobody keeps the task any more
            with self._lock:
                self.task = None

    # -- reading ------------------------------------------------------------------------------
    @property
    def alive(self) -> frozenset[str]:
        """Names of the nodes that are alive."""
        return self._nodes.alive

    @property
    def dropped(self) -> int:
        """How often strangers' names, or statuses, were not kept for their number or size."""
        return self._nodes.dropped

    def status(self, node: str) -> NodeStatus | None:
        """The newest status of a node, None before the first."""
        found = self._nodes.status(node)
        return found[0] if found else None

    def snapshot(self) -> dict[str, tuple[NodeStatus, float, bool]]:
        """Node -> (status, seconds since it came, alive)."""
        return self._nodes.snapshot()

    def pop_events(self) -> list[tuple[str, Header, Event]]:
        """Events since the last call, oldest first."""
        with self._lock:
            events = list(self.events)
            self.events.clear()
        return events

    def wait_for(self, condition: Callable[[], Value | None], timeout_s: float) -> Value | None:
        """Poll until `condition` gives something true, at most so long."""
        give_up = time.monotonic() + timeout_s
        while True:
            found = condition()
            if found or time.monotonic() > give_up:
                return found or None
            time.sleep(POLL_S)

    # -- writing ------------------------------------------------------------------------------
    def publish(self, key: str, text: str) -> None:
        """Put plain text, as any Zenoh client would."""
        self.session.put(key, text, encoding=zenoh.Encoding.TEXT_PLAIN, **QOS[Kind.ORDER])

    def set_prompt(self, prompt: str, timeout_s: float = 2.0) -> Task:
        """Put a prompt and wait until the command node has taken it.

        Raises:
            SessionError: it did not; says why where it said so.
        """
        wanted = prompt.strip()
        return self._set(
            self.keys.prompt, prompt, lambda task: task.prompt == wanted, "prompt", timeout_s
        )

    def set_rate(self, rate_hz: float, timeout_s: float = 2.0) -> Task:
        """Likewise for the rate."""
        return self._set(
            self.keys.rate,
            f"{rate_hz:g}",
            lambda task: math.isclose(task.rate_hz, rate_hz, rel_tol=1e-5),
            "rate",
            timeout_s,
        )

    def set_speed(self, percent: float, timeout_s: float = 2.0) -> Task:
        """Likewise for the share of the planned speed that is driven, 0 to 100 percent."""
        return self._set_speed(self.keys.speed, percent, "speed", timeout_s)

    def slow_down(self, percent: float, timeout_s: float = 2.0) -> Task:
        """Likewise, for whoever may stop the arm: refused where it would go faster."""
        return self._set_speed(self.keys.slower, percent, "slower", timeout_s)

    def _set_speed(self, key: str, percent: float, what: str, timeout_s: float) -> Task:
        def taken(task: Task) -> bool:
            return math.isclose(task.speed_percent, percent, rel_tol=1e-5, abs_tol=1e-9)

        return self._set(key, f"{percent:g}", taken, what, timeout_s)

    def set_worker(self, worker: str, timeout_s: float = 2.0) -> Task:
        """Likewise for the worker."""
        return self._set(
            self.keys.worker, worker, lambda task: task.worker == worker, "worker", timeout_s
        )

    def activate(self, timeout_s: float = 3.0) -> Task:
        """Activate and wait until the arm obeys.

        Raises:
            SessionError: it was refused, with every reason.
        """
        return self._activate("true", timeout_s)

    def activate_with_deadman(self, what: str, timeout_s: float = 3.0) -> Task:
        """Likewise, and only for as long as this process lives and is connected.

        Until `deactivate`. Whatever ends it, also kill -9 or a cable that is pulled, brakes the
        arm: at once where the router sees the connection close, else when it gives up the link
        (``session.lease_ms``).

        Args:
            what: who this is, for people.

        Raises:
            SessionError: it was refused, with every reason.
        """
        self.release_deadman()
        holder = f"{what}-{secrets.token_hex(4)}"
        self._token = self.session.liveliness().declare_token(self.keys.holding(holder))
        text, give_up_s = (
            encode_deadman_activation(holder).decode(),
            time.monotonic() + HOLD_PATIENCE_S,
        )
        while True:
            try:
                return self._activate(text, timeout_s)
            except SessionError as error:
                # The token may be on its way still: it does not go before what is put after it.
                if NO_DEADMAN_TOKEN not in str(error) or time.monotonic() > give_up_s:
                    self.release_deadman()
                    raise

    def _activate(self, text: str, timeout_s: float) -> Task:
        return self._set(
            self.keys.active, text, lambda task: task.active, "activate", timeout_s, undo="false"
        )

    def latch_reason(self) -> str:
        """Why nobody may activate before a person's reset, empty where there is no such reason."""
        status = self.status("command")
        if status is None or status.state not in ("stopped", "fault"):
            return ""
        return f"{status.state}: {status.detail.get('why', '')}"

    def deactivate(self, timeout_s: float = 3.0) -> bool:
        """Deactivate; True when the arm stands within `timeout_s`."""
        began_s = time.monotonic()
        self.publish(self.keys.active, "false")
        stands = bool(self.wait_for(lambda: self._stands(began_s), timeout_s))
        self.release_deadman()
        return stands

    def release_deadman(self) -> None:
        """Hold the arm active no more: if it still is, it brakes."""
        token, self._token = self._token, None
        if token is not None:
            token.undeclare()

    def _stands(self, since_s: float) -> bool:
        """By a status that is younger than the order: an older one says nothing about it."""
        status, heard_s = self._nodes.status("command") or (None, 0.0)
        return (
            status is not None
            and heard_s > since_s
            and status.state not in ("active", "holding")
            and status.detail.get("at_rest") is True
        )

    def _set(
        self,
        key: str,
        text: str,
        taken: Callable[[Task], bool],
        what: str,
        timeout_s: float,
        *,
        undo: str | None = None,
    ) -> Task:
        """Put a setting, and wait for a task that says so or a refusal, both younger than it.

        Where neither comes in time, `undo` is put behind it: what somebody was told that it failed
        must not happen later.
        """
        began_s = time.monotonic()
        self.publish(key, text)
        self.wait_for(
            lambda: self._refused(what, began_s) or self._taken(taken, began_s), timeout_s
        )
        if self._refused(what, began_s):
            time.sleep(0.1)  # the other reasons come right behind the first
            reasons = dict.fromkeys(self._refused(what, began_s))
            raise SessionError(f"{what} refused:\n  - " + "\n  - ".join(reasons))
        task = self._taken(taken, began_s)
        if task is not None:
            return task
        if undo is not None:
            self.publish(key, undo)
        if "command" not in self.alive:
            raise SessionError(f"{what}: no command node of robot {self.keys.robot!r} is alive")
        status = self.status("command")
        why = f"; it says: {status.detail.get('why', '')}" if status else ""
        raise SessionError(f"{what}: the command node did not take it in {timeout_s:g} s{why}")

    def _taken(self, taken: Callable[[Task], bool], since_s: float) -> Task | None:
        with self._lock:
            task, heard_s = self.task, self._task_heard_s
        return task if task is not None and heard_s > since_s and taken(task) else None

    def _refused(self, what: str, since_s: float) -> list[str]:
        with self._lock:
            return [
                event.why
                for heard_s, event in self._refusals
                if heard_s > since_s and event.what == f"{what}_refused"
            ]
