"""Topics by which ROS users control the robot, and the same as services where the profile has them.

Requests run in a thread of their own, because the command node has to confirm one before it is
answered. A stop is sent at once, and no request made before it is executed after it.
"""

from __future__ import annotations

import contextlib
import json
import queue
import threading
import time
from collections import deque
from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import zenoh

from vla_zenoh.bus.buffers import bytes_of
from vla_zenoh.client.client import Client
from vla_zenoh.codec import settings
from vla_zenoh.errors import CodecError, SessionError
from vla_zenoh.profile import Profile
from vla_zenoh_ros2.keys import (
    ACTIVE,
    ANSWER_TOPIC,
    LATCHED,
    LOG,
    OPERATIONS,
    PROMPT,
    REQUEST,
    RESET,
    ROSOUT,
    STATUS_TOPIC,
    STOP,
    TEXT,
    Operation,
)
from vla_zenoh_ros2.messages import Messages
from vla_zenoh_ros2.middleware import Bridges
from vla_zenoh_ros2.readers import Wanted, read, read_request
from vla_zenoh_ros2.ros_graph import Request, RosGraph
from vla_zenoh_ros2.writers import DIAGNOSTICS, Stamp, diagnostics, log

STATUS_PERIOD_S = 1.0
POLL_S = 0.05
MAX_WAITING = 32
STATE_TIMEOUT_S = 2.0
DISCOVERY_S = 0.1
"""A bridge may pass on a sample before it says who published it."""
REPEAT_NS = 1_500_000_000
"""The same request again within this time, as ``ros2 topic pub`` sends it, is no new one."""


class OperatorCall(NamedTuple):
    """A request, and when it came; by topic if there is no `service` call to answer."""

    operation: Operation
    payload: bytes
    mono_ns: int
    service: Request | None = None


