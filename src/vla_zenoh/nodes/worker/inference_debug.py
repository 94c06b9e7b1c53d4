"""Publishes the inputs and outputs of inferences for debugging, and subscribes to them."""

from __future__ import annotations

import threading
from collections import Counter, deque
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import zenoh
from numpy.typing import NDArray

from vla_zenoh.bus.buffers import bytes_of, check_size, header_of
from vla_zenoh.bus.node import Node
from vla_zenoh.codec import records
from vla_zenoh.codec.image import MAX_JPEG_BYTES, encode_jpeg
from vla_zenoh.errors import CodecError, ProfileError, RecordError
from vla_zenoh.keys import Keys, Kind, key_chunk
from vla_zenoh.policy import MAX_CAMERAS, ActionSteps, ModelSpec, Observation
from vla_zenoh.types import Header, Image, InferenceDebug
from vla_zenoh.types.chunk import plain_values

JPEG_QUALITY = 95
MAX_WAITING, MAX_SAMPLES = 64, 256
"""Inferences whose images wait for their record; samples that wait to be decoded."""
MAX_WAITING_BYTES = 128 * 1024 * 1024
"""Of each of the two."""


class InferenceDebugPublisher:
    """Publishes observation and answer of each inference, while there are subscribers.

    It runs after the chunk was published, so it never delays one.

    Args:
        node: of the worker.
        worker: its name.
        spec: of its model.
    """

    def __init__(self, node: Node, worker: str, spec: ModelSpec) -> None:
        self._node, self._worker, self._spec = node, worker, spec
        keys = node.keys
        # One priority for all: the images arrive before the record.
        self._record = node.declare_publisher(keys.seen_record(worker), Kind.FRAME)
        self._images = {
            camera.camera: node.declare_publisher(keys.seen(worker, camera.camera), Kind.FRAME)
            for camera in spec.observation.cameras
        }

    def publish(
        self,
        observation: Observation,
        answer: ActionSteps,
        steps: NDArray[np.float32],
        chunk: Header,
        inference_ms: float,
    ) -> None:
        """Publish one inference.

        Args:
            observation: input of the model.
            answer: its output.
            steps: (H, D) of the answer, validated.
            chunk: header of the published chunk.
            inference_ms: duration.
        """
        stamp_ns, seq = observation.stamp_wall_ns, chunk.seq
        try:
            for camera in self._spec.observation.cameras:
                stream = self._images[camera.camera]
                if stream.has_subscribers:
                    rgb = self._rgb(camera.camera, camera.colour, observation, answer)
                    stream.publish(
                        encode_jpeg(Image(rgb), JPEG_QUALITY),
                        stamp_wall_ns=stamp_ns,
                        seq=seq,
                        encoding=zenoh.Encoding.IMAGE_JPEG,
                    )
            if self._record.has_subscribers:
                seen = InferenceDebug(
                    self._worker,
                    seq,
                    self._spec.hash,
                    observation.task.episode,
                    stamp_ns,
                    observation.prompt,
                    steps,
                    inference_ms,
                    plain_values(answer.raw),
                    bool(answer.done),
                )
                self._record.publish(seen, stamp_wall_ns=stamp_ns, seq=seq)
        except (RecordError, CodecError) as error:
            self._node.reject("seen", f"the inference cannot be published: {error}")

    @staticmethod
    def _rgb(
        camera: str, colour: str, observation: Observation, answer: ActionSteps
    ) -> NDArray[np.uint8]:
        own = (answer.pictures or {}).get(camera)
        if own is not None:
            return np.asarray(own)
        image = observation.images[camera]
        return np.ascontiguousarray(image[..., ::-1]) if colour == "bgr" else image


@dataclass(frozen=True, slots=True)
class InferenceView:
    """One inference with its images.

    Args:
        record: prompt, steps, times.
        jpegs: camera -> JPEG file of the model's input.
    """

    record: InferenceDebug
    jpegs: Mapping[str, bytes]


