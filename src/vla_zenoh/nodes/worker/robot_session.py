"""One robot's subscriptions and publishers of a worker."""

from __future__ import annotations

import time
from typing import Any, Literal

import numpy as np
import zenoh
from numpy.typing import NDArray

from vla_zenoh.bus.buffers import LatestSample, Wake, bytes_of, header_of
from vla_zenoh.bus.metrics import Percentiles, RateMeter
from vla_zenoh.bus.node import Node
from vla_zenoh.codec import records
from vla_zenoh.codec.image import (
    MAX_IMAGE_BYTES,
    decode_depth,
    decode_jpeg,
    decode_raw,
    depth_schema,
    encode_depth,
    encode_jpeg,
)
from vla_zenoh.codec.records import SMALL_BYTES
from vla_zenoh.errors import CodecError, PeerError, RecordError, SpecError, in_words
from vla_zenoh.keys import Kind, worker_node
from vla_zenoh.nodes.worker.streams import (
    CameraSubscriber,
    Feed,
    ReceivedImage,
    StateStream,
    subscribe_to_camera,
)
from vla_zenoh.policy import ActionSteps, ModelSpec, Observation, Policy, check_steps, reset_of
from vla_zenoh.policy.inference import ChunkPrefix, make_chunk
from vla_zenoh.policy.observation import (
    MAX_STATES,
    STATE_KINDS,
    NotReady,
    Streams,
    assemble,
    state_names,
)
from vla_zenoh.profile import Profile
from vla_zenoh.types import Depth, Header, Image, InferenceDebug, SingleWriterFilter, Stamped, Task
from vla_zenoh.types.records import plain_values