class OperatorTopics:
    """Executes what ROS users request, answers them, and publishes the status topic.

    The `session` is to our own router; `prefix` begins the names of topics and services. `run` is
    the body of a thread, the only user of `messages`; `reject` may be called from any thread.
    `about` says what of the robot's ROS graph works, for `ROSOUT`.
    """

    def __init__(
        self,
        profile: Profile,
        session: zenoh.Session,
        graph: RosGraph,
        bridges: Bridges,
        messages: Messages,
        prefix: str,
        reject: Callable[[str, str, str], None],
        *,
        services: bool = False,
        about: Callable[[], list[str]] = list,
    ) -> None:
        self._robot, self._messages, self._reject = profile.robot.name, messages, reject
        self._prefix, self._services = prefix, services
        self._bridges = bridges
        self._about, self._told = about, ""
        self._client = Client(profile, session).subscribe()
        # A reset or an activation that waits, while another request is answered or this process
        # does not run, must not undo a stop that came later and was sent at once.
        self._stop_lock = threading.Lock()
        self._our_stop_ns = self._others_stop_ns = -1
        self._others_stops = session.declare_subscriber(
            profile.keys.stop,
            zenoh.handlers.Callback(self._on_stop, indirect=False),
            allowed_origin=zenoh.Locality.REMOTE,
        )
        self._calls: queue.Queue[OperatorCall] = queue.Queue(MAX_WAITING)
        self._left_out: deque[Operation] = deque(maxlen=MAX_WAITING)
        self._called_ns = 0
        self._executed: dict[Operation, tuple[Wanted, int]] = {}
        for one in OPERATIONS:
            graph.listen(f"{prefix}/{one.name}", one.type, partial(self._on_sample, one))
            if services:
                name = f"{prefix}/{one.service}"
                graph.serve(name, one.service_type, partial(self._on_request, one))
        self._answers = graph.publisher(f"{prefix}/{ANSWER_TOPIC}", TEXT)
        self._status = graph.publisher(f"{prefix}/{STATUS_TOPIC}", DIAGNOSTICS)
        self._log = graph.publisher(ROSOUT, LOG, LATCHED)

    # -- on Zenoh's threads ---------------------------------------------------------------------
    def _on_sample(self, operation: Operation, sample: zenoh.Sample) -> None:
        if sample.kind != zenoh.SampleKind.PUT:
            return
        payload = b""
        if operation is not STOP:  # which acts whatever its message is
            try:
                payload = bytes_of(sample.payload, settings.MAX_SETTING_BYTES)
            except CodecError as error:
                self._reject(error.reason, f"{self._prefix}/{operation.name}: {error}", "")
                return
        self._enqueue(OperatorCall(operation, payload, time.monotonic_ns()))

    def _on_request(self, operation: Operation, request: Request) -> None:
        self._enqueue(OperatorCall(operation, request.payload, time.monotonic_ns(), request))

    def _enqueue(self, call: OperatorCall) -> None:
        if call.operation is STOP:  # overtakes the calls in the queue
            with self._stop_lock:
                self._our_stop_ns = time.monotonic_ns()
                self._client.publish(self._client.keys.stop, "")
        try:
            self._calls.put_nowait(call)
        except queue.Full:
            if call.service is not None:
                call.service.drop("too many calls at once")
            self._left_out.append(call.operation)

    def _on_stop(self, sample: zenoh.Sample) -> None:
        if sample.kind == zenoh.SampleKind.PUT:
            self._others_stop_ns = time.monotonic_ns()

    # -- the thread -------------------------------------------------------------------------------
    def run(self, stop: threading.Event) -> None:
        """Serve until `stop` is set."""
        try:
            self._serve(stop)
        except zenoh.ZError:
            if not stop.is_set():  # else the node ended while a request was being confirmed
                raise

    def _serve(self, stop: threading.Event) -> None:
        next_status_s = time.monotonic()
        while not stop.is_set():
            with contextlib.suppress(queue.Empty):
                self._handle(self._calls.get(timeout=POLL_S))
            while self._left_out:
                operation, why = self._left_out.popleft(), "too many requests at once"
                self._reject("busy", f"{operation.name}: {why}", operation.name)
                self._answer(operation, None, why, ok=False)
            if time.monotonic() >= next_status_s:
                next_status_s = time.monotonic() + STATUS_PERIOD_S
                self._publish_status()

    def _publish_status(self) -> None:
        stamp = Stamp(time.time_ns(), "")
        message = diagnostics(self._messages, self._robot, self._client.snapshot(), stamp)
        self._status.publish(self._messages.encode(message))
        if not self._log.has_subscribers:  # of a bridge: it is not there
            self._told = ""
            return
        text = "\n".join([self._sentence(), *self._about()])
        if text != self._told:
            self._told = text
            self._log.publish(self._messages.encode(log(self._messages, self._robot, text, stamp)))

    def _sentence(self) -> str:
        topics = ", ".join(f"{self._prefix}/{one.name}" for one in OPERATIONS)
        offered = "offers services, too" if self._services else "no services (ros2.services)"
        return f"listens to {topics} and answers on {self._prefix}/{ANSWER_TOPIC}; {offered}"

    def _handle(self, call: OperatorCall) -> None:
        operation, wanted = call.operation, Wanted()
        self._called_ns = call.mono_ns
        # An error reply never reaches a ROS client, which would wait for ever.
        try:
            wanted = self._wanted(call)
            reason, ok = self._execute(call, wanted), True
        except CodecError as error:
            self._reject(error.reason, f"{operation.name}: {error}", operation.name)
            reason, ok = str(error), False
        except (SessionError, zenoh.ZError) as error:
            reason, ok = str(error), False
        if call.service is None:
            self._answer(operation, wanted.id, reason, ok=ok)
            return
        kind = f"{operation.service_type}_Response"
        response = self._messages.new(kind, success=ok, message=reason)
        call.service.answer(self._messages.encode(response))

    def _answer(self, operation: Operation, name: str | None, reason: str, *, ok: bool) -> None:
        text = json.dumps({"id": name, "what": operation.name, "ok": ok, "reason": reason})
        self._answers.publish(self._messages.encode(self._messages.new(TEXT, data=text)))

    def _wanted(self, call: OperatorCall) -> Wanted:
        operation, by_topic = call.operation, call.service is None
        if operation is STOP or (operation is RESET and by_topic):
            return Wanted()
        if not by_topic:
            asked = self._messages.decode(f"{operation.service_type}_Request", call.payload)
            if operation is ACTIVE:
                return Wanted(active=bool(asked.data))
            if operation is PROMPT:
                return Wanted(prompt=asked.prompt)
            if operation is REQUEST:
                asked_for = (asked.prompt or None, asked.worker or None, asked.rate_hz or None)
                return Wanted(None, *asked_for, bool(asked.active))
            return Wanted()
        value = read(self._messages, operation.type, call.payload)
        if operation is ACTIVE:
            return Wanted(active=value)
        return Wanted(prompt=value) if operation is PROMPT else read_request(value)

    def _execute(self, call: OperatorCall, wanted: Wanted) -> str:
        """Answer of a request that was executed, or a `SessionError` or `CodecError`."""
        if call.operation is STOP:
            self._client.follow_stop(call.mono_ns / 1e9)
            stands = self._client.wait_for(self._client.stopped, STATE_TIMEOUT_S)
            told = self._client.stop_progress().sentence(f"robot {self._robot}")
            if not stands:
                raise SessionError(told)
            return f"{told}; call reset, then activate"
        self._check_stops(call.mono_ns)
        sets_in_motion = call.operation is RESET or wanted.active is True
        if sets_in_motion and call.service is None:
            self._check_new(call, wanted)
        done = self._reset() if call.operation is RESET else self._apply(wanted)
        if sets_in_motion:
            self._executed[call.operation] = (wanted, call.mono_ns)
        return done

    # -- what must not happen -------------------------------------------------------------------
    def _check_stops(self, asked_ns: int) -> None:
        """Raise a `SessionError` if a stop came after `asked_ns` on the monotonic clock."""
        if max(self._our_stop_ns, self._others_stop_ns) > asked_ns:
            raise SessionError("an emergency stop came after this request; send it again")

    def _check_new(self, call: OperatorCall, wanted: Wanted) -> None:
        """Raise a `SessionError` if a reset or activation may be an old one, or one sent on and on.

        Nothing in these messages says when they were made.
        """
        topic = f"{self._prefix}/{call.operation.name}"
        before, heard_ns = self._executed.get(call.operation, (None, 0))
        if before == wanted and call.mono_ns - heard_ns < REPEAT_NS:
            self._executed[call.operation] = (wanted, call.mono_ns)
            raise SessionError(
                f"repeated: {topic} was executed once and goes on being published; publish it "
                f"once (`ros2 topic pub --once`), and again after {REPEAT_NS / 1e9:g} s of silence"
            )
        time.sleep(max(0.0, DISCOVERY_S - (time.monotonic_ns() - call.mono_ns) / 1e9))
        if self._bridges.has_transient_local(topic):
            raise SessionError(
                f"{topic} has a publisher that is transient_local: what it once published is "
                "received again whenever a reader comes late or a bridge restarts, so it may not "
                "set the arm in motion; publish it volatile, the default"
            )

    # -- what is requested ----------------------------------------------------------------------
    def _activate(self, wanted: bool) -> str:
        if wanted:
            self._check_stops(self._called_ns)  # earlier parts of a request may take seconds
            task = self._client.activate()
            return f"active: worker {task.worker}, {task.prompt!r}"
        if not self._client.deactivate():
            raise SessionError("the command node does not confirm that the arm stands")
        return "inactive, the arm stands"

    def _reset(self) -> str:
        with self._stop_lock:  # no stop of this process comes between the two
            self._check_stops(self._called_ns)
            asked_ns = time.monotonic_ns()
            self._client.publish(self._client.keys.reset, "")

        def state() -> str:
            status = self._client.status_since("command", asked_ns / 1e9)
            return "silent" if status is None else status.state

        if not self._client.wait_for(lambda: state() == "inactive", STATE_TIMEOUT_S):
            raise SessionError(f"the command node is {state()}, not inactive")
        return "inactive"

    def _apply(self, wanted: Wanted) -> str:
        """Apply what is given, one after the other: deactivation first, activation last.

        The first rejected one ends it; those before it stay applied.
        """
        done = []
        if wanted.active is False:
            done.append(self._activate(False))
        if wanted.worker is not None:
            worker = settings.decode_name(wanted.worker.encode())
            done.append(f"worker {self._client.set_worker(worker).worker}")
        if wanted.rate_hz is not None:
            rate_hz = settings.decode_rate(repr(float(wanted.rate_hz)).encode())
            done.append(f"rate {self._client.set_rate(rate_hz).rate_hz:g} Hz")
        if wanted.prompt is not None:
            done.append(self._set_prompt(prompt_text(wanted.prompt)))
        if wanted.active:
            done.append(self._activate(True))
        return "; ".join(done)

    def _set_prompt(self, prompt: str) -> str:
        """Set it, unless it is the prompt already: a topic may repeat one."""
        task = self._client.task
        if task is None or task.prompt != prompt:
            task = self._client.set_prompt(prompt)
        return f"prompt {task.prompt!r}"


def prompt_text(value: str) -> str:
    """A prompt as the command node accepts it, or a `CodecError`."""
    return settings.decode_text(value.encode("utf-8", "surrogatepass"))