class PendingImages:
    """Bounded store of images that wait for the record of their inference.

    Args:
        left_out: counts dropped images by reason.
        limit: total bytes.
    """

    def __init__(self, left_out: Counter[str], limit: int = MAX_WAITING_BYTES) -> None:
        self._left_out, self._limit, self._bytes = left_out, limit, 0
        self._kept: dict[tuple[str, int], dict[str, bytes]] = {}

    def add(self, worker: str, seq: int, camera: str, jpeg: bytes) -> None:
        """Keep an image, and drop the oldest ones beyond the limits.

        Raises:
            CodecError: more cameras than any model has.
        """
        kept = self._kept.setdefault((worker, seq), {})
        if camera not in kept and len(kept) >= MAX_CAMERAS:
            raise CodecError(
                "cameras", f"{worker} publishes more than {MAX_CAMERAS} images at once"
            )
        self._bytes += len(jpeg) - len(kept.get(camera, b""))
        kept[camera] = jpeg
        while len(self._kept) > MAX_WAITING or self._bytes > self._limit:
            oldest = self.pop(*next(iter(self._kept)))
            self._left_out["no_record"] += len(oldest)

    def pop(self, worker: str, seq: int) -> dict[str, bytes]:
        """Remove the images of an inference, camera -> JPEG."""
        found = self._kept.pop((worker, seq), {})
        self._bytes -= sum(map(len, found.values()))
        return found


class InferenceDebugSubscriber:
    """Collects the inferences of one worker or of all; workers publish them while this exists.

    Args:
        session: open session.
        keys: of the robot.
        worker: its name; None: all workers.
    """

    def __init__(self, session: zenoh.Session, keys: Keys, worker: str | None = None) -> None:
        self.left_out: Counter[str] = Counter()
        """Dropped samples by reason; ``late``: `poll` was called too seldom."""
        self._keys = keys
        self._lock = threading.Lock()
        self._samples: deque[zenoh.Sample] = deque()
        self._samples_bytes = 0
        self._images = PendingImages(self.left_out)
        selectors = (
            (keys.all_seen_records, keys.all_seen)
            if worker is None
            else (keys.seen_record(worker), keys.all_seen_of(worker))
        )
        handler = zenoh.handlers.Callback(self._receive, indirect=False)
        self._subscribers = [session.declare_subscriber(key, handler) for key in selectors]

    def _receive(self, sample: zenoh.Sample) -> None:
        with self._lock:
            try:
                check_size(sample, MAX_JPEG_BYTES)
            except CodecError as error:
                self.left_out[error.reason] += 1
                return
            self._samples.append(sample)
            self._samples_bytes += len(sample.payload)
            while len(self._samples) > MAX_SAMPLES or self._samples_bytes > MAX_WAITING_BYTES:
                self._samples_bytes -= len(self._samples.popleft().payload)
                self.left_out["late"] += 1

    def poll(self) -> list[InferenceView]:
        """Inferences received since the last call, oldest first."""
        with self._lock:
            samples, self._samples, self._samples_bytes = self._samples, deque(), 0
        out: list[InferenceView] = []
        for sample in samples:
            try:
                view = self._decode(sample)
            except CodecError as error:
                self.left_out[error.reason] += 1
                continue
            if view is not None:
                out.append(view)
        return out

    def _decode(self, sample: zenoh.Sample) -> InferenceView | None:
        header, payload = header_of(sample), bytes_of(sample.payload, MAX_JPEG_BYTES)
        _, worker, *camera = self._keys.short(str(sample.key_expr)).split("/")
        try:  # folders and files are named after them
            for name in (worker, *camera):
                key_chunk(name, "name")
        except ProfileError as error:
            raise CodecError("malformed", str(error)) from error
        if camera:
            self._images.add(worker, header.seq, camera[0], payload)
            return None
        record = records.decode(InferenceDebug, payload)
        if record.worker != worker:
            raise CodecError("foreign", f"{worker} publishes a record of {record.worker[:60]!r}")
        return InferenceView(record, self._images.pop(worker, header.seq))

    def close(self) -> None:
        """Unsubscribe."""
        for subscriber in self._subscribers:
            subscriber.undeclare()