SPEC_PERIOD_S = 1.0
TASK_PATIENCE_S = 1.5
AFTER_A_FAILURE_S = 0.5
FRESH_PATIENCE_S = 0.05
SILENT_S = 0.5
FRESH_TOLERANCE_S = 0.005
MAX_COMPLAINT = 500
SEEN_QUALITY = 95
"""Of the JPEG images a model was given."""


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
        self.prefix = ChunkPrefix(policy)
        keys = node.keys
        self._chunks = node.declare_publisher(keys.delta(name), Kind.ORDER)
        self._specs = node.declare_publisher(keys.spec(name), Kind.TELEMETRY)
        self._debug = InferenceDebugPublisher(node, name, self.spec)
        node.serve(
            keys.spec(name), lambda query: query.reply(keys.spec(name), records.encode(self.spec))
        )
        self._tasks = node.subscribe(keys.task, LatestSample(SMALL_BYTES))
        history_s = self._history_s = self.spec.observation.history_span_s
        jpeg = images == "jpeg"
        self._streams = Streams.of(self.spec.observation, self.spec.parts)
        cameras = {
            one.camera: subscribe_to_camera(
                one, node, jpeg=jpeg, changed=changed, history_s=history_s
            )
            for one in self.spec.observation.cameras
        }
        depths = {
            one.camera: CameraSubscriber(
                *(node, one.camera, keys.camera_depth(one.camera)),
                changed=changed,
                history_s=history_s,
            )
            for one in self.spec.observation.depth
        }
        decode_image = (lambda data, _: decode_jpeg(data)) if jpeg else decode_raw
        self._feeds = [
            Feed(name, camera, streams[name], decode)
            for subscribers, streams, decode in (
                (cameras, self._streams.images, decode_image),
                (depths, self._streams.depth, decode_depth),
            )
            for name, camera in subscribers.items()
        ]
        self._every_state = bool(history_s) or not self._feeds
        self._states = [
            StateStream(
                node,
                getattr(keys.of_part(part), f"state_{what}"),
                STATE_KINDS[what],
                self._streams.states[name],
                MAX_STATES if history_s else 256,
                every=self._every_state,
            )
            for name, (part, what) in state_names(self.spec.observation, self.spec.parts).items()
        ]
        self._task_writer = SingleWriterFilter(TASK_PATIENCE_S)
        self._received_s: dict[CameraSubscriber, float] = {}
        self.task: Task | None = None
        self._task_received_s = -1e9
        self._episode = -1
        self._not_before_ns = self._episode_ns = 0
        self._rate = RateMeter(window_s=10.0)
        self._inference_ms = Percentiles(128)
        self._batch, self._last_spec_s = 0, -1e9
        self.complaint = "loading"
        """Why there is no inference; empty if there is."""
        self.due_s = 0.0
        """When the next inference is due, monotonic clock."""

    @property
    def has_images(self) -> bool:
        """Whether an image was not polled yet, and every camera has one since the last chunk."""
        new = False
        for feed in self._feeds:
            if feed.camera.has_new:
                new = True
            elif not feed.images.entries or feed.images.newest_ns < self._not_before_ns:
                return False
        return new

    @property
    def needs_images(self) -> bool:
        """Whether the model observes any camera."""
        return bool(self._feeds)

    @property
    def cameras_silent(self) -> bool:
        """Whether no image came lately: none is expected in the next moment."""
        return time.monotonic() - max(self._received_s.values(), default=0.0) > SILENT_S

    def poll(self) -> None:
        """Decode what was received since the last call."""
        arrival = self._tasks.pop()
        if arrival is not None:
            task = self.node.decode(Task, arrival, self._task_writer)
            if task is not None:
                self._set_task(task)
        for feed in self._feeds:
            # Without a history there is one, the newest.
            while (received := feed.camera.pop()) is not None:
                self._receive(feed, received)
                if not self._history_s:
                    break
        self.poll_states()

    def poll_states(self) -> None:
        """Decode the states received since the last call, unless the cameras fell silent."""
        known = all(states.entries for states in self._streams.states.values())
        if known and not self._every_state and self._received_s and self.cameras_silent:
            return  # those near the next image are in their rings when it comes
        since_ns = min((feed.images.newest_ns for feed in self._feeds), default=0)
        for stream in self._states:
            stream.poll(since_ns)

    def _set_task(self, task: Stamped[Task]) -> None:
        before, self.task, self._task_received_s = self.task, task.record, time.monotonic()
        if before is not None and before.requested_hz != self.task.requested_hz:
            self.due_s = min(self.due_s, self._task_received_s)
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

    def _receive(self, feed: Feed, received: ReceivedImage) -> None:
        (arrival, writer, key), node = received, self.node
        sample, mono_ns = arrival.sample, arrival.mono_ns
        try:
            header = header_of(sample)
            writer.check(header, mono_ns)
            payload = bytes_of(sample.payload, MAX_IMAGE_BYTES)
            image = feed.decode(payload, str(sample.encoding).partition(";")[2])
        except CodecError as error:
            node.reject(error.reason, f"camera {feed.name}: {error}")
            return
        writer.accept(header, mono_ns)
        node.traffic.received(key, header, arrival.nth)
        header, image = node.clocks.to_local_clock(header, image)
        feed.images.add(Stamped(header, image, node.clock.wall_at(arrival.mono_ns)))
        self._received_s[feed.camera] = mono_ns / 1e9

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
            self.complaint = "no task received: is the command node running?"
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
        self.complaint = ""
        if self._received_s and time.monotonic() - self.due_s < FRESH_PATIENCE_S:
            tolerance_s = min(FRESH_TOLERANCE_S, 0.25 / observation.rate_hz)
            if min(self._received_s.values()) < self.due_s - tolerance_s:
                return None
        return observation

    def publish(
        self,
        observation: Observation,
        answer: ActionSteps,
        times_ns: tuple[int, int, int],
        batch: int,
    ) -> None:
        """Validate an answer and publish it as a chunk, or report why it was rejected.

        `times_ns` (wall clock): observation complete, inference started, inference ended; `batch`:
        robots in this inference.
        """
        try:
            steps, done = check_steps(self.spec.action, answer.steps), bool(answer.done)
        except Exception as error:
            self.failed(error)
            return
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
        self._debug.publish(observation, answer, steps, header, (end_ns - start_ns) / 1e6)

    def adopt_spec(self) -> None:
        """Publish the policy's spec after it changed the meaning of its actions.

        Call it before the chunk that follows it. The observation part of the spec must not change.
        """
        self.spec = self.policy.spec
        self._specs.publish(self.spec)

    def failed(self, error: Exception, reason: str = "") -> None:
        """Count and report an inference that failed; the next one is due a little later."""
        if not reason and isinstance(error, PeerError):
            reason = error.reason
        elif not reason:
            reason = "contract" if isinstance(error, SpecError) else "inference_failed"
        why = in_words(error)
        self.complaint = f"{reason}: {why}"
        self.node.reject(reason, why)
        self.due_s = time.monotonic() + AFTER_A_FAILURE_S

    def report(self, *, now: bool = False) -> None:
        """Publish spec and status when they are due, or `now`."""
        if now or time.monotonic() - self._last_spec_s > SPEC_PERIOD_S:
            self._last_spec_s = time.monotonic()
            self._specs.publish(self.spec)
        state = "waiting" if self.complaint else "inferring"
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
            },
            rates_hz={"chunks": self._rate.rate_hz},
            latency_ms={"inference": inference} if inference else {},
            now=now,
        )

    def close(self) -> None:
        """Report ``stopped`` and close the node."""
        self.node.publish_status("stopped", now=True)
        self.node.close()


