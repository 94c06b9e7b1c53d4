"""Receives chunks and specs of two workers, and the states of the arm, of a live run."""

from __future__ import annotations

import time

import zenoh

from vla_zenoh.bus.buffers import bytes_of
from vla_zenoh.codec import records
from vla_zenoh.errors import CodecError, NodeError
from vla_zenoh.keys import Keys, last_chunk
from vla_zenoh.lab.compare.agreement import ArmStateHistory
from vla_zenoh.lab.recording.sample_queue import SampleQueue
from vla_zenoh.policy import ModelSpec
from vla_zenoh.types import ActionChunk, GripperState, PoseState

SPEC_PATIENCE_S, ASK_AGAIN_S = 3.0, 0.1
MAX_BYTES, MAX_SAMPLES = 16 * 1024 * 1024, 8192


class CompareListener:
    """Chunks of two workers and the states of the arm; call `poll` often.

    Args:
        session: an open session; the caller closes it.
        keys: of the robot.
        workers: the two names.

    Raises:
        NodeError: a worker has published no spec.
    """

    def __init__(self, session: zenoh.Session, keys: Keys, workers: tuple[str, str]) -> None:
        self.specs = {worker: _spec(session, keys, worker) for worker in workers}
        self.chunks: dict[str, list[ActionChunk]] = {worker: [] for worker in workers}
        self.standing = ArmStateHistory()
        self._kinds: dict[str, type] = {keys.delta(worker): ActionChunk for worker in workers}
        self._kinds |= {keys.state_pose: PoseState, keys.state_gripper: GripperState}
        self._queue = SampleQueue(session, max_bytes=MAX_BYTES, max_samples=MAX_SAMPLES)
        self._queue.subscribe(self._kinds)

    def poll(self) -> None:
        """Decode the samples received since the last call."""
        for sample in self._queue.take():
            try:
                record = records.decode(self._kinds[sample.key], sample.payload)
            except CodecError:
                continue  # the nodes count and report what they reject
            if sample.header is None:
                continue
            if not isinstance(record, ActionChunk):
                self.standing.add(sample.header.stamp_wall_ns, record)
            # A worker that restarted may have another spec, which gives its steps another meaning.
            elif record.spec_hash == self.specs[last_chunk(sample.key)].hash:
                self.chunks[last_chunk(sample.key)].append(record)

    def close(self) -> None:
        """Stop receiving."""
        self._queue.close()


def _spec(session: zenoh.Session, keys: Keys, worker: str) -> ModelSpec:
    """The worker's spec; a session that was just opened may not know the worker yet."""
    give_up_s = time.monotonic() + SPEC_PATIENCE_S
    while time.monotonic() < give_up_s:
        for reply in session.get(keys.spec(worker), timeout=SPEC_PATIENCE_S):
            if reply.ok is not None:
                try:
                    return records.decode(ModelSpec, bytes_of(reply.ok.payload))
                except CodecError as error:
                    raise NodeError(f"worker {worker!r}: invalid spec: {error}") from error
        time.sleep(ASK_AGAIN_S)
    raise NodeError(f"worker {worker!r} publishes no spec; is it alive? (`vla-zenoh status`)")
