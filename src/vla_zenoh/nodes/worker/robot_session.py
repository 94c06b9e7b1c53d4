"""One robot's side of a worker: what is heard of it, and what is said to it.

A worker has a seat for every robot it serves. Each has its own node on the robot's keys, and its
own prompt, episode, activation and rate.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Mapping
from typing import Any, Literal

import zenoh

from vla_zenoh.bus.buffers import CallbackRing, LatestSample, bytes_of
from vla_zenoh.bus.metrics import Percentiles, RateMeter
from vla_zenoh.bus.node import Node
from vla_zenoh.codec import image as image_codec
from vla_zenoh.codec import records
from vla_zenoh.codec.image import MAX_IMAGE_BYTES
from vla_zenoh.codec.records import SMALL_BYTES
from vla_zenoh.errors import CodecError, PeerError, SpecError
from vla_zenoh.keys import Kind, worker_node
from vla_zenoh.nodes.worker.camera_subscriber import (
    STREAM_PATIENCE_S,
    ReceivedImage,
    subscribe_to_camera,
)
from vla_zenoh.nodes.worker.inference_debug import InferenceDebugPublisher
from vla_zenoh.policy import ActionSteps, Observation, Policy, check_steps, reset_of
from vla_zenoh.policy.chunk_prefix import ChunkPrefix
from vla_zenoh.policy.observation import History, NotReady, assemble, make_chunk
from vla_zenoh.profile import Profile
from vla_zenoh.types import (
    GripperState,
    Image,
    JointState,
    PoseState,
    Stamped,
    Task,
)
from vla_zenoh.types.stream import SingleWriterFilter

SPEC_PERIOD_S = 1.0
TASK_PATIENCE_S = 1.5
AFTER_A_FAILURE_S = 0.5
FRESH_PATIENCE_S = 0.05
FRESH_TOLERANCE_S = 0.005
MAX_COMPLAINT = 500
STATE_KINDS: dict[str, type[Any]] = {
    "joint": JointState,
    "pose": PoseState,
    "gripper": GripperState,
}


class RobotSession:
    """See the module.

    Args:
        profile: the robot's: its name, cameras, timing.
        session: open session.
        policy: the model, not loaded yet; several seats may share it.
        name: of the worker.
        images: which form of pictures to listen to.
        host: of the profile, on which this runs: some have a say in what travels there.
        changed: is notified when a picture arrives.
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
        changed: threading.Condition,
    ) -> None:
        self.robot = profile.robot.name
        node = self.node = Node(worker_node(name), profile, session, host=host)
        self.policy, self.name, self.spec = policy, name, policy.spec
        self.continuation = ChunkPrefix(policy)
        keys = node.keys
        self._chunk_out = node.declare_publisher(keys.delta(name), Kind.ORDER)
        self._spec_out = node.declare_publisher(keys.spec(name), Kind.TELEMETRY)
        self._seen = InferenceDebugPublisher(node, name, self.spec)
        node.serve(
            keys.spec(name),
            lambda query: query.reply(keys.spec(name), records.encode(self.spec)),
        )
        self._task_slot = node.subscribe(keys.task, LatestSample(SMALL_BYTES))
        self._jpeg = images == "jpeg"
        self._cameras = {
            one.camera: subscribe_to_camera(one, node, jpeg=self._jpeg, host=host, changed=changed)
            for one in self.spec.observation.cameras
        }
        self._state_slots = {
            part: node.subscribe(self._state_key(part), CallbackRing(256, SMALL_BYTES))
            for part in self.spec.observation.state
        }
        self._task_speaker = SingleWriterFilter(TASK_PATIENCE_S)
        self._speakers = {part: SingleWriterFilter(STREAM_PATIENCE_S) for part in self._state_slots}
        self._images: dict[str, Stamped[Image]] = {}
        self._pictures_s: dict[str, float] = {}
        self._states = {part: History() for part in self.spec.observation.state}
        self.task: Task | None = None
        self._task_heard_s = -1e9
        self._episode = -1
        self._not_before_ns = 0
        self._rate = RateMeter(window_s=10.0)
        self._inference_ms = Percentiles(128)
        self._batch = 0
        self._last_spec_s = -1e9
        self.complaint = "loading"
        self.due_s = 0.0
        """When the next inference is wanted, monotonic clock."""

    def _state_key(self, part: str) -> str:
        keys = self.node.keys
        return {"joint": keys.state_joint, "pose": keys.state_pose, "gripper": keys.state_gripper}[
            part
        ]

    # -- in -----------------------------------------------------------------------------------
    @property
    def news(self) -> bool:
        """Whether the slowest input has something that was not looked at."""
        slowest = next(iter(self._cameras.values()), None)
        return slowest is not None and slowest.full

    @property
    def sees(self) -> bool:
        """Whether the model wants pictures."""
        return bool(self._cameras)

    def listen(self) -> None:
        """Take in what came."""
        arrival = self._task_slot.pop()
        if arrival is not None:
            task = self.node.decode(Task, arrival, self._task_speaker)
            if task is not None:
                self._take_task(task)
        for name, camera in self._cameras.items():
            heard = camera.take()
            image = self._read_image(name, heard) if heard is not None else None
            if heard is not None and image is not None:
                self._images[name] = image
                self._pictures_s[name] = heard.arrival.mono_ns / 1e9
        self.listen_to_states()

    def listen_to_states(self) -> None:
        """Take in states; while nothing else is to do it costs no time afterwards."""
        for part, inbox in self._state_slots.items():
            for arrival in inbox.drain():
                state = self.node.decode(STATE_KINDS[part], arrival, self._speakers[part])
                if state is not None:
                    self._states[part].add(state)

    def _take_task(self, task: Stamped[Task]) -> None:
        before, self.task, self._task_heard_s = self.task, task.record, time.monotonic()
        if before is not None and before.requested_hz != self.task.requested_hz:
            self.due_s = min(self.due_s, self._task_heard_s)
        if task.record.episode == self._episode:
            return
        self._episode = task.record.episode
        # What was seen before the episode began does not belong to it.
        self._not_before_ns = task.header.stamp_wall_ns
        reset = reset_of(self.policy, self.robot)
        if reset is not None:
            try:
                reset()
            except Exception as error:
                self.failed(error, "reset_failed")

    def _read_image(self, camera: str, heard: ReceivedImage) -> Stamped[Image] | None:
        arrival, speaker = heard
        sample = arrival.sample
        try:
            header = self.node.header(arrival)
            speaker.check(header, arrival.mono_ns)
            payload = bytes_of(sample.payload, MAX_IMAGE_BYTES)
            if self._jpeg:
                image = image_codec.decode_jpeg(payload)
            else:
                _, _, schema = str(sample.encoding).partition(";")
                image = image_codec.decode_raw(payload, schema)
        except CodecError as error:
            self.node.reject(error.reason, f"camera {camera}: {error}")
            return None
        speaker.heard(header, arrival.mono_ns)
        self.node.traffic.received(str(sample.key_expr), header, arrival.nth)
        header, image = self.node.clocks.to_local_clock(header, image)
        return Stamped(header, image, self.node.arrival_wall_ns(arrival))

    def observe(self) -> Observation | None:
        """An observation, None when there is none yet.

        A picture that arrives after the request is due is worth a little patience: the one at hand
        is already half a camera period old on average, and all that time would be latency.
        """
        self.listen()
        self.node.clock.adopt_system_time()
        if self.task is not None and self.task.requested_hz <= 0.0:
            return None
        if self.task is None or time.monotonic() - self._task_heard_s > TASK_PATIENCE_S:
            self.complaint = "no command node is heard"
            return None
        try:
            observation = assemble(
                self.spec,
                self.task,
                self._images,
                self._states,
                not_before_ns=self._not_before_ns,
                now_ns=self.node.clock.wall_ns(),
                robot=self.robot,
            )
        except ValueError as error:
            self.complaint = str(error)
            return None
        if isinstance(observation, NotReady):
            if not observation.waiting:
                self.complaint = observation.why
            return None
        self.complaint = ""
        if self._pictures_s and time.monotonic() - self.due_s < FRESH_PATIENCE_S:
            tolerance_s = min(FRESH_TOLERANCE_S, 0.25 / observation.rate_hz)
            if min(self._pictures_s.values()) < self.due_s - tolerance_s:
                return None
        return observation

    # -- out ----------------------------------------------------------------------------------
    def publish(
        self,
        observation: Observation,
        answer: ActionSteps,
        observed_ns: int,
        start_ns: int,
        end_ns: int,
        batch: int,
    ) -> bool:
        """Check an answer and send it.

        Args:
            observation: what it was made of.
            answer: the model's.
            observed_ns: when the observation was at hand, wall clock.
            start_ns: when inference began.
            end_ns: when it ended.
            batch: robots that were answered together.
        """
        try:
            steps, done = check_steps(self.spec.action, answer.steps), bool(answer.done)
        except Exception as error:
            return self.failed(error)
        self._batch = batch
        self._inference_ms.add((end_ns - start_ns) / 1e6)
        chunk = make_chunk(
            self.name,
            self.spec,
            observation,
            ActionSteps(steps, done),
            patience_s=self.node.profile.timing.max_observation_age_s,
            observed_ns=observed_ns,
            start_ns=start_ns,
            end_ns=end_ns,
        )
        header = self._chunk_out.publish(chunk)
        self._not_before_ns = header.stamp_wall_ns
        self._rate.tick()
        obeyed = observation.task.active and observation.task.worker == self.name
        self.continuation.published(observation, steps, header.stamp_wall_ns, obeyed=obeyed)
        self._seen.show(observation, answer, steps, header, (end_ns - start_ns) / 1e6)
        return True

    def failed(self, error: Exception, reason: str = "") -> Literal[False]:
        """Count and tell that the model gave no answer, and ask it again a little later."""
        if not reason:
            if isinstance(error, SpecError):
                reason = "contract"
            else:  # a PeerError says by itself what it is
                reason = error.reason if isinstance(error, PeerError) else "inference_failed"
        expected = isinstance(error, (SpecError, PeerError))
        why = str(error) if expected else f"{type(error).__name__}: {error}"
        self.complaint = f"{reason}: {why}"
        self.node.reject(reason, why)
        self.due_s = time.monotonic() + AFTER_A_FAILURE_S
        return False

    def report(self, *, now: bool = False) -> None:
        """Tell spec and status when it is time, or `now`."""
        if now or time.monotonic() - self._last_spec_s > SPEC_PERIOD_S:
            self._last_spec_s = time.monotonic()
            self._spec_out.publish(self.spec)
        state = "waiting" if self.complaint else "inferring"
        if not now and not self.node.status_due(state):
            return
        task = self.task
        inference = self._inference_ms.summary()
        detail: Mapping[str, Any] = {
            "complaint": self.complaint[:MAX_COMPLAINT].encode("utf-8", "replace").decode(),
            "spec": self.spec.hash,
            "episode": self._episode,
            "prompt": task.prompt if task else "",
            "obeyed": bool(task and task.active and task.worker == self.name),
            "batch": self._batch,
        }
        self.node.publish_status(
            state,
            detail=detail,
            rates_hz={"chunks": self._rate.rate_hz},
            latency_ms={"inference": inference} if inference else {},
            now=now,
        )

    def close(self) -> None:
        """Say goodbye to the robot."""
        self.node.publish_status("stopped", now=True)
        self.node.close()
