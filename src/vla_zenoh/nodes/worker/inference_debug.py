"""What a model saw, on its way out of the worker and into the hands of who asks."""

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
"""Inferences whose pictures wait for their record; samples that wait to be read."""
MAX_WAITING_BYTES = 128 * 1024 * 1024
"""Of either."""


class InferenceDebugPublisher:
    """Writes what the model saw and said, while somebody listens.

    It is called when the chunk is out already, so it never makes one late.

    Args:
        node: the worker's.
        worker: its name.
        spec: of its model.
    """

    def __init__(self, node: Node, worker: str, spec: ModelSpec) -> None:
        self._node, self._worker, self._spec = node, worker, spec
        keys = node.keys
        # All with one priority: who has the record has its pictures before.
        self._record = node.declare_publisher(keys.seen_record(worker), Kind.FRAME)
        self._pictures = {
            camera.camera: node.declare_publisher(keys.seen(worker, camera.camera), Kind.FRAME)
            for camera in spec.observation.cameras
        }

    def show(
        self,
        observation: Observation,
        answer: ActionSteps,
        steps: NDArray[np.float32],
        chunk: Header,
        inference_ms: float,
    ) -> None:
        """Write one inference to whoever listens.

        Args:
            observation: what the model was given.
            answer: what it returned.
            steps: the same, checked.
            chunk: header of the published chunk.
            inference_ms: time it took.
        """
        stamp_ns, seq = observation.stamp_wall_ns, chunk.seq
        try:
            for camera in self._spec.observation.cameras:
                stream = self._pictures[camera.camera]
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
            self._node.reject("seen", f"what the model saw cannot be shown: {error}")

    @staticmethod
    def _rgb(
        camera: str, colour: str, observation: Observation, answer: ActionSteps
    ) -> NDArray[np.uint8]:
        shown = (answer.pictures or {}).get(camera)
        if shown is not None:
            return np.asarray(shown)
        picture = observation.images[camera]
        return np.ascontiguousarray(picture[..., ::-1]) if colour == "bgr" else picture


@dataclass(frozen=True, slots=True)
class InferenceView:
    """One inference with its pictures.

    Args:
        record: see `InferenceDebug`.
        jpegs: camera -> JPEG file of what the model was given.
    """

    record: InferenceDebug
    jpegs: Mapping[str, bytes]


class PendingImages:
    """Pictures that wait for the record of their inference, up to a bound.

    Args:
        left_out: counts by reason what is not kept.
        limit: bytes of all of them.
    """

    def __init__(self, left_out: Counter[str], limit: int = MAX_WAITING_BYTES) -> None:
        self._left_out, self._limit, self._bytes = left_out, limit, 0
        self._kept: dict[tuple[str, int], dict[str, bytes]] = {}

    def add(self, worker: str, seq: int, camera: str, jpeg: bytes) -> None:
        """Keep one; who has waited longest makes room.

        Raises:
            CodecError: no model has so many cameras.
        """
        kept = self._kept.setdefault((worker, seq), {})
        if camera not in kept and len(kept) >= MAX_CAMERAS:
            raise CodecError("cameras", f"{worker} shows more than {MAX_CAMERAS} pictures at once")
        self._bytes += len(jpeg) - len(kept.get(camera, b""))
        kept[camera] = jpeg
        while len(self._kept) > MAX_WAITING or self._bytes > self._limit:
            oldest = self.take(*next(iter(self._kept)))
            self._left_out["no_record"] += len(oldest)

    def take(self, worker: str, seq: int) -> dict[str, bytes]:
        """Those of an inference, camera -> JPEG."""
        found = self._kept.pop((worker, seq), {})
        self._bytes -= sum(map(len, found.values()))
        return found


class InferenceDebugSubscriber:
    """Collects what workers show; they show it because this listens.

    Args:
        session: open session.
        keys: of the robot.
        worker: whose; None: of all.
    """

    def __init__(self, session: zenoh.Session, keys: Keys, worker: str | None = None) -> None:
        self.left_out: Counter[str] = Counter()
        """Samples by the reason why they are not shown; ``late``: `take` was called too seldom."""
        self._keys = keys
        self._lock = threading.Lock()
        self._samples: deque[zenoh.Sample] = deque()
        self._samples_bytes = 0
        self._pictures = PendingImages(self.left_out)
        selectors = (
            (keys.all_seen_records, keys.all_seen)
            if worker is None
            else (keys.seen_record(worker), keys.all_seen_of(worker))
        )
        handler = zenoh.handlers.Callback(self._hear, indirect=False)
        self._subscribers = [session.declare_subscriber(key, handler) for key in selectors]

    def _hear(self, sample: zenoh.Sample) -> None:
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

    def take(self) -> list[InferenceView]:
        """All that came since the last call, oldest first; what cannot be read is left out."""
        with self._lock:
            samples, self._samples, self._samples_bytes = self._samples, deque(), 0
        out: list[InferenceView] = []
        for sample in samples:
            try:
                sight = self._read(sample)
            except CodecError as error:
                self.left_out[error.reason] += 1
                continue
            if sight is not None:
                out.append(sight)
        return out

    def _read(self, sample: zenoh.Sample) -> InferenceView | None:
        header, payload = header_of(sample), bytes_of(sample.payload, MAX_JPEG_BYTES)
        _, worker, *camera = self._keys.short(str(sample.key_expr)).split("/")
        try:  # folders and files are named by them
            for name in (worker, *camera):
                key_chunk(name, "name")
        except ProfileError as error:
            raise CodecError("malformed", str(error)) from error
        if camera:
            self._pictures.add(worker, header.seq, camera[0], payload)
            return None
        record = records.decode(InferenceDebug, payload)
        if record.worker != worker:
            raise CodecError("foreign", f"{worker} shows what {record.worker[:60]!r} saw")
        return InferenceView(record, self._pictures.take(worker, header.seq))

    def close(self) -> None:
        """Stop listening."""
        for subscriber in self._subscribers:
            subscriber.undeclare()