class InferenceDebugPublisher:
    """Publishes observation and answer of each inference, while there are subscribers.

    It runs after the chunk was published, so it never delays one.
    """

    def __init__(self, node: Node, worker: str, spec: ModelSpec) -> None:
        self._node, self._worker, self._spec = node, worker, spec
        keys, observed = node.keys, spec.observation
        # One priority for all: the images arrive before the record.
        self._record = node.declare_publisher(keys.seen_record(worker), Kind.FRAME)
        self._images = [
            (encode, one, node.declare_publisher(key(worker, one.camera), Kind.FRAME))
            for cameras, key, encode in (
                (observed.cameras, keys.seen, _seen_image),
                (observed.depth, keys.seen_depth, _seen_depth),
            )
            for one in cameras
        ]

    def publish(
        self,
        observation: Observation,
        answer: ActionSteps,
        steps: NDArray[np.float32],
        chunk: Header,
        inference_ms: float,
    ) -> None:
        """Publish one inference: its validated steps (H, D), and the header of its chunk."""
        stamp_ns, seq = observation.stamp_wall_ns, chunk.seq
        try:
            for encode, camera, stream in self._images:
                if stream.has_subscribers:
                    payload, encoding = encode(camera, observation, answer)
                    stream.publish(payload, stamp_wall_ns=stamp_ns, seq=seq, encoding=encoding)
            if self._record.has_subscribers:
                seen = InferenceDebug(
                    *(self._worker, seq, self._spec.hash, observation.task.episode, stamp_ns),
                    *(observation.prompt, steps, inference_ms),
                    plain_values(answer.raw),
                    bool(answer.done),
                )
                self._record.publish(seen, stamp_wall_ns=stamp_ns, seq=seq)
        except (RecordError, CodecError) as error:
            self._node.reject("seen", f"the inference cannot be published: {error}")


def _seen_image(
    camera: Any, observation: Observation, answer: ActionSteps
) -> tuple[bytes, zenoh.Encoding]:
    rgb = (answer.pictures or {}).get(camera.camera)
    if rgb is None:
        rgb = observation.images[camera.camera]
        rgb = np.ascontiguousarray(rgb[..., ::-1]) if camera.colour == "bgr" else rgb
    return encode_jpeg(Image(np.asarray(rgb)), SEEN_QUALITY), zenoh.Encoding.IMAGE_JPEG


def _seen_depth(
    camera: Any, observation: Observation, _: ActionSteps
) -> tuple[bytes, zenoh.Encoding]:
    depth = Depth(observation.depth[camera.camera], camera.unit_m)
    encoding = zenoh.Encoding.IMAGE_PNG.with_schema(depth_schema(depth))
    return encode_depth(depth), encoding
