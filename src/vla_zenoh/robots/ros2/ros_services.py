"""ROS services that control the robot: activate, stop, reset, prompt; topics of prompt and status.

They run in a thread of their own, because the command node has to confirm a setting before the call
is answered. A stop is sent at once, and no call made before it is executed after it.
"""

from __future__ import annotations

import contextlib
import queue
import threading
import time
from collections.abc import Callable
from functools import partial
from typing import Any

import zenoh

from vla_zenoh.bus.buffers import CallbackRing
from vla_zenoh.bus.client import Client
from vla_zenoh.codec import settings
from vla_zenoh.errors import CodecError, SessionError
from vla_zenoh.profile import Profile
from vla_zenoh.robots.ros2.ros_graph import Request, RosGraph
from vla_zenoh.ros2.keys import (
    PROMPT_TOPIC,
    RESET,
    SERVICES,
    SET_ACTIVE,
    SET_PROMPT,
    SET_REQUEST,
    STATUS_TOPIC,
    STOP,
    Service,
)
from vla_zenoh.ros2.messages import Messages
from vla_zenoh.ros2.readers import TEXT, read
from vla_zenoh.ros2.writers import DIAGNOSTICS, Stamp, diagnostics

STATUS_PERIOD_S = 1.0
POLL_S = 0.05
MAX_WAITING = 32
STATE_TIMEOUT_S = 2.0


