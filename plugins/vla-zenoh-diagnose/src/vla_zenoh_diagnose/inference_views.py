"""Subscribes to the inputs and outputs of inferences, which workers publish for debugging."""

from __future__ import annotations

import threading
from collections import Counter, deque
from collections.abc import Mapping
from dataclasses import dataclass

import zenoh

from vla_zenoh.bus.buffers import bytes_of, check_size, header_of
from vla_zenoh.codec import records
from vla_zenoh.codec.image import MAX_JPEG_BYTES
from vla_zenoh.errors import CodecError, ProfileError
from vla_zenoh.keys import Keys, key_chunk
from vla_zenoh.policy import MAX_CAMERAS
from vla_zenoh.types import InferenceDebug

MAX_WAITING, MAX_SAMPLES = 64, 256
"""Inferences whose images wait for their record; samples that wait to be decoded."""
MAX_WAITING_BYTES = 128 * 1024 * 1024
"""Of each of the two."""


@dataclass(frozen=True, slots=True)
class InferenceView:
    """One inference with its images. `jpegs`: camera -> JPEG file of the model's input."""

    record: InferenceDebug
    jpegs: Mapping[str, bytes]


class PendingImages:
    """Bounded store of images that wait for the record of their inference. `limit`: total bytes."""

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
        for subscriber in self._subscribers:
            subscriber.undeclare()
