"""ROS topics that control the robot: prompt and activation, applied in order of arrival.

They have a thread of their own: a deactivation must not wait for a service call.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable

import zenoh

from vla_zenoh.bus.buffers import CallbackRing, ReceivedSample
from vla_zenoh.bus.client import Client
from vla_zenoh.codec import settings
from vla_zenoh.errors import CodecError, SessionError
from vla_zenoh.interop.ros2 import table
from vla_zenoh.interop.ros2.activation_filter import QUIET_S, ActivationFilter
from vla_zenoh.interop.ros2.messages import Messages
from vla_zenoh.interop.ros2.services import ACTIVE_TOPIC, PROMPT_TOPIC
from vla_zenoh.interop.ros2.topics import plain
from vla_zenoh.robots.ros2.ros_graph import RosGraph

POLL_S = 0.05
BUFFER = 64
ACTIVATION_NS = 500_000_000
"""An activation may take this long."""

Reject = Callable[[str, str, str], None]


class EstopOrder:
    """Times of the last emergency stops, of this process and of others.

    A reset or an activation that waits, while another call is answered or this process does not
    run, must not undo a stop that came later and was sent at once.

    Args:
        session: to subscribe to the stops of others.
        key: of stops.
    """

    def __init__(self, session: zenoh.Session, key: str) -> None:
        self._lock = threading.Lock()
        self._ours_ns = self._others_ns = -1
        handler = zenoh.handlers.Callback(self._on_stop, indirect=False)
        self._subscriber = session.declare_subscriber(
            key, handler, allowed_origin=zenoh.Locality.REMOTE
        )

    def _on_stop(self, sample: zenoh.Sample) -> None:
        if sample.kind == zenoh.SampleKind.PUT:
            self._others_ns = time.monotonic_ns()

    def stop(self, publish: Callable[[], None]) -> None:
        """Stop by calling `publish`."""
        with self._lock:
            self._ours_ns = time.monotonic_ns()
            publish()

    def overtook(self, asked_ns: int) -> bool:
        """Whether a stop came after `asked_ns` on the monotonic clock."""
        return max(self._ours_ns, self._others_ns) > asked_ns

    def check(self, asked_ns: int) -> None:
        """Check that no stop came after `asked_ns`.

        Raises:
            SessionError: one came.
        """
        if self.overtook(asked_ns):
            raise SessionError("an emergency stop came after this request; send it again")

    def unless_stopped(self, asked_ns: int, publish: Callable[[], None]) -> None:
        """Call `publish`; no stop of this process comes between the check and it.

        Raises:
            SessionError: a stop came after `asked_ns`.
        """
        with self._lock:
            self.check(asked_ns)
            publish()


class RosTopics:
    """Applies what is published on the control topics.

    Args:
        client: publishes the settings.
        graph: the ROS graph.
        messages: of the robot's distribution, for this thread alone.
        prefix: of the names of the topics.
        reject: counts a rejection; may be called from any thread.
        stops: emergency stops.
    """

    def __init__(
        self,
        client: Client,
        graph: RosGraph,
        messages: Messages,
        prefix: str,
        reject: Reject,
        stops: EstopOrder,
    ) -> None:
        self._client, self._messages, self._reject = client, messages, reject
        self._stops = stops
        self._prefix = prefix
        self._prompts = graph.subscribe(
            f"{prefix}/{PROMPT_TOPIC}", plain.TEXT, CallbackRing(BUFFER)
        )
        self._activations = graph.subscribe(
            f"{prefix}/{ACTIVE_TOPIC}", plain.TRUTH, CallbackRing(BUFFER)
        )
        self._filter = ActivationFilter(time.monotonic_ns())
        self._published_ns = 0
        self._rejected = False
        self._prompt: str | None = None

    def run(self, stop: threading.Event) -> None:
        """Poll the topics until `stop` is set."""
        while not stop.wait(POLL_S):
            self.poll()

    def poll(self) -> None:
        """Apply what arrived since the last call."""
        arrived = [
            (arrival.mono_ns, apply, arrival)
            for buffer, apply in (
                (self._prompts, self._apply_prompt),
                (self._activations, self._apply_activation),
            )
            for arrival in buffer.drain()
        ]
        for _, apply, arrival in sorted(arrived, key=lambda each: each[0]):
            apply(arrival)

    def _apply_prompt(self, arrival: ReceivedSample) -> None:
        try:
            value = table.read(self._messages, plain.TEXT, arrival.sample.payload.to_bytes())
            prompt = prompt_text(value)
        except CodecError as error:
            self._reject(error.reason, f"{self._prefix}/{PROMPT_TOPIC}: {error}", PROMPT_TOPIC)
            return
        # The task may lag behind what was just published: a new prompt counts in any case.
        changed = self._prompt is not None and prompt != self._prompt
        self._prompt = prompt
        task = self._client.task
        if changed or task is None or task.prompt != prompt:
            self._client.publish(self._client.keys.prompt, prompt)

    def _apply_activation(self, arrival: ReceivedSample) -> None:
        topic = f"{self._prefix}/{ACTIVE_TOPIC}"
        try:
            value = table.read(self._messages, plain.TRUTH, arrival.sample.payload.to_bytes())
        except CodecError as error:
            self._reject(error.reason, f"{topic}: {error}", ACTIVE_TOPIC)
            return
        wanted = bool(value)
        if self._filter.take(wanted, arrival.mono_ns):
            if wanted and self._stops.overtook(arrival.mono_ns):
                self._reject("stopped", f"{topic}: true, and then an emergency stop", ACTIVE_TOPIC)
                return
            self._published_ns, self._rejected = arrival.mono_ns, False
            self._client.publish(self._client.keys.active, settings.encode_bool(wanted).decode())
            return
        task = self._client.task
        if task is not None and task.active:
            self._rejected = False
        elif not self._rejected and arrival.mono_ns - self._published_ns > ACTIVATION_NS:
            self._rejected = True  # the first of many repetitions
            why = (
                f"{topic}: a repeated true activates nothing; publish false, and true "
                f"{QUIET_S:g} s after the last one, or call {self._prefix}/set_active"
            )
            self._reject("repeated", why, ACTIVE_TOPIC)


def prompt_text(value: str) -> str:
    """A prompt as the command node accepts it.

    Raises:
        CodecError: it is not acceptable.
    """
    return settings.decode_text(value.encode("utf-8", "surrogatepass"))
