"""The worker node: newest coherent observation in, action chunk out, at the task's rate.

Inference never runs in a Zenoh callback and nothing is queued: each inference uses the newest
observation captured after the worker's last chunk was published. A worker infers whether or not the
command node follows it, so that it can be inspected and compared before it gets the arm.
"""

from __future__ import annotations

import itertools
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from typing import Any, Literal

import numpy as np
import zenoh

from vla_zenoh.bus.buffers import Wake
from vla_zenoh.bus.node import Node
from vla_zenoh.codec.image import depth_schema, encode_depth, encode_jpeg
from vla_zenoh.errors import SpecError, WorkerError, in_words
from vla_zenoh.keys import Kind
from vla_zenoh.nodes.worker.robot_session import RobotSession
from vla_zenoh.policy import ActionSteps, ModelSpec, Observation, Policy, reset_of, takes_robot
from vla_zenoh.profile import Profile, as_robot
from vla_zenoh.types import ActionChunk, Depth, Event, Header, Image, InferenceDebug
from vla_zenoh.types.records import plain_values

POLL_PERIOD_S = 0.25
NAP_S, NAPS = 0.004, 5
BLIND_NAP_S, IDLE_NAP_S = 0.002, 0.02
SEEN_QUALITY = 95
"""Of the JPEG images a model was given."""
SHARE_OF_AGE = 0.8
"""Of the age at which a chunk is rejected, the part that an inference for several robots may take;
the rest is for images, the network and robots that are a little behind."""

Ready = tuple[RobotSession, Observation, int]
"""A robot, its observation, and when that was complete (wall ns)."""


