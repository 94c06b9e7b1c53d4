"""One robot's subscriptions and publishers of a worker."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, Literal

import zenoh

from vla_zenoh.bus.buffers import (
    CallbackRing,
    ReceivedSample,
    Wake,
    ZenohRing,
    bytes_of,
)
from vla_zenoh.bus.metrics import Percentiles, RateMeter
from vla_zenoh.bus.node import Node
from vla_zenoh.bus.stream import Stream
from vla_zenoh.codec import records
from vla_zenoh.codec.image import MAX_IMAGE_BYTES, decode_depth, decode_jpeg, decode_raw
from vla_zenoh.codec.records import SMALL_BYTES
from vla_zenoh.errors import PeerError, PromptError, SpecError, in_words
from vla_zenoh.keys import LOADING, NO_TASK, STARTING, Kind, worker_node
from vla_zenoh.nodes.worker import gpus
from vla_zenoh.policy import ActionSteps, CameraSpec, Observation, Policy, check_steps, reset_of
from vla_zenoh.policy.frozen import FrozenImages
from vla_zenoh.policy.inference import ChunkPrefix, make_chunk
from vla_zenoh.policy.observation import (
    MAX_STATES,
    STATE_KINDS,
    History,
    NotReady,
    Streams,
    assemble,
    size_variant,
    state_names,
)
from vla_zenoh.profile import Profile
from vla_zenoh.types import ActionChunk, Depth, Event, Header, Image, Stamped, Task

SPEC_PERIOD_S = 1.0
TASK_PATIENCE_S = 1.5
AFTER_A_FAILURE_S = 0.5
FRESH_PATIENCE_S = 0.05
FRESH_TOLERANCE_S = 0.005
STREAM_PATIENCE_S = 0.5
"""After this silence of a stream's writer another one is accepted."""
MAX_QUEUE, STATES, TASKS = 96, 256, 64
PATIENCE_S, PERIODS = 1.0, 3
"""Without images on the preferred stream for this long, and for this many periods of a slow camera,
a worker subscribes to the common one as well."""
MAX_COMPLAINT = 500
TOO_LATE = "too_late"


