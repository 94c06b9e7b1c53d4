"""Client of a robot: changes its settings and follows its nodes. The CLI is built on it."""

from __future__ import annotations

import math
import secrets
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from enum import StrEnum
from typing import TYPE_CHECKING, Any, NamedTuple, Self, TypeVar

import zenoh

from vla_zenoh.bus.bounded import Bounded
from vla_zenoh.bus.buffers import ReceivedSample, SampleBuffer, bytes_of, header_of
from vla_zenoh.bus.reception import Reception
from vla_zenoh.bus.session import open_session, put_text
from vla_zenoh.codec import records, settings
from vla_zenoh.errors import CodecError, ProfileError, SessionError, StartingError
from vla_zenoh.keys import NO_DEADMAN_TOKEN, STARTING, Keys, key_chunk, last_chunk
from vla_zenoh.security.roles import expected_nodes, identities
from vla_zenoh.types import Event, Header, NodeStatus, Task

if TYPE_CHECKING:
    from vla_zenoh.profile import Profile, SessionProfile

Value = TypeVar("Value")
POLL_S, HOLD_PATIENCE_S = 0.02, 1.0
ANSWER_S = 3.0
"""The command node answers a setting within this."""
START_PATIENCE_S, START_PERIOD_S = 20.0, 0.5
"""How long people and scripts wait for a system that is starting, and how often they try."""
ABSENT_PATIENCE_S = 1.5
"""A command node that is alive, or is being started, may take this long to appear."""
SILENT_S = 5.0
"""`up` publishes twice a second which of its nodes are starting."""
WHY_PATIENCE_S = 1.0
"""The command node publishes its status twice a second, and at every transition."""
RESET_AGAIN_S = 0.3
STANDS_S, STATE_AGE_S = 0.1, 0.5
"""An arm stands whose joints stand (`STANDING`) for so long, by states that are not older."""
MAX_EVENTS, MAX_REFUSALS = 4096, 256
MAX_EVENT_BYTES = 64 * 1024
MAX_WHAT, MAX_WHY = 128, 1000
"""Characters of an event that are kept; our nodes publish no more."""
MAX_NODES = 256
"""Names of nodes, those of the profile among them."""
MAX_STATUS_BYTES = 64 * 1024
"""Of one status; ours have a few thousand bytes."""
DROPPED_HINT = (
    "statuses or liveliness tokens dropped, because they are too many or too large: they come from "
    "a process that is not one of our nodes"
)


def waiting(most_s: float, why: str) -> str:
    """The sentence about what a command waits for."""
    return f"waiting, at most {most_s:g} s: {why}"


def open_patiently(
    profile: SessionProfile, wait_s: float, tell: Callable[[str], None]
) -> tuple[zenoh.Session, bool]:
    """A session, and whether its router had to be waited for, at most `wait_s`.

    Raises:
        SecurityError: the certificate is missing.
        SessionError: no router answers.
    """
    try:
        return open_session(profile), False
    except SessionError as error:
        if wait_s <= 0:
            raise
        tell(waiting(wait_s, str(error)))
        return open_session(profile, wait_s=wait_s), True


