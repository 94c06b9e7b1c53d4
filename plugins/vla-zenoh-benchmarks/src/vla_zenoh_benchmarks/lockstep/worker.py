"""Worker in lockstep."""

from __future__ import annotations

import random
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

from vla_zenoh.control.commander_io import MotionCommands
from vla_zenoh.keys import worker_node
from vla_zenoh.policy import Policy, check_steps, reset_of
from vla_zenoh.policy.frozen import FrozenImages
from vla_zenoh.policy.inference import ChunkPrefix, make_chunk
from vla_zenoh.policy.observation import STATE_KINDS, NotReady, Streams, assemble, state_names
from vla_zenoh.profile import Profile
from vla_zenoh.types import (
    ActionChunk,
    Depth,
    FloatArray,
    Header,
    JointCommand,
    PoseCommand,
    Stamped,
    Task,
)


@dataclass(frozen=True, slots=True)
class Delays:
    """Latencies of a lockstep run.

    Args:
        inference_s: from observation to chunk.
        jitter: share by which an inference varies.
        camera_s: from capture to the worker.
        wire_s: of every other message.
    """

    inference_s: float = 0.0
    jitter: float = 0.0
    camera_s: float = 0.0
    camera_hz: float = 30.0
    wire_s: float = 0.0


@dataclass(frozen=True, slots=True)
class Message:
    """One message on the wire.

    Args:
        header: of the writer.
        arrival_ns: virtual time of arrival.
        part: whose state or command it is, of a robot of several parts.
        camera: whose image it is.
        encoding: of an image, as `codec.image` has it.
    """

    kind: type[Any]
    header: Header
    payload: bytes
    arrival_ns: int
    part: str = ""
    camera: str = ""
    encoding: str = ""


Tamper = Callable[[Message], Iterable[Message]]
"""Replaces a message by any number of messages."""


@dataclass(slots=True)
class LockstepTrace:
    """Commanded and measured motion, one entry per command tick.

    Args:
        time_ns: (n,) virtual wall clock.
        commands: pose commands; None: no stream.
        joints: joint commands; None: no stream.
        position_m: measured TCP, (3,) each.
        rotation: measured TCP, (3, 3) each.
        width_m: measured gripper width.
        parts: commands to each part, of a robot of several; what is above is of the first part.
    """

    time_ns: list[int] = field(default_factory=list)
    commands: list[PoseCommand | None] = field(default_factory=list)
    joints: list[JointCommand | None] = field(default_factory=list)
    position_m: list[FloatArray] = field(default_factory=list)
    rotation: list[FloatArray] = field(default_factory=list)
    width_m: list[float] = field(default_factory=list)
    parts: list[Mapping[str, MotionCommands]] = field(default_factory=list)


class LockstepWorker:
    """Worker in lockstep: one inference at a time, at the task's rate."""

    def __init__(
        self, profile: Profile, name: str, policy: Policy, delays: Delays, jitter: random.Random
    ) -> None:
        self.name = name
        self.source = worker_node(name)
        self.policy, self.spec = policy, policy.spec
        self.task: Task | None = None
        self._patience_s = profile.timing.max_observation_age_s
        self._continuation = ChunkPrefix(policy, self._patience_s)
        self._delays, self._jitter = delays, jitter
        self._streams = Streams.of(self.spec.observation, self.spec.parts)
        self._frozen = FrozenImages.of(profile.cameras)
        self.complaint = ""
        """Why its newest observation was not used; empty: it was."""
        names = state_names(self.spec.observation, self.spec.parts)
        self._names = {(part, what): name for name, (part, what) in names.items()}
        self._not_before_ns = self._due_ns = self._asked_ns = self._episode_ns = 0
        load = getattr(policy, "load", None)
        if callable(load):
            load()

    def take_task(self, task: Stamped[Task]) -> None:
        known, self.task = self.task, task.record
        self._continuation.set_task(task.record, task.header.stamp_wall_ns)
        if known is not None and known.requested_hz != self.task.requested_hz:
            self._due_ns = min(self._due_ns, self._asked_ns)
        if known is None or known.episode != self.task.episode:
            self._not_before_ns = self._episode_ns = task.header.stamp_wall_ns
            reset = reset_of(self.policy)
            if reset is not None:
                reset()

    def take_state(self, state: Stamped[Any], part: str = "") -> None:
        """Receive a state of a part of the robot; kept if the model's spec lists it."""
        for (of_part, what), name in self._names.items():
            if of_part == part and isinstance(state.record, STATE_KINDS[what]):
                self._streams.states[name].add(state)

    def take_picture(self, camera: str, picture: Stamped[Any]) -> None:
        """Receive an image or a depth picture; kept if the model's spec lists it."""
        depth = isinstance(picture.record, Depth)
        streams: Any = self._streams.depth if depth else self._streams.images
        if camera in streams:
            streams[camera].add(picture)

    def step(self, now_ns: int, wall_ns: int) -> ActionChunk | None:
        """Infer if a request is due and an observation is complete.

        Args:
            wall_ns: this worker's wall clock.
        """
        self._asked_ns = now_ns
        if self.task is None or now_ns < self._due_ns or wall_ns < self._not_before_ns:
            return None
        if self.task.requested_hz <= 0.0:
            return None
        observation = assemble(
            self.spec,
            self.task,
            self._streams,
            not_before_ns=self._not_before_ns,
            now_ns=wall_ns,
            episode_ns=self._episode_ns,
        )
        if isinstance(observation, NotReady):
            return None
        self.complaint = self._frozen.judge(observation)
        if self.complaint:
            return None
        answer = self._continuation.infer(observation)
        steps = check_steps(self.spec.action, answer.steps)
        share = 1.0 + self._delays.jitter * self._jitter.uniform(-1.0, 1.0)
        duration_ns = round(self._delays.inference_s * share * 1e9)
        # One inference at a time; missed periods are not made up for.
        period_ns = round(1e9 / self.task.requested_hz)
        self._due_ns = max(self._due_ns + period_ns, now_ns + duration_ns)
        self._not_before_ns = wall_ns + duration_ns
        obeyed = self.task.active and self.task.worker == self.name
        self._continuation.published(observation, steps, self._not_before_ns, obeyed=obeyed)
        return make_chunk(
            *(self.name, self.spec, observation, steps, answer.done),
            patience_s=self._patience_s,
            times_ns=(wall_ns, wall_ns, wall_ns + duration_ns),
        )