class RobotSession:
    """One robot's side of a worker: its own node, prompt, episode, activation and rate.

    Several may share a `policy`, which is not loaded yet; every image sets `changed`. See
    `vla_zenoh.nodes.worker.node.WorkerNode` for the rest.
    """

    def __init__(
        self,
        profile: Profile,
        session: zenoh.Session,
        policy: Policy,
        name: str,
        *,
        images: Literal["raw", "jpeg"],
        host: str | None,
        changed: Wake,
    ) -> None:
        self.robot = profile.robot.name
        node = self.node = Node(worker_node(name), profile, session, host=host)
        self.policy, self.name, self.spec = policy, name, policy.spec
        self.prefix = ChunkPrefix(policy, profile.timing.max_observation_age_s)
        keys = node.keys
        self._chunks = node.declare_publisher(keys.delta(name), Kind.ORDER)
        self._specs = node.declare_publisher(keys.spec(name), Kind.TELEMETRY)
        node.serve(
            keys.spec(name),
            lambda query: query.reply(keys.spec(self.name), records.encode(self.spec)),
        )
        tasks = CallbackRing(TASKS, SMALL_BYTES)
        self._tasks = Stream(node, keys.task, Task, tasks, TASK_PATIENCE_S)
        streams = self._streams = Streams.of(self.spec.observation, self.spec.parts)
        history_s, jpeg = self.spec.observation.history_span_s, images == "jpeg"
        camera_stream = partial(CameraStream, node, history_s=history_s, changed=changed)
        decode_image = (lambda payload, _: decode_jpeg(payload)) if jpeg else decode_raw
        self._cameras: list[CameraStream] = [
            camera_stream(name, colour_keys(one, node, jpeg=jpeg), kept, Image, decode_image)
            for one, (name, kept) in zip(
                self.spec.observation.cameras, streams.images.items(), strict=True
            )
        ]
        if streams.depth:
            import vla_zenoh.opencv  # rather than at the first depth image  # noqa: F401
        self._cameras += [
            camera_stream(name, [keys.camera_depth(name)], kept, Depth, decode_depth)
            for name, kept in streams.depth.items()
        ]
        self._states: list[tuple[Stream[Any, ZenohRing], History]] = []
        for name, (part, what) in state_names(self.spec.observation, self.spec.parts).items():
            key = getattr(keys.of_part(part), f"state_{what}")
            ring = ZenohRing(MAX_STATES if history_s else STATES, SMALL_BYTES)
            stream = Stream(node, key, STATE_KINDS[what], ring, STREAM_PATIENCE_S)
            self._states.append((stream, streams.states[name]))
        self._frozen, self._repeats = FrozenImages.of(profile.cameras), False
        self.task: Task | None = None
        self._task_received_s = -1e9
        self._episode = -1
        self._not_before_ns = self._episode_ns = 0
        self._rate = RateMeter(window_s=10.0)
        self._inference_ms = Percentiles(128)
        self._batch, self._last_spec_s = 0, -1e9
        self.complaint = LOADING
        """Why there is no inference, or no answer of the last one; empty if there is."""
        self._failure = ""
        self.due_s = 0.0
        """When the next inference is due, monotonic clock."""

    @property
    def has_images(self) -> bool:
        """Whether an image was not polled yet, and every camera has one since the last chunk."""
        new = False
        for camera in self._cameras:
            if camera.has_new:
                new = True
            elif not camera.images.entries or camera.images.newest_ns < self._not_before_ns:
                return False
        return new

    def poll(self) -> None:
        """Decode what was received since the last call."""
        tasks = list(filter(None, map(self._tasks.decode, self._tasks.buffer.drain())))
        for task in tasks:  # all of them: each may have changed the speed override
            self.prefix.set_task(task.record, task.header.stamp_wall_ns)
        if tasks:
            self._set_task(tasks[-1])
        for camera in self._cameras:
            camera.poll()
        self.poll_states()

    def poll_states(self) -> None:
        """Decode the states that were received since the last call."""
        for stream, states in self._states:
            for arrival in stream.buffer.drain():
                state = stream.decode(arrival)
                if state is not None:
                    states.add(state)

    def _set_task(self, task: Stamped[Task]) -> None:
        before, self.task, self._task_received_s = self.task, task.record, time.monotonic()
        if before is not None and before.requested_hz != self.task.requested_hz:
            self.due_s = min(self.due_s, self._task_received_s)
        if self._failure and before is not None and before.prompt != self.task.prompt:
            # That was of the prompt before; this one is tried at once.
            self.complaint = self._failure = ""
            self.due_s = self._task_received_s
        if task.record.episode == self._episode:
            return
        self._episode = task.record.episode
        # An observation from before the episode does not belong to it.
        self._not_before_ns = self._episode_ns = task.header.stamp_wall_ns
        reset = reset_of(self.policy, self.robot)
        if reset is not None:
            try:
                reset()
            except Exception as error:
                self.failed(error, "reset_failed")

    def observe(self) -> Observation | None:
        """Poll and assemble an observation; None if there is none yet.

        Once an inference is due, an image that is about to arrive is worth a short wait: the one at
        hand is half a camera period old on average, which would all be latency.
        """
        self.poll()
        self.node.clock.adopt_system_time()
        if self.task is not None and self.task.requested_hz <= 0.0:
            return None
        if self.task is None or time.monotonic() - self._task_received_s > TASK_PATIENCE_S:
            self.complaint = f"{NO_TASK}: is the command node running?"
            return None
        try:
            observation = assemble(
                self.spec,
                self.task,
                self._streams,
                not_before_ns=self._not_before_ns,
                now_ns=self.node.clock.wall_ns(),
                robot=self.robot,
                episode_ns=self._episode_ns,
            )
        except ValueError as error:
            self.complaint = str(error)
            return None
        if isinstance(observation, NotReady):
            if not observation.waiting:
                self.complaint = observation.why
            return None
        if why := self._frozen.judge(observation):
            if not self._repeats:
                self.node.emit(Event("warning", "fault", "same_image", why[:1000]))
            self._repeats, self.complaint = True, why
            return None
        self._repeats, self.complaint = False, self._failure
        if self._cameras and time.monotonic() - self.due_s < FRESH_PATIENCE_S:
            tolerance_s = min(FRESH_TOLERANCE_S, 0.25 / observation.rate_hz)
            if min(camera.received_s for camera in self._cameras) < self.due_s - tolerance_s:
                return None
        return observation

    def in_time(self, observation: Observation, now_ns: int, takes_s: float) -> bool:
        """Whether the command node would accept the chunk of an inference that begins now (wall
        clock) and takes `takes_s`; the reason is in `complaint` if not."""
        age_s = (now_ns - observation.stamp_wall_ns) / 1e9 + takes_s
        oldest_s = self.node.profile.timing.max_observation_age_s
        if age_s > oldest_s:
            self.complaint = (
                f"{TOO_LATE}: its observation would be {age_s:.2f} s old when the chunk is there; "
                f"timing.max_observation_age_s is {oldest_s:g}"
            )
        return age_s <= oldest_s

    def expects(self, by_s: float) -> bool:
        """Whether it is due by then (monotonic clock), and nothing keeps it from an inference."""
        asks = self.task is not None and self.task.requested_hz > 0.0
        return asks and not self.complaint and self.due_s <= by_s

    def publish(
        self,
        observation: Observation,
        answer: ActionSteps,
        times_ns: tuple[int, int, int],
        batch: int,
    ) -> tuple[Header, ActionChunk] | None:
        """Validate an answer and publish it as a chunk; None: it was rejected and reported.

        `times_ns` (wall clock): observation complete, inference started, inference ended; `batch`:
        robots in this inference.
        """
        try:
            steps, done = check_steps(self.spec.action, answer.steps), bool(answer.done)
        except Exception as error:
            self.failed(error)
            return None
        if self.complaint == self._failure:  # else it comes too late, as is said
            self.complaint = ""
        self._failure = ""
        _, start_ns, end_ns = times_ns
        patience_s = self.node.profile.timing.max_observation_age_s
        chunk = make_chunk(
            *(self.name, self.spec, observation, steps, done),
            patience_s=patience_s,
            times_ns=times_ns,
        )
        header = self._chunks.publish(chunk)
        self._not_before_ns = header.stamp_wall_ns
        self._batch = batch
        self._inference_ms.add((end_ns - start_ns) / 1e6)
        self._rate.tick()
        obeyed = observation.task.active and observation.task.worker == self.name
        self.prefix.published(observation, steps, header.stamp_wall_ns, obeyed=obeyed)
        return header, chunk

    def adopt_spec(self) -> None:
        """Publish the policy's spec after it changed the meaning of its actions.

        Call it before the chunk that follows it. The observation part of the spec must not change.
        """
        self.spec = self.policy.spec
        self._specs.publish(self.spec)

    def failed(self, error: Exception, reason: str = "") -> None:
        """Count and report an inference that failed; the next one is due a little later.

        A prompt that was meant for another worker is only what `complaint` says.
        """
        if not reason and isinstance(error, PeerError):
            reason = error.reason
        elif not reason:
            reason = "contract" if isinstance(error, SpecError) else "inference_failed"
        why = in_words(error)
        self.complaint = self._failure = f"{reason}: {why}"
        chosen = self.task is None or self.task.worker == self.name
        if chosen or not isinstance(error, PromptError):
            self.node.reject(reason, why)
        self.due_s = time.monotonic() + AFTER_A_FAILURE_S

    def report(self, *, now: bool = False) -> None:
        """Publish spec and status when they are due, or `now`."""
        if now or time.monotonic() - self._last_spec_s > SPEC_PERIOD_S:
            self._last_spec_s = time.monotonic()
            self._specs.publish(self.spec)
        state = "waiting" if self.complaint else "inferring"
        if self.complaint == LOADING:
            state = STARTING
        if not now and not self.node.status_due(state):
            return
        task = self.task
        inference = self._inference_ms.summary()
        self.node.publish_status(
            state,
            detail={
                "complaint": self.complaint[:MAX_COMPLAINT].encode("utf-8", "replace").decode(),
                "spec": self.spec.hash,
                "episode": self._episode,
                "prompt": task.prompt if task else "",
                "obeyed": bool(task and task.active and task.worker == self.name),
                "batch": self._batch,
                **gpus.figures(),
            },
            rates_hz={"chunks": self._rate.rate_hz},
            latency_ms={"inference": inference} if inference else {},
            now=now,
        )

    def close(self) -> None:
        """Report ``ended`` and close the node."""
        self.node.publish_end()
        self.node.close()