class WorkerNode:
    """Runs one model for one robot or several of a kind, each with a `RobotSession`.

    A model with ``infer_batch`` infers for all robots that are ready at once; it does not wait for
    the others. A robot whose chunk would come too late to be obeyed waits for an idle moment, and
    where an inference for all would make every chunk too late, it is for fewer at a time.

    Args:
        profile, session: of the robots; the caller closes the session.
        policy: the model, not loaded yet.
        name: of the worker.
        images: image streams to subscribe to. Within a host raw images travel through shared
            memory and cost least; between hosts JPEG is a tenth of the bytes.
        host: of the profile, on which this runs.
        delay_s: added to every inference, to emulate a slower computer.
        robots: names of the robots to serve; empty: the profile's.
        another: constructs the model again for every further robot, if it cannot batch.

    Raises:
        NodeError: a worker of this name already serves one of the robots.
        WorkerError: the model cannot serve several robots; says why.
    """

    def __init__(
        self,
        profile: Profile,
        session: zenoh.Session,
        policy: Policy,
        name: str,
        *,
        images: Literal["raw", "jpeg"] = "raw",
        host: str | None = None,
        delay_s: float = 0.0,
        robots: Sequence[str] = (),
        another: Callable[[], Policy] | None = None,
    ) -> None:
        self._delay_s, self._changed = delay_s, Wake()
        self._infer_batch: Callable[..., Any] | None = getattr(policy, "infer_batch", None)
        max_batch = getattr(policy, "max_batch", None) or max(len(robots), 1)
        self._max_batch: int = 1 if self._infer_batch is None else max_batch
        self._fits = self._max_batch
        """Robots for which one inference is fast enough."""
        self._longest_s = SHARE_OF_AGE * profile.timing.max_observation_age_s
        self._took_s = 0.0
        """The last inference; less if it was for more robots than the next one may be."""
        self._policies = [policy]
        if len(robots) > 1:
            self._policies = self._one_for_each(policy, len(robots), another)
        profiles = [as_robot(profile, robot) for robot in robots] or [profile]
        self.policy, self.name, self.spec = policy, name, policy.spec
        self.sessions: list[RobotSession] = []
        with ExitStack() as opened:
            for one, shared in zip(profiles, itertools.cycle(self._policies), strict=False):
                robot = RobotSession(
                    one, session, shared, name, images=images, host=host, changed=self._changed
                )
                opened.callback(robot.close)
                self.sessions.append(robot)
            self._debug = {
                one.robot: InferenceDebugPublisher(one.node, name, one.spec)
                for one in self.sessions
            }
            opened.pop_all()
        self.node = self.sessions[0].node

    def _one_for_each(
        self, policy: Policy, count: int, another: Callable[[], Policy] | None
    ) -> list[Policy]:
        if self._infer_batch is not None:
            if reset_of(policy) is not None and not takes_robot(policy):
                raise WorkerError(
                    f"model {policy.spec.name!r} serves several robots together, but its reset() "
                    "does not know whose episode begins: give it the robot's name, reset(robot)"
                )
            return [policy]
        if another is None:
            raise WorkerError(f"model {policy.spec.name!r} serves one robot: it has no infer_batch")
        return [policy, *(another() for _ in range(count - 1))]

    # -- loop ---------------------------------------------------------------------------------
    def run(self, stop: threading.Event) -> None:
        """Load the model, then infer until `stop` is set."""
        for robot in self.sessions:
            robot.report(now=True)
        began = time.monotonic()
        loaded = self._call("load")
        took_s = time.monotonic() - began
        for robot in self.sessions:
            if loaded:
                robot.node.emit(Event("info", "notice", "loaded", f"in {took_s:.1f} s"))
            robot.complaint, robot.due_s = "", time.monotonic()
        while not stop.is_set():
            self._step(stop)
        for robot in self.sessions:
            robot.close()
        self._call("close")

    def _call(self, name: str) -> bool:
        """Call an optional method of every copy of the model; whether it has that."""
        methods = [getattr(policy, name, None) for policy in self._policies]
        for method in methods:
            if callable(method):
                method()
        return callable(methods[0])

    def _step(self, stop: threading.Event) -> None:
        now_s = time.monotonic()
        due = sorted((r for r in self.sessions if r.due_s <= now_s), key=lambda r: r.due_s)
        for robot in self.sessions:
            if robot not in due:
                robot.poll()
        ready = self._observe(due)
        if ready:
            self._infer(ready)
        for robot in self.sessions:
            robot.report()
        if not ready:
            self._wait(due, stop)

    def _observe(self, due: Sequence[RobotSession]) -> list[Ready]:
        """Robots that are due and have a new observation, as many as fit one inference; those
        whose chunk would come too late only where that keeps no other waiting."""
        ready: list[Ready] = []
        late: list[Ready] = []
        for robot in due:
            if len(ready) == self._fits:
                robot.poll()
                continue
            observation = robot.observe()
            if observation is not None:
                now_ns = robot.node.clock.wall_ns()
                in_time = robot.in_time(observation, now_ns, self._took_s)
                (ready if in_time else late).append((robot, observation, now_ns))
        ends_s = time.monotonic() + self._took_s
        if ready or any(robot.expects(ends_s) for robot in self.sessions):
            return ready
        return late[: self._fits]

    def _wait(self, due: Sequence[RobotSession], stop: threading.Event) -> None:
        """Sleep until a robot is due or has sent its images, but only for a little while."""
        now_s = time.monotonic()
        others_s = [robot.due_s - now_s for robot in self.sessions if robot not in due]
        if not due:
            stop.wait(max(0.0, min(*others_s, POLL_PERIOD_S)))
        elif self.spec.observation.camera_names:
            for _ in range(NAPS):
                if self._changed.wait(NAP_S) and any(robot.has_images for robot in due):
                    return
                # States decoded while idle cost no time once the image is there.
                for robot in self.sessions:
                    robot.poll_states()
                if others_s and min(others_s) <= time.monotonic() - now_s:
                    return
        else:
            idle = all(robot.task is None for robot in due)
            stop.wait(IDLE_NAP_S if idle else BLIND_NAP_S)

    # -- inference ----------------------------------------------------------------------------
    def _infer(self, ready: Sequence[Ready]) -> None:
        began_s = time.monotonic()
        start_ns = {robot.robot: robot.node.clock.wall_ns() for robot, _, _ in ready}
        answers = self._answers(ready)
        if self._delay_s:
            time.sleep(self._delay_s)
        self._learn(len(ready), time.monotonic() - began_s)
        published: list[Any] = []
        for (robot, observation, observed_ns), answer in zip(ready, answers, strict=True):
            robot.due_s = max(robot.due_s + 1.0 / observation.task.requested_hz, began_s)
            if isinstance(answer, Exception):
                robot.failed(answer)
                continue
            times_ns = (observed_ns, start_ns[robot.robot], robot.node.clock.wall_ns())
            chunk = robot.publish(observation, answer, times_ns, len(ready))
            if chunk is not None:
                published.append((robot, observation, answer, *chunk))
        for robot, *inference in published:
            self._debug[robot.robot].publish(*inference)

    def _learn(self, count: int, took_s: float) -> None:
        """Keep how long it took; a batch that is too slow, or the largest one, says what fits."""
        if took_s > self._longest_s or count >= self._fits:
            fits = int(count * self._longest_s / max(took_s, 1e-6))
            self._fits = min(max(fits, 1), self._max_batch)
        self._took_s = took_s * min(1.0, self._fits / count)

    def _answers(self, ready: Sequence[Ready]) -> list[ActionSteps | Exception]:
        try:
            if self._infer_batch is None or len(ready) == 1:
                robot, observation, _ = ready[0]
                return [robot.prefix.infer(observation)]
            return self._batch(ready)
        except Exception as error:
            if len(ready) == 1:
                return [error]
            # Which observation failed is unknown: infer one by one, so that the others succeed.
            return [answer for one in ready for answer in self._answers([one])]

    def _batch(self, ready: Sequence[Ready]) -> list[ActionSteps | Exception]:
        assert self._infer_batch is not None
        extra: dict[str, Any] = {}
        if getattr(self.policy, "takes_committed", False):
            extra["committed"] = [robot.prefix.committed(seen) for robot, seen, _ in ready]
        seen = [robot.prefix.with_progress(observation) for robot, observation, _ in ready]
        found = list(self._infer_batch(seen, **extra))
        if len(found) != len(ready):
            raise SpecError(f"infer_batch gave {len(found)} answers to {len(ready)} observations")
        return [one if isinstance(one, ActionSteps) else ActionSteps(one) for one in found]