class RosServices:
    """Serves the control services, applies the prompt topic, and publishes the status topic.

    The `session` is to our own router; `prefix` begins the names of services and topics. `run` is
    the body of a thread, the only user of `messages`; `reject` may be called from any thread.
    """

    def __init__(
        self,
        profile: Profile,
        session: zenoh.Session,
        graph: RosGraph,
        messages: Messages,
        prefix: str,
        reject: Callable[[str, str, str], None],
    ) -> None:
        self._robot, self._messages, self._reject = profile.robot.name, messages, reject
        self._client = Client(profile, session).subscribe()
        # A reset or an activation that waits, while another call is answered or this process does
        # not run, must not undo a stop that came later and was sent at once.
        self._stop_lock = threading.Lock()
        self._our_stop_ns = self._others_stop_ns = -1
        self._others_stops = session.declare_subscriber(
            profile.keys.stop,
            zenoh.handlers.Callback(self._on_stop, indirect=False),
            allowed_origin=zenoh.Locality.REMOTE,
        )
        self._calls: queue.Queue[tuple[Service, Request, int]] = queue.Queue(MAX_WAITING)
        self._called_ns = 0
        self._handlers: dict[str, Callable[[Any], str]] = {
            SET_ACTIVE.name: lambda asked: self._activate(bool(asked.data)),
            STOP.name: self._stop,
            RESET.name: self._reset,
            SET_PROMPT.name: self._set_prompt,
            SET_REQUEST.name: self._set_request,
        }
        for service in SERVICES:
            graph.serve(f"{prefix}/{service.name}", service.type, partial(self._enqueue, service))
        self._prompt_topic, self._prompt = f"{prefix}/{PROMPT_TOPIC}", ""
        self._prompts = graph.subscribe(self._prompt_topic, TEXT, CallbackRing(MAX_WAITING))
        self._status = graph.publisher(f"{prefix}/{STATUS_TOPIC}", DIAGNOSTICS)

    def _enqueue(self, service: Service, request: Request) -> None:
        if service is STOP:  # overtakes the calls in the queue
            with self._stop_lock:
                self._our_stop_ns = time.monotonic_ns()
                self._client.publish(self._client.keys.stop, "")
        try:
            self._calls.put_nowait((service, request, time.monotonic_ns()))
        except queue.Full:
            request.drop("too many calls at once")

    def run(self, stop: threading.Event) -> None:
        """Serve until `stop` is set."""
        next_status_s = time.monotonic()
        while not stop.is_set():
            with contextlib.suppress(queue.Empty):
                self._answer(*self._calls.get(timeout=POLL_S))
            self._poll_prompts()
            if time.monotonic() >= next_status_s:
                next_status_s = time.monotonic() + STATUS_PERIOD_S
                stamp = Stamp(time.time_ns(), "")
                nodes = self._client.snapshot()
                message = diagnostics(self._messages, self._robot, nodes, stamp)
                self._status.publish(self._messages.encode(message))

    def _poll_prompts(self) -> None:
        """Apply the prompts of the topic; a repeated one only if the task has another one now."""
        for arrival in self._prompts.drain():
            try:
                payload = arrival.sample.payload.to_bytes()
                prompt = prompt_text(read(self._messages, TEXT, payload))
            except CodecError as error:
                self._reject(error.reason, f"{self._prompt_topic}: {error}", PROMPT_TOPIC)
                continue
            # The task may lag behind what was just published: a new prompt is always applied.
            changed, self._prompt = self._prompt not in ("", prompt), prompt
            task = self._client.task
            if changed or task is None or task.prompt != prompt:
                self._client.publish(self._client.keys.prompt, prompt)

    # -- stops --------------------------------------------------------------------------------
    def _on_stop(self, sample: zenoh.Sample) -> None:
        if sample.kind == zenoh.SampleKind.PUT:
            self._others_stop_ns = time.monotonic_ns()

    def _check_stops(self, asked_ns: int) -> None:
        """Raise a `SessionError` if a stop came after `asked_ns` on the monotonic clock."""
        if max(self._our_stop_ns, self._others_stop_ns) > asked_ns:
            raise SessionError("an emergency stop came after this request; send it again")

    # -- services -----------------------------------------------------------------------------
    def _answer(self, service: Service, request: Request, called_ns: int) -> None:
        try:
            asked = self._messages.decode(f"{service.type}_Request", request.payload)
        except CodecError as error:
            self._reject(error.reason, f"{service.name}: {error}", service.name)
            request.drop(str(error))
            return
        # An error reply never reaches a ROS client, which would wait for ever.
        self._called_ns = called_ns
        try:
            if service is not STOP:
                self._check_stops(called_ns)
            text, success = self._handlers[service.name](asked), True
        except CodecError as error:
            self._reject(error.reason, f"{service.name}: {error}", service.name)
            text, success = str(error), False
        except (SessionError, zenoh.ZError) as error:
            text, success = str(error), False
        response = self._messages.new(f"{service.type}_Response", success=success, message=text)
        request.answer(self._messages.encode(response))

    def _activate(self, wanted: bool) -> str:
        if wanted:
            self._check_stops(self._called_ns)  # earlier parts of a request may take seconds
            task = self._client.activate()
            return f"active: worker {task.worker}, {task.prompt!r}"
        if not self._client.deactivate():
            raise SessionError("the command node does not confirm that the arm stands")
        return "inactive, the arm stands"

    def _stop(self, asked: Any) -> str:
        self._await_state("stopped", self._called_ns)
        return "stopped; call reset, then activate"

    def _reset(self, asked: Any) -> str:
        with self._stop_lock:  # no stop of this process comes between the two
            self._check_stops(self._called_ns)
            asked_ns = time.monotonic_ns()
            self._client.publish(self._client.keys.reset, "")
        self._await_state("inactive", asked_ns)
        return "inactive"

    def _await_state(self, wanted: str, since_ns: int) -> None:
        def state() -> str:
            status = self._client.status_since("command", since_ns / 1e9)
            return "silent" if status is None else status.state

        if not self._client.wait_for(lambda: state() == wanted, STATE_TIMEOUT_S):
            then = "; use the emergency stop of the arm itself" if wanted == "stopped" else ""
            raise SessionError(f"the command node is {state()}, not {wanted}{then}")

    def _set_prompt(self, asked: Any) -> str:
        return f"prompt {self._client.set_prompt(prompt_text(asked.prompt)).prompt!r}"

    def _set_request(self, asked: Any) -> str:
        """Apply the fields one after the other: deactivation first, activation last.

        The first rejected one ends it; those before it stay applied.
        """
        done = []
        if not asked.active:
            done.append(self._activate(False))
        if asked.worker:
            worker = settings.decode_name(asked.worker.encode())
            done.append(f"worker {self._client.set_worker(worker).worker}")
        if asked.rate_hz:
            rate_hz = settings.decode_rate(repr(float(asked.rate_hz)).encode())
            done.append(f"rate {self._client.set_rate(rate_hz).rate_hz:g} Hz")
        if asked.prompt:
            done.append(self._set_prompt(asked))
        if asked.active:
            done.append(self._activate(True))
        return "; ".join(done)


def prompt_text(value: str) -> str:
    """A prompt as the command node accepts it, or a `CodecError`."""
    return settings.decode_text(value.encode("utf-8", "surrogatepass"))