class NodeRegistry:
    """Live nodes and their last status, of any name; safe to use from several threads.

    Any client that may publish a status may do so under any name. So there is always a place for
    the `expected` nodes of the profile, and a bound for all others; `up` runs for weeks.
    """

    def __init__(
        self, expected: Iterable[str] = (), clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._expected = frozenset(expected)
        self._clock = clock
        self._lock = threading.Lock()
        self._alive: Bounded[str, None] = Bounded(MAX_NODES, self._is_expected)
        self._statuses: Bounded[str, tuple[NodeStatus, float]] = Bounded(MAX_NODES, self._rank)
        self._unreadable: Bounded[str, str] = Bounded(MAX_NODES, self._is_expected)
        self._invalid = 0

    @property
    def unreadable(self) -> dict[str, str]:
        """Node -> why its newest status cannot be read."""
        with self._lock:
            return dict(self._unreadable)

    @property
    def alive(self) -> frozenset[str]:
        """Names of live nodes."""
        with self._lock:
            return frozenset(self._alive)

    @property
    def dropped(self) -> int:
        """Statuses and tokens that were not kept, or made room for others."""
        with self._lock:
            kept = (self._alive, self._statuses, self._unreadable)
            return self._invalid + sum(names.dropped for names in kept)

    def token_appeared(self, name: str) -> None:
        """A liveliness token appeared."""
        with self._lock:
            if self._fit(name):
                self._alive[name] = None
            else:
                self._invalid += 1

    def token_gone(self, name: str) -> None:
        """A liveliness token is gone."""
        with self._lock:
            self._alive.pop(name, None)

    def status_received(self, name: str, status: NodeStatus, size: int) -> None:
        """Keep the status of the node that its key names; `size`: in bytes."""
        with self._lock:
            if self._fit(name) and size <= MAX_STATUS_BYTES:
                self._statuses[name] = (status, self._clock())
                self._unreadable.pop(name, None)
            else:
                self._invalid += 1

    def status_unreadable(self, name: str, why: str) -> None:
        """The status of the node that its key names cannot be read."""
        with self._lock:
            if self._fit(name):
                self._unreadable[name] = why
            else:
                self._invalid += 1

    def status(self, name: str) -> NodeStatus | None:
        """The last status of a node, None before the first."""
        with self._lock:
            found = self._statuses.get(name)
        return found[0] if found else None

    def status_since(self, name: str, since_s: float) -> NodeStatus | None:
        """The last status of a live node, None unless it came after `since_s` of the clock.

        A request that was lost with the router would else be confirmed by an old status.
        """
        with self._lock:
            status, heard_s = self._statuses.get(name, (None, since_s))
            return status if heard_s > since_s and name in self._alive else None

    def snapshot(self) -> dict[str, tuple[NodeStatus, float, bool]]:
        """Node -> (status, age in s, alive), by name."""
        now_s = self._clock()
        with self._lock:
            return {
                name: (status, now_s - received_s, name in self._alive)
                for name, (status, received_s) in sorted(self._statuses.items())
            }

    @staticmethod
    def _fit(name: str) -> bool:
        try:
            return bool(key_chunk(name, "node"))
        except ProfileError:
            return False

    def _is_expected(self, name: str) -> bool:
        return name in self._expected

    def _rank(self, name: str) -> int:
        """Whose status stays: a node of the profile, before one that is alive, before the rest."""
        return 2 * self._is_expected(name) + (name in self._alive)


class StopOutcome(StrEnum):
    """How far a stop is known to have come."""

    CONFIRMED = "confirmed"  # heard, and the robot's own states show that it stands
    HEARD = "heard"  # a node has latched it; the arm still moves, or no states come
    NOT_CONFIRMED = "not_confirmed"  # no answer: it may have arrived all the same


class JointSpeed(NamedTuple):
    """Of the fastest joint that turns, and of the fastest that slides."""

    rad_s: float
    m_s: float


class StopProgress(NamedTuple):
    """What is known of a stop: nodes that latched it, and how fast the joints are, or None."""

    outcome: StopOutcome
    heard_by: tuple[str, ...]
    speed: JointSpeed | None

    def sentence(self, robot: str, why: str = "") -> str:
        """The outcome for a person, in the words of every way of stopping; `why` no answer came."""
        by = ", ".join(self.heard_by)
        if self.outcome is StopOutcome.CONFIRMED:
            return f"CONFIRMED: {robot} is stopped and stands, by {by}"
        if self.outcome is StopOutcome.HEARD:
            moves = "no joint states come"
            if self.speed is not None:
                moves = f"fastest joint {self.speed.rad_s:.3f} rad/s"
                moves += f" or {self.speed.m_s:.3f} m/s" if self.speed.m_s else ""
            return f"HEARD: by {by} of {robot}; {moves}"
        return (
            f"NOT CONFIRMED: no answer of {robot}{why and f': {why}'}. The stop may still have "
            "arrived. USE THE ROBOT'S OWN EMERGENCY STOP"
        )


class Standstill:
    """Whether an arm stands, by its measured joint states."""

    def __init__(self) -> None:
        self._newest: ReceivedSample | None = None
        self._moved_s = 0.0

    def take(self, sample: zenoh.Sample) -> None:
        """Take a joint state; runs on Zenoh's thread."""
        self._newest = ReceivedSample(sample, time.monotonic_ns())
        speed = self.speed(0.0)
        if speed is not None:
            from vla_zenoh.types import STANDING

            if speed.rad_s > STANDING.turns or speed.m_s > STANDING.slides:
                self._moved_s = time.monotonic()

    def speed(self, since_s: float) -> JointSpeed | None:
        """None: no valid state came since then, or for `STATE_AGE_S`."""
        newest, now_s = self._newest, time.monotonic()
        if newest is None or newest.mono_ns < max(since_s, now_s - STATE_AGE_S) * 1e9:
            return None
        from vla_zenoh.types import JointState  # brings numpy, when the stop is out

        try:
            state = records.decode(JointState, bytes_of(newest.sample.payload, records.SMALL_BYTES))
        except CodecError:
            return None
        speeds, slides = abs(state.velocity_rad_s), state.slides
        return JointSpeed(*(float(speeds[each].max(initial=0.0)) for each in (~slides, slides)))

    def stands(self, since_s: float) -> bool:
        """No joint has moved for `STANDS_S`, and states still come."""
        quiet_s = time.monotonic() - max(self._moved_s, since_s)
        return quiet_s >= STANDS_S and self.speed(since_s) is not None


class StopClient(NodeRegistry):
    """Client that stops a robot and follows what becomes of it.

    Args:
        part_names: of the robot's arms; of a robot that is one arm one empty name.
        expected: nodes of the profile, whose statuses are always kept.
    """

    def __init__(
        self,
        session: zenoh.Session,
        keys: Keys,
        part_names: Sequence[str],
        expected: Iterable[str] = (),
    ) -> None:
        super().__init__(expected)
        self.session, self.keys = session, keys
        self._part_names = part_names
        self._subscriptions: list[Any] = []
        self._stop_s = 0.0
        self._standstill: list[Standstill] = []
        self._unread: dict[type[Any], str] = {}
        """Kind of record -> why the newest one of it cannot be read."""
        self.other_version = ""
        """Which side is to be updated, where nodes write another version of the wire."""

    def subscribe(self) -> Self:
        """Subscribe to statuses and liveliness; returns the client."""
        on_alive = zenoh.handlers.Callback(self._on_alive, indirect=False)
        self._subscriptions += [
            self._subscribe(self.keys.all_status, self._on_status),
            self.session.liveliness().declare_subscriber(
                self.keys.all_alive, on_alive, history=True
            ),
        ]
        return self

    def _subscribe(self, key: str, callback: Callable[[zenoh.Sample], None]) -> Any:
        return self.session.declare_subscriber(
            key, zenoh.handlers.Callback(callback, indirect=False)
        )

    def _decode(
        self, kind: type[Value], sample: zenoh.Sample, limit: int = records.SMALL_BYTES
    ) -> tuple[Header, Value] | None:
        try:
            found = header_of(sample), records.decode(kind, bytes_of(sample.payload, limit))
        except CodecError as error:  # the nodes count and report it
            self._unread[kind] = f"{self.keys.short(str(sample.key_expr))}: {error}"
            if error.reason == "schema":
                self.other_version = self._unread[kind]
            return None
        self._unread.pop(kind, None)
        return found

    def _on_status(self, sample: zenoh.Sample) -> None:
        found = self._decode(NodeStatus, sample, MAX_STATUS_BYTES)
        name = last_chunk(str(sample.key_expr))
        if found is None:
            self.status_unreadable(name, self._unread[NodeStatus])
        else:
            self.status_received(name, found[1], len(sample.payload))

    def _on_alive(self, sample: zenoh.Sample) -> None:
        name = last_chunk(str(sample.key_expr))
        if sample.kind == zenoh.SampleKind.PUT:
            self.token_appeared(name)
        else:
            self.token_gone(name)

    def stop(self) -> None:
        """Trigger the emergency stop; it latches until `reset`. `stop_progress` follows it."""
        self._stop_s = time.monotonic()
        self.publish(self.keys.stop, "stop")
        self.follow_stop(self._stop_s)

    def follow_stop(self, since_s: float) -> None:
        """Watch what becomes of a stop put at `since_s` on the monotonic clock, by anybody."""
        self._stop_s = since_s
        if not self._standstill:
            for name in self._part_names:
                watch = Standstill()
                self._standstill.append(watch)
                key = self.keys.of_part(name).state_joint
                self._subscriptions.append(self._subscribe(key, watch.take))

    def stop_progress(self) -> StopProgress:
        """What is known of the last `stop`; poll it."""
        heard_by = tuple(
            name
            for name in self.alive
            if (status := self.status_since(name, self._stop_s)) is not None
            and (name == "command" and status.state == "stopped")
            | bool(status.detail.get("stop_latched"))
        )
        speeds = [watch.speed(self._stop_s) for watch in self._standstill]
        known = [speed for speed in speeds if speed is not None]
        fastest = JointSpeed(*map(max, zip(*known, strict=True))) if known else None
        stands = bool(speeds) and all(watch.stands(self._stop_s) for watch in self._standstill)
        outcome = StopOutcome.NOT_CONFIRMED
        if heard_by:
            outcome = StopOutcome.CONFIRMED if stands else StopOutcome.HEARD
        return StopProgress(outcome, heard_by, fastest)

    def stopped(self) -> bool:
        """Whether a node has said since the last `stop` that it is stopped, and the arm stands."""
        return self.stop_progress().outcome is StopOutcome.CONFIRMED

    def stop_latched(self) -> list[str]:
        """Live robot nodes that hold a stop."""
        return [
            name
            for name, (status, _, alive) in self.snapshot().items()
            if alive and status.detail.get("stop_latched")
        ]

    def publish(self, key: str, text: str) -> None:
        """Put plain text on a key, as any Zenoh client could."""
        put_text(self.session, key, text)


class Client(StopClient):
    """Client of one robot: settings, activation, and the last status of every node.

    ::

        with open_session(profile.session) as session:
            robot = Client(profile, session).subscribe()
            robot.set_prompt("pick up the red brick")
            robot.activate_with_deadman("my_script")

    `expected` has the nodes that the profile assigns to hosts, each with its host; `reception`
    tells what this client does not receive, of its subscriptions by `watch`. `patience_s` is how
    long a setting or an activation waits while nodes are starting, where it is given no time of its
    own; `tell` gets a sentence about that. `cold` means that the router has just begun to answer,
    so an absent command node is taken for one that starts.
    """

    def __init__(
        self,
        profile: Profile,
        session: zenoh.Session,
        *,
        patience_s: float = ANSWER_S,
        tell: Callable[[str], None] = lambda _: None,
        cold: bool = False,
    ) -> None:
        nodes = [one.node for one in identities(profile)]
        super().__init__(session, profile.keys, profile.part_names, nodes)
        self.profile = profile
        self.patience_s, self.tell = patience_s, tell
        self._cold_until_s = time.monotonic() + patience_s if cold else 0.0
        self.expected = expected_nodes(profile)
        self.reception = Reception(profile.keys)
        self.events: deque[tuple[str, Header, Event]] = deque(maxlen=MAX_EVENTS)
        self.task: Task | None = None
        self._task_heard_s = -1e9
        self._refusals: deque[tuple[float, Event]] = deque(maxlen=MAX_REFUSALS)
        self._token: Any = None
        self._reset_s = 0.0

    def subscribe(self) -> Self:
        """Subscribe to status, events, liveliness and the task; returns the client."""
        self._subscriptions += [
            self._subscribe(self.keys.all_events, self._on_event),
            self._subscribe(self.keys.task, self._on_task),
        ]
        return super().subscribe()

    def watch(self, key: str, buffer: SampleBuffer) -> Callable[[], None]:
        """Subscribe with `buffer`, whose samples are compared with what is sent; what is returned
        ends that."""
        subscriber = buffer.subscribe(self.session, key)
        self.reception.watch(key, buffer.arrived)

        def end() -> None:
            subscriber.undeclare()
            self.reception.unwatch(buffer.arrived)

        return end

    def status_received(self, name: str, status: NodeStatus, size: int) -> None:
        """Keep the status of a node, and what it says that it has sent."""
        super().status_received(name, status, size)
        self.reception.status_received(status)

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

    def token_gone(self, name: str) -> None:
        """A liveliness token is gone; with the command node's the task is no longer in force."""
        super().token_gone(name)
        if name == "command":
            with self._lock:
                self.task = None

    def note(self, name: str, event: Event) -> None:
        """Add an event of this program to those of the nodes."""
        with self._lock:
            self.events.append((name, Header(time.time_ns(), 0, name), event))

    def pop_events(self) -> list[tuple[str, Header, Event]]:
        """Events since the last call, oldest first."""
        with self._lock:
            events = list(self.events)
            self.events.clear()
        return events

    def wait_for(self, condition: Callable[[], Value | None], timeout_s: float) -> Value | None:
        """Poll until `condition` returns something true; None after `timeout_s`."""
        give_up = time.monotonic() + timeout_s
        while True:
            found = condition()
            if found or time.monotonic() > give_up:
                return found or None
            time.sleep(POLL_S)

    def reset(self) -> None:
        """Clear a latched emergency stop or fault; the arm stays inactive."""
        self._reset_s = time.monotonic()
        self.publish(self.keys.reset, "reset")

    def cleared(self) -> bool:
        """Whether the command node has said since `reset` that no stop and no fault is latched.

        A robot that recovers on a reset still reports its fault when the command node gets that
        reset and rejects it: it is put again as soon as no node reports a fault.
        """
        status = self.status_since("command", self._reset_s)
        if status is None or status.state in ("inactive", "active", "holding"):
            return status is not None and not self.stop_latched()
        if status.state == "fault" and time.monotonic() - self._reset_s > RESET_AGAIN_S:
            faults = {
                name for name, (node, _, _) in self.snapshot().items() if node.state == "fault"
            }
            if faults <= {"command"}:
                Client.reset(self)  # a subclass's may wait for this
        return False

    def set_prompt(self, prompt: str, timeout_s: float | None = None) -> Task:
        """Set the prompt, and wait until the command node has accepted it.

        A moving arm carries on with its plan until the worker has answered the new prompt, for
        ``timing.max_open_loop_s`` and ``watchdog_s`` after the last chunk at most.

        Args:
            prompt: in words.
            timeout_s: while it does not answer, or is starting; None: `patience_s`.

        Raises:
            SessionError: it was rejected, with the reasons, or not accepted in time.
        """
        wanted = settings.decode_text(settings.encode_text(prompt))
        return self._set("prompt", prompt, lambda task: task.prompt == wanted, timeout_s)

    def set_rate(self, rate_hz: float, timeout_s: float | None = None) -> Task:
        """Set the rate of action chunks, as `set_prompt`; `CodecError`: it is not allowed."""
        rate_hz = settings.decode_rate(str(rate_hz).encode())
        return self._set_number("rate", rate_hz, lambda task: task.rate_hz, timeout_s)

    def set_speed(self, percent: float, timeout_s: float | None = None) -> Task:
        """Set the speed override, 0 to 100 percent of the planned speed, as `set_prompt`."""
        percent = settings.decode_percent(str(percent).encode())
        return self._set_number("speed", percent, lambda task: task.speed_percent, timeout_s)

    def slow_down(self, percent: float, timeout_s: float | None = None) -> Task:
        """Lower the speed override; rejected if that would make the arm faster."""
        percent = settings.decode_percent(str(percent).encode())
        return self._set_number("slower", percent, lambda task: task.speed_percent, timeout_s)

    def _set_number(
        self, what: str, value: float, of: Callable[[Task], float], timeout_s: float | None
    ) -> Task:
        def taken(task: Task) -> bool:
            return math.isclose(of(task), value, rel_tol=1e-5, abs_tol=1e-9)

        return self._set(what, f"{value:g}", taken, timeout_s)

    def set_worker(self, worker: str, timeout_s: float | None = None) -> Task:
        """Choose the worker whose chunks are executed, as `set_prompt`.

        Raises:
            CodecError: it cannot be a worker's name.
        """
        settings.decode_name(settings.encode_text(worker))
        return self._set("worker", worker, lambda task: task.worker == worker, timeout_s)

    def activate(self, timeout_s: float | None = None, holder: str = "") -> Task:
        """Activate the arm, and wait until it is active, also while nodes are starting.

        `holder`: another client, whose liveliness token on `Keys.holding` makes it the deadman.

        Raises:
            StartingError: rejected only because something is still starting.
            SessionError: rejected, with every reason.
        """
        text = f"true {settings.WHILE} {holder}" if holder else "true"
        return self._set("activate", text, lambda task: task.active, timeout_s)

    def activate_with_deadman(self, what: str, timeout_s: float | None = None) -> Task:
        """Activate the arm for as long as this process is alive and connected: as its deadman.

        If the process ends before `deactivate`, also by kill -9 or a pulled cable, the arm brakes:
        at once if the router sees the connection close, else when it gives up the link
        (``session.lease_ms``). `what` names this client in messages.

        Raises:
            SessionError: rejected, with every reason.
        """
        self.release_deadman()
        holder = f"{what}-{secrets.token_hex(4)}"
        self._token = self.session.liveliness().declare_token(self.keys.holding(holder))
        give_up_s = time.monotonic() + HOLD_PATIENCE_S
        while True:
            try:
                return self.activate(timeout_s, holder)
            except SessionError as error:
                # The token may still be under way: it may arrive after a later put.
                if NO_DEADMAN_TOKEN not in str(error) or time.monotonic() > give_up_s:
                    self.release_deadman()
                    raise

    def why_inactive(self, timeout_s: float = WHY_PATIENCE_S) -> str:
        """Why the arm is not active; empty while it is.

        Task and status are two messages: a status from before the end of the activation has the
        reason of another transition, so a newer one is waited for.
        """
        task = self.task
        if task is not None and task.active:
            return ""
        if "command" not in self.alive:
            return "no command node is running"

        def knows() -> str:
            status = self.status("command")
            if status is None or status.state in ("active", "holding"):
                return ""
            episode = status.detail.get("episode")
            if task is not None and isinstance(episode, int) and episode < task.episode:
                return ""
            return str(status.detail.get("why", "")) or status.state

        return self.wait_for(knows, timeout_s) or "the command node does not say why"

    def latch_reason(self) -> str:
        """Latched stop or fault that has to be reset before activation; empty if there is none."""
        status = self.status("command")
        if status is None or status.state not in ("stopped", "fault"):
            return ""
        return f"{status.state}: {status.detail.get('why', '')}"

    def deactivate(self, timeout_s: float = 3.0) -> bool:
        """Deactivate the arm; True if it stands within `timeout_s`."""
        began_s = time.monotonic()
        self.publish(self.keys.active, "false")
        stands = bool(self.wait_for(lambda: self.stands(began_s), timeout_s))
        self.release_deadman()
        return stands

    def release_deadman(self) -> None:
        """Withdraw the deadman token: the arm brakes if it is still active."""
        with self._lock:  # several threads may release it
            token, self._token = self._token, None
        if token is not None:
            token.undeclare()

    def stands(self, since_s: float) -> bool:
        """Whether the arm stands, by a status that is newer than the command."""
        status = self.status_since("command", since_s)
        if status is None or status.state in ("active", "holding"):
            return False
        return status.detail.get("at_rest") is True

    def starting(self) -> list[str]:
        """Nodes of the profile that are being started."""
        found = [name for name in self.expected if self.is_starting(name)]
        absent = "command" not in self.alive
        return sorted({*found, "command"}) if absent and self._cold else found

    @property
    def _cold(self) -> bool:
        return time.monotonic() < self._cold_until_s

    def is_starting(self, node: str) -> bool:
        """Whether a node of any name is being started, by `up` on its host or by hand."""
        status, age_s, alive = self.snapshot().get(node, (None, 0.0, False))
        return status is not None and not alive and status.state == STARTING and age_s < SILENT_S

    def await_start(self, node: str) -> bool:
        """Wait while `node` is being started; True if it is alive."""

        def starts() -> bool:
            return self.is_starting(node) or node in self.starting()

        self.wait_for(lambda: node in self.alive or starts(), ABSENT_PATIENCE_S)
        if starts():
            self.tell(waiting(self.patience_s, f"{node} is starting"))
            self.wait_for(lambda: not starts(), self.patience_s)
        return node in self.alive

    def _set(
        self, what: str, text: str, taken: Callable[[Task], bool], timeout_s: float | None
    ) -> Task:
        """Put a setting until it is taken or rejected for good; see `_ask`."""
        patience_s = self.patience_s if timeout_s is None else timeout_s
        give_up_s, told = time.monotonic() + patience_s, ""
        while True:
            left_s = max(0.0, give_up_s - time.monotonic())
            try:
                return self._ask(
                    what, text, taken, min(left_s, ANSWER_S) if timeout_s is None else left_s
                )
            except SessionError as error:
                starts = isinstance(error, StartingError) or self.starting()
                if not starts or time.monotonic() + START_PERIOD_S > give_up_s:
                    raise
                if str(error) != told:
                    told = str(error)
                    self.tell(waiting(patience_s, told))
            time.sleep(START_PERIOD_S)

    def _ask(self, what: str, text: str, taken: Callable[[Task], bool], timeout_s: float) -> Task:
        """Put a setting, and wait for a newer task that has it, or a newer rejection.

        If neither comes in time, an activation is taken back: it must not take effect later.
        """
        give_up_s = time.monotonic() + timeout_s
        if not self._reads_task(what, timeout_s):
            raise self._unanswered(what, timeout_s)
        activates, began_s = what == "activate", time.monotonic()
        key = self.keys.active if activates else getattr(self.keys, what)
        self.publish(key, text)

        def over() -> bool:
            lost = time.monotonic() > began_s + ANSWER_S and "command" in self.starting()
            return bool(self._refused(what, began_s) or self._taken(taken, began_s)) or lost

        self.wait_for(over, give_up_s - began_s)
        if self._refused(what, began_s):
            time.sleep(0.1)  # the other reasons follow the first
            rejections = self._refused(what, began_s)
            reasons = dict.fromkeys(event.why for event in rejections)
            passes = all(event.level == "info" for event in rejections)
            rejected = StartingError if passes else SessionError
            raise rejected(f"{what} rejected:\n  - " + "\n  - ".join(reasons))
        if (task := self._taken(taken, began_s)) is not None:
            return task
        if activates:
            self.publish(key, "false")
        raise self._unanswered(what, timeout_s)

    def _reads_task(self, what: str, timeout_s: float) -> bool:
        """Whether a task of this robot could be read, for which it waits.

        Nothing is put before: a robot of another version obeys settings, which are plain text, and
        nobody here would see it. A stop is put at once.

        Raises:
            SessionError: there is one that cannot be read.
        """

        def reads() -> bool:
            return self.task is not None and Task not in self._unread

        def never_read() -> bool:
            return self.task is None and Task in self._unread

        if not reads():
            self.wait_for(lambda: reads() or never_read(), timeout_s)
        if Task in self._unread:
            raise SessionError(
                f"{what}: nothing was put, since what robot {self.keys.robot!r} does cannot be "
                f"read: {self._unread[Task]}"
            )
        return self.task is not None

    def _unanswered(self, what: str, timeout_s: float) -> SessionError:
        if "command" not in self.alive:
            names = ", ".join(self.starting())
            starts = f"; starting: {names}" if names else ""
            return SessionError(
                f"{what}: no command node of robot {self.keys.robot!r} is running{starts}"
            )
        status = self.status("command")
        unread = self.other_version or "it has not reported its state yet"
        state = f"its state is {status.state}" if status else unread
        silent = StartingError if self._cold else SessionError
        return silent(
            f"{what}: the command node of robot {self.keys.robot!r} is alive, but did not accept "
            f"this within {timeout_s:g} s; {state}. It may just have started: try again, or see "
            "`vla-zenoh status`"
        )

    def _taken(self, taken: Callable[[Task], bool], since_s: float) -> Task | None:
        with self._lock:
            task, heard_s = self.task, self._task_heard_s
        return task if task is not None and heard_s > since_s and taken(task) else None

    def _refused(self, what: str, since_s: float) -> list[Event]:
        with self._lock:
            return [
                event
                for heard_s, event in self._refusals
                if heard_s > since_s and event.what == f"{what}_refused"
            ]