class InferenceDebugPublisher:
    """Publishes observation and answer of each inference, while there are subscribers; after the
    chunks of that inference, so it never delays one."""

    def __init__(self, node: Node, worker: str, spec: ModelSpec) -> None:
        self._node = node
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
        self, observation: Observation, answer: ActionSteps, header: Header, chunk: ActionChunk
    ) -> None:
        """Publish one inference, whose chunk was published with `header`."""
        stamp_ns, seq = observation.stamp_wall_ns, header.seq
        inference_ms = (chunk.inference_end_ns - chunk.inference_start_ns) / 1e6
        try:
            for encode, camera, stream in self._images:
                if stream.has_subscribers:
                    payload, encoding = encode(camera, observation, answer)
                    stream.publish(payload, stamp_wall_ns=stamp_ns, seq=seq, encoding=encoding)
            if self._record.has_subscribers:
                seen = InferenceDebug(
                    *(chunk.worker, seq, chunk.spec_hash, chunk.episode, stamp_ns),
                    *(observation.prompt, chunk.steps, inference_ms),
                    *(plain_values(answer.raw), chunk.done),
                )
                self._record.publish(seen, stamp_wall_ns=stamp_ns, seq=seq)
        except Exception as error:  # tensors of a model raise anything
            self._node.reject("seen", f"the inference cannot be published: {in_words(error)}")


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
