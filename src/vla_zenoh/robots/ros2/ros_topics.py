"""Topics for ROS people: what they publish becomes a setting of ours, in the order it came in.

A thread of its own: whoever switches the arm off must not wait for a service's answer.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable

from vla_zenoh.bus.buffers import CallbackRing, ReceivedSample
from vla_zenoh.bus.client import Client
from vla_zenoh.codec import settings
from vla_zenoh.errors import CodecError
from vla_zenoh.interop.ros2 import table
from vla_zenoh.interop.ros2.activation_filter import QUIET_S, ActivationFilter
from vla_zenoh.interop.ros2.messages import Messages
from vla_zenoh.interop.ros2.services import ACTIVE_TOPIC, PROMPT_TOPIC
from vla_zenoh.interop.ros2.topics import plain
from vla_zenoh.robots.ros2.estop_order import EstopOrder
from vla_zenoh.robots.ros2.ros_graph import RosGraph

TURN_S = 0.05
WAITING = 64
"""Words kept between two turns."""
PATIENCE_NS = 500_000_000
"""For so long an activation may be under way."""

Refuse = Callable[[str, str, str], None]


class RosTopics:
    """See the module.

    Args:
        client: puts what is wished.
        link: to the ROS graph.
        messages: of the robot's distribution, for this thread alone.
        prefix: what names of topics begin with.
        refuse: counts a refusal; may be called from any thread.
        stops: known so far.
    """

    def __init__(
        self,
        client: Client,
        link: RosGraph,
        messages: Messages,
        prefix: str,
        refuse: Refuse,
        stops: EstopOrder,
    ) -> None:
        self._client, self._messages, self._refuse = client, messages, refuse
        self._stops = stops
        self._prefix = prefix
        self._prompts = link.read(f"{prefix}/{PROMPT_TOPIC}", plain.TEXT, CallbackRing(WAITING))
        self._switches = link.read(f"{prefix}/{ACTIVE_TOPIC}", plain.TRUTH, CallbackRing(WAITING))
        self._switch = ActivationFilter(time.monotonic_ns())
        self._put_ns = 0
        self._told = False
        self._prompt: str | None = None

    def run(self, stop: threading.Event) -> None:
        """Take what comes until `stop` is set."""
        while not stop.wait(TURN_S):
            self.take()

    def take(self) -> None:
        """Take what came since the last call."""
        came = [
            (arrival.mono_ns, obey, arrival)
            for slot, obey in ((self._prompts, self._wish), (self._switches, self._turn))
            for arrival in slot.drain()
        ]
        for _, obey, arrival in sorted(came, key=lambda each: each[0]):
            obey(arrival)

    def _wish(self, arrival: ReceivedSample) -> None:
        try:
            value = table.read(self._messages, plain.TEXT, arrival.sample.payload.to_bytes())
            prompt = text_of(value)
        except CodecError as error:
            self._refuse(error.reason, f"{self._prefix}/{PROMPT_TOPIC}: {error}", PROMPT_TOPIC)
            return
        # The agreed task may lag behind what was just put: a new word counts whatever it says.
        changed = self._prompt is not None and prompt != self._prompt
        self._prompt = prompt
        task = self._client.task
        if changed or task is None or task.prompt != prompt:
            self._client.publish(self._client.keys.prompt, prompt)

    def _turn(self, arrival: ReceivedSample) -> None:
        topic = f"{self._prefix}/{ACTIVE_TOPIC}"
        try:
            value = table.read(self._messages, plain.TRUTH, arrival.sample.payload.to_bytes())
        except CodecError as error:
            self._refuse(error.reason, f"{topic}: {error}", ACTIVE_TOPIC)
            return
        wanted = bool(value)
        if self._switch.take(wanted, arrival.mono_ns):
            if wanted and self._stops.overtook(arrival.mono_ns):
                self._refuse("stopped", f"{topic}: true, and then an emergency stop", ACTIVE_TOPIC)
                return
            self._put_ns, self._told = arrival.mono_ns, False
            self._client.publish(self._client.keys.active, settings.encode_bool(wanted).decode())
            return
        task = self._client.task
        if task is not None and task.active:
            self._told = False
        elif not self._told and arrival.mono_ns - self._put_ns > PATIENCE_NS:
            self._told = True  # once: the next words say no more
            why = (
                f"{topic}: true, said again and again, activates nothing; say false, and true "
                f"{QUIET_S:g} s after the last one, or call {self._prefix}/set_active"
            )
            self._refuse("repeated", why, ACTIVE_TOPIC)


def text_of(value: str) -> str:
    """A prompt as our keys take it.

    Raises:
        CodecError: they do not.
    """
    return settings.decode_text(value.encode("utf-8", "surrogatepass"))
