"""Inputs of the command node at every tick: settings, chunks, states, and steps of its clock."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Sequence
from operator import itemgetter
from typing import Any

from vla_zenoh import keys as key_names
from vla_zenoh.bus.buffers import CallbackRing, ReceivedSample, ZenohRing, header_of
from vla_zenoh.bus.node import Node
from vla_zenoh.bus.session import MAX_MESSAGE_BYTES
from vla_zenoh.codec import settings
from vla_zenoh.codec.records import SMALL_BYTES
from vla_zenoh.control.commander_io import Inputs, NewStates, Setting
from vla_zenoh.errors import CodecError
from vla_zenoh.keys import Keys
from vla_zenoh.nodes.command.peer_monitor import PeerMonitor
from vla_zenoh.types import ActionChunk, GripperState, JointState, PoseState, Stamped
from vla_zenoh.types.stream import SingleWriterFilter

STATES = 32
"""States buffered between two ticks: the robot's, and room for those of another source."""
CHUNKS = 64
ANYTHING = MAX_MESSAGE_BYTES
"""Payload of a stop: any; it is not decoded."""
WORDS = settings.MAX_SETTING_BYTES
SETTINGS: tuple[tuple[str, int, int, Callable[[bytes], Any]], ...] = (
    ("stop", 8, ANYTHING, lambda _: None),
    ("reset", 8, ANYTHING, lambda _: None),
    ("prompt", 16, WORDS, settings.decode_text),
    ("worker", 16, WORDS, settings.decode_name),
    ("rate", 16, WORDS, settings.decode_rate),
    ("speed", 16, WORDS, settings.decode_percent),
    ("slower", 16, WORDS, settings.decode_percent),
    ("active", 16, WORDS, settings.decode_activation),
)
"""Name of each key, samples buffered between two ticks, largest payload, and decoder."""
CLOCK_PERIOD_S = 0.1
JOINT_PERIOD_S = 0.025
"""Period of decoding joints, except when an activation is requested."""


