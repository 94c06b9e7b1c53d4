"""A worker that is asked over the keys: an observation is published, its chunk is awaited.

This process has the place of robot, cameras and command node, so that any worker, wherever it runs,
answers one observation after the other while a benchmark's clock stands still.
"""

from __future__ import annotations

import time
from typing import Any

import numpy as np
import zenoh

from vla_zenoh.bus.buffers import CallbackRing, bytes_of
from vla_zenoh.bus.node import Node, Publisher
from vla_zenoh.codec import records
from vla_zenoh.codec.image import encode_jpeg, encode_raw, raw_schema
from vla_zenoh.errors import CodecError, NodeError
from vla_zenoh.keys import LOADING, Kind, worker_node
from vla_zenoh.policy import ModelSpec
from vla_zenoh.profile import Profile
from vla_zenoh.types import ActionChunk, Image, NodeStatus, Task
from vla_zenoh_benchmarks.contract import BenchmarkObservation

NODE = "sim"
RATE_HZ = 1000.0
"""Asked of the worker: it answers as soon as there is something new to see."""
POLL_S = 0.0005
TASK_PERIOD_S = 0.5
SOON_S, AGAIN_S = 0.05, 1.0
"""What was not answered is published again: it may seem older than the last chunk where clocks of
two computers differ by more than a step takes."""
LOAD_PATIENCE_S = 900.0
FAILED = ("contract: ", "inference_failed: ", "reset_failed: ")
"""How complaints begin that another observation will not mend."""


class AskedWorker:
    """Asks one worker for chunks. Raises NodeError: the robot's keys are taken by another one."""

    def __init__(
        self, profile: Profile, session: zenoh.Session, worker: str, patience_s: float
    ) -> None:
        self.worker, self._patience_s = worker, patience_s
        node = self.node = Node(NODE, profile, session)
        keys = node.keys
        self._task = node.declare_publisher(keys.task, Kind.CONTROL)
        self._states = {
            part: node.declare_publisher(getattr(keys, f"state_{part}"), Kind.STATE)
            for part in ("joint", "pose", "gripper", "privileged")
        }
        self._cameras: dict[str, Publisher] = {}
        self._jpegs: dict[str, Publisher] = {}
        self._chunks = node.subscribe(keys.delta(worker), CallbackRing(8))
        self._status = node.subscribe(keys.status(worker_node(worker)), CallbackRing(8))
        self._complaint, self._episode = "", time.time_ns() // 1_000_000
        self._prompt, self._seq, self._task_s = "", 0, 0.0
        self.spec = self._wait_for_spec()

    def begin(self, prompt: str) -> None:
        """Begin an episode: the model is reset, and no answer of the last one counts."""
        self._episode += 1
        self._prompt = prompt
        self._publish_task()

    def ask(self, seen: BenchmarkObservation) -> ActionChunk:
        """The chunk that answers `seen`.

        Raises:
            NodeError: there is none within the patience; says what the worker complains of.
        """
        first, wait_s = self._seq, SOON_S
        give_up_s = time.monotonic() + self._patience_s
        while time.monotonic() < give_up_s:
            self._publish(seen)
            again_s, wait_s = time.monotonic() + wait_s, AGAIN_S
            while time.monotonic() < again_s:
                for arrival in self._chunks.drain():
                    chunk = self.node.decode(ActionChunk, arrival)
                    if chunk is None or chunk.record.episode != self._episode:
                        continue
                    if chunk.record.observation_seq >= first:
                        return chunk.record
                time.sleep(POLL_S)
            self._publish_task()
            self._poll_status()
            if self._complaint.startswith(FAILED):
                raise NodeError(f"worker {self.worker!r} failed: {self._complaint}")
        raise NodeError(
            f"worker {self.worker!r} did not answer within {self._patience_s:g} s"
            + (f"; it says: {self._complaint}" if self._complaint else "")
        )

    def close(self) -> None:
        self.node.publish_end()
        self.node.close()

    def _publish(self, seen: BenchmarkObservation) -> None:
        if time.monotonic() - self._task_s > TASK_PERIOD_S:
            self._publish_task()
        self.node.clock.adopt_system_time()
        stamp_ns = self.node.clock.wall_ns()
        for part, publisher in self._states.items():  # before the images that they belong to
            record = getattr(seen, part)
            if record is not None:
                publisher.publish(record, stamp_wall_ns=stamp_ns, seq=self._seq)
        for name, picture in seen.images.items():
            if name not in self._cameras:
                keys = self.node.keys
                self._cameras[name] = self.node.declare_publisher(keys.camera_raw(name), Kind.FRAME)
                self._jpegs[name] = self.node.declare_publisher(keys.camera_jpeg(name), Kind.FRAME)
            image = Image(np.ascontiguousarray(picture))
            told: dict[str, Any] = {"stamp_wall_ns": stamp_ns, "seq": self._seq}
            schema = zenoh.Encoding.ZENOH_BYTES.with_schema(raw_schema(image))
            self._cameras[name].publish(encode_raw(image), **told, encoding=schema)
            if self._jpegs[name].has_subscribers:  # a worker on another computer
                jpeg = encode_jpeg(image)
                self._jpegs[name].publish(jpeg, **told, encoding=zenoh.Encoding.IMAGE_JPEG)
        self._seq += 1
        self.node.publish_status("ready")

    def _publish_task(self) -> None:
        self._task_s = time.monotonic()
        self._task.publish(Task(self._episode, True, self._prompt, self.worker, RATE_HZ))

    def _wait_for_spec(self) -> ModelSpec:
        """The worker's spec, once its model is loaded.

        Raises:
            NodeError: no worker of this name loads in time.
        """
        spec: ModelSpec | None = None
        give_up_s = time.monotonic() + LOAD_PATIENCE_S
        while time.monotonic() < give_up_s:
            spec = spec or self._asked_spec()
            self._poll_status()
            if spec is not None and self._complaint != LOADING:
                return spec
            self.node.publish_status("waiting")
            time.sleep(0.1)
        said = f"; it says: {self._complaint}" if self._complaint else ""
        raise NodeError(f"worker {self.worker!r} is not there{said}")

    def _asked_spec(self) -> ModelSpec | None:
        for reply in self.node.session.get(self.node.keys.spec(self.worker), timeout=2.0):
            if reply.ok is not None:
                try:
                    return records.decode(ModelSpec, bytes_of(reply.ok.payload))
                except CodecError as error:
                    raise NodeError(f"worker {self.worker!r}: {error}") from error
        return None

    def _poll_status(self) -> None:
        for arrival in self._status.drain():
            found = self.node.decode(NodeStatus, arrival)
            if found is not None:
                self._complaint = str(found.record.detail.get("complaint", ""))