ImageStream = Stream[Any, CallbackRing]


class CameraStream:
    """One camera's colour or depth images, from its subscriber to the `images` that are kept.

    It subscribes to the first of `keys`, the preferred one, and while that is silent to the second,
    the common one, as well. The newest image waits for `poll`; where those `history_s` older are
    needed, all of one inference do. Each sets `changed`.

    Raises:
        SessionError: the router does not answer at the port for images.
    """

    def __init__(
        self,
        node: Node,
        camera: str,
        keys: Sequence[str],
        images: History,
        kind: type[Any],
        decode: Callable[[bytes, str], Any],
        *,
        history_s: float,
        changed: Wake,
    ) -> None:
        self._node, self.camera, self._keys, self._changed = node, camera, keys, changed
        self.images, self._kind, self._decode = images, kind, decode
        self._queue, self._patience_s = 1, PATIENCE_S
        settings = node.profile.cameras.get(camera)
        if settings is not None:
            slowest_hz = min(settings.rate_hz, settings.jpeg_rate_hz or settings.rate_hz)
            self._patience_s = max(PATIENCE_S, PERIODS / slowest_hz)
            if history_s:
                count = 1 + math.ceil((history_s + PATIENCE_S) * settings.rate_hz)
                self._queue = min(MAX_QUEUE, count)
        self.received_s = 0.0
        """When the newest of `images` arrived, monotonic clock; 0: there is none."""
        self._preferred = self._subscribe(keys[0])
        self._fallback: ImageStream | None = None
        self._preferred_s = time.monotonic()

    @property
    def has_new(self) -> bool:
        """Whether there is an image that was not polled yet."""
        return self._preferred.buffer.has_new or (
            self._fallback is not None and self._fallback.buffer.has_new
        )

    def poll(self) -> None:
        """Decode the newest image; with a history all that are queued."""
        while (received := self._pop()) is not None:
            self._receive(*received)
            if self._queue == 1:
                break

    def _pop(self) -> tuple[ReceivedSample, ImageStream] | None:
        source = self._preferred
        arrival = source.buffer.pop()
        if arrival is not None:
            self._preferred_s = time.monotonic()
            if self._fallback is not None:
                self._fallback.close()
                self._fallback = None
                why = f"there are images on {self._node.keys.short(self._keys[0])} again"
                self._node.emit(Event("info", "notice", f"{self.camera}:own_pictures", why))
        elif self._fallback is not None:
            source = self._fallback
            arrival = source.buffer.pop()
        elif len(self._keys) > 1 and time.monotonic() - self._preferred_s >= self._patience_s:
            self._fallback = self._subscribe(self._keys[1])
            preferred, common = map(self._node.keys.short, self._keys)
            why = f"no image on {preferred} for {self._patience_s:g} s; subscribing to {common}"
            self._node.emit(
                Event("warning", "notice", f"{self.camera}:plain_pictures", f"{why} as well")
            )
        return None if arrival is None else (arrival, source)

    def _subscribe(self, key: str) -> ImageStream:
        ring = CallbackRing(self._queue, MAX_IMAGE_BYTES, self._changed)
        return Stream(
            self._node,
            key,
            self._kind,
            ring,
            STREAM_PATIENCE_S,
            quality=Kind.FRAME,
            read=self._read,
        )

    def _read(self, sample: zenoh.Sample) -> Any:
        payload = bytes_of(sample.payload, MAX_IMAGE_BYTES)
        return self._decode(payload, str(sample.encoding).partition(";")[2])

    def _receive(self, arrival: ReceivedSample, source: ImageStream) -> None:
        image = source.decode(arrival)
        if image is not None:
            self.images.add(image)
            self.received_s = arrival.mono_ns / 1e9


def colour_keys(spec: CameraSpec, node: Node, *, jpeg: bool) -> list[str]:
    """The key that suits a model: raw, JPEG, or JPEG in its input size and then the common one."""
    keys, name = node.keys, spec.camera
    settings, size = node.profile.cameras.get(name), size_variant(spec)
    if not jpeg:
        return [keys.camera_raw(name)]
    if settings is None or not settings.fit_for_workers or size is None:
        return [keys.camera_jpeg(name)]
    return [keys.camera_fitted(name, size), keys.camera_jpeg(name)]