class CommandInputs:
    """Subscriptions to the robot, the workers and the clients' settings.

    Args:
        node: the command node; it counts and reports rejected samples.
    """

    def __init__(self, node: Node) -> None:
        self._node = node
        keys = node.keys
        self._peer_monitor = PeerMonitor(node)
        self.chunk_arrival = threading.Event()
        """Set when a chunk arrives."""
        ring = CallbackRing(CHUNKS, arrival=self.chunk_arrival)
        self._chunks = node.subscribe(keys.all_deltas, ring)
        names = node.profile.part_names
        self._parts = {name: _PartInputs(node, keys.of_part(name)) for name in names}
        self._settings = [
            (name, node.subscribe(getattr(keys, name), ZenohRing(size, limit)), decode)
            for name, size, limit, decode in SETTINGS
        ]
        self._last_clock = 0.0

    @property
    def chunks_dropped(self) -> int:
        """Chunks dropped because they arrived faster than they were processed."""
        return self._chunks.dropped

    def poll(self, now_ns: int, *, news: bool = True) -> Inputs:
        """Everything received since the last call.

        Args:
            now_ns: nominal time of this tick on the node's wall clock.
            news: read what other nodes publish; their liveliness is always up to date.
        """
        settings_put = self._poll_settings()
        peers = self._peer_monitor.update(now_ns, news=news)
        inputs = self.poll_streams(settings_put)
        inputs.settings, inputs.peers = [*settings_put, *self._check_clock()], peers
        return inputs

    def poll_streams(self, settings_put: Sequence[Setting] = ()) -> Inputs:
        """The chunks and states among them."""
        chunks = [self._chunk(arrival) for arrival in self._chunks.drain()]
        inputs = Inputs(chunks=[chunk for chunk in chunks if chunk is not None])
        requested = any(setting.name in ("active", "worker") for setting in settings_put)
        states = {name: part.poll(requested) for name, part in self._parts.items()}
        if "" in states:
            inputs.pose, inputs.gripper, inputs.joint = states[""]
        else:
            inputs.parts = states
        return inputs

    def _poll_settings(self) -> list[Setting]:
        """Settings put since the last tick, in the order of the router's timestamps.

        Each setting has a buffer of its own, so that a flood of one does not push out another.
        Without timestamps only the order on each key is kept.
        """
        arrivals = [
            (_put_ns(arrival), name, "", decode, arrival)
            for name, buffer, decode in self._settings
            for arrival in buffer.drain()
        ]
        arrivals += [
            (_put_ns(arrival), "held", name, settings.decode_held, arrival)
            for name, part in self._parts.items()
            for arrival in part.held.drain()
        ]
        if not arrivals:
            return []
        if all(put_ns is not None for put_ns, *_ in arrivals):
            arrivals.sort(key=itemgetter(0))
        put: list[Setting] = []
        for put_ns, name, part, decode, arrival in arrivals:
            if name in ("stop", "reset"):
                put.append(Setting(name, put_ns=put_ns))
                continue
            value = self._node.decode_text(decode, arrival)
            if value is not None:
                put.append(Setting(name, value, put_ns, part))
        return put

    def _chunk(self, arrival: ReceivedSample) -> Stamped[ActionChunk] | None:
        """A chunk from the source of the worker whose key it came on, None for any other."""
        worker = key_names.last_chunk(str(arrival.sample.key_expr))
        owner = self._peer_monitor.owner(worker)
        try:
            header = header_of(arrival.sample)
            if owner is not None and header.source != owner:  # first: there may be a flood of them
                by, ours = header.source[:60], owner[:60]
                raise CodecError("foreign", f"by {by!r}; the source of this worker is {ours!r}")
        except CodecError as error:
            self._node.reject(error.reason, f"delta/{worker}: {error}")
            return None
        chunk = self._node.decode(ActionChunk, arrival, header=header)
        if chunk is not None and chunk.record.worker != worker:
            self._node.reject("foreign", "chunk on the delta key of another worker")
            return None
        return chunk

    def _check_clock(self) -> list[Setting]:
        if time.monotonic() - self._last_clock < CLOCK_PERIOD_S:
            return []
        self._last_clock = time.monotonic()
        step_s = self._node.clock.adopt_system_time()
        if abs(step_s) <= self._node.profile.timing.max_clock_step_s:
            return []
        self._node.reject("clock_step", f"the wall clock was set by {step_s:+.3f} s")
        return [Setting("lose", f"the wall clock was set by {step_s:+.3f} s")]


class _PartInputs:
    """Subscriptions to the states of one part, and to what it holds."""

    def __init__(self, node: Node, keys: Keys) -> None:
        self._node = node
        self._rings: dict[type[Any], CallbackRing] = {
            kind: node.subscribe(key, CallbackRing(STATES, SMALL_BYTES))
            for kind, key in (
                (PoseState, keys.state_pose),
                (JointState, keys.state_joint),
                (GripperState, keys.state_gripper),
            )
        }
        silence_s = node.profile.timing.state_timeout_s
        self._writers = {kind: SingleWriterFilter(silence_s) for kind in self._rings}
        self.held = node.subscribe(keys.held, ZenohRing(16, WORDS))
        self._last_joint = 0.0

    def poll(self, requested: bool) -> NewStates:
        """The newest states since the last call; `requested`: an activation is to use these
        joints."""
        return NewStates(
            self._state(PoseState),
            joint=self._joints(requested),
            gripper=self._state(GripperState),
        )

    def _state(self, kind: type[Any]) -> Stamped[Any] | None:
        """The newest state from the robot's source, whatever other sources publish."""
        for arrival in reversed(self._rings[kind].drain()):
            found = self._node.decode(kind, arrival, self._writers[kind])
            if found is not None:
                return found
        return None

    def _joints(self, requested: bool) -> Stamped[JointState] | None:
        """The newest joints, at `JOINT_PERIOD_S`: decoding them is expensive."""
        now_s = time.monotonic()
        if not requested and now_s - self._last_joint < JOINT_PERIOD_S:
            return None
        found = self._state(JointState)
        if found is not None:
            self._last_joint = now_s
        return found


def _put_ns(arrival: ReceivedSample) -> int | None:
    """When the router first saw a sample, on its clock."""
    stamp = arrival.sample.timestamp
    return None if stamp is None else round(stamp.get_time().timestamp() * 1e9)
