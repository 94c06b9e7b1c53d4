"""Hears two workers over a live run: their chunks, their specs, and where the arm was."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from typing import TypeVar

import zenoh

from vla_zenoh.bus.buffers import CallbackRing, ReceivedSample, bytes_of, header_of
from vla_zenoh.codec import records
from vla_zenoh.errors import CodecError, NodeError
from vla_zenoh.keys import Keys
from vla_zenoh.lab.compare.agreement import ArmStateHistory
from vla_zenoh.policy import ModelSpec
from vla_zenoh.types import ActionChunk, GripperState, Header, PoseState

SPEC_PATIENCE_S, ASK_AGAIN_S = 3.0, 0.1
MAX_STATES, MAX_CHUNKS = 4096, 1024

Record = TypeVar("Record")


class CompareListener:
    """See the module; `poll` often.

    Args:
        session: open session.
        keys: of the robot.
        workers: the two names.

    Raises:
        NodeError: a worker has published no spec.
    """

    def __init__(self, session: zenoh.Session, keys: Keys, workers: tuple[str, str]) -> None:
        self.specs = {worker: _spec(session, keys, worker) for worker in workers}
        self.chunks: dict[str, list[ActionChunk]] = {worker: [] for worker in workers}
        self.standing = ArmStateHistory()
        self._deltas = {worker: CallbackRing(MAX_CHUNKS) for worker in workers}
        self._poses, self._grippers = CallbackRing(MAX_STATES), CallbackRing(MAX_STATES)
        listening = [
            *((keys.delta(worker), self._deltas[worker]) for worker in workers),
            (keys.state_pose, self._poses),
            (keys.state_gripper, self._grippers),
        ]
        self._subscribers = [
            session.declare_subscriber(key, zenoh.handlers.Callback(inbox, indirect=False))
            for key, inbox in listening
        ]

    def poll(self) -> None:
        """Take in what came since the last call."""
        for kind, inbox in ((PoseState, self._poses), (GripperState, self._grippers)):
            for header, state in _read(kind, inbox.drain()):
                self.standing.add(header.stamp_wall_ns, state)
        for worker, inbox in self._deltas.items():
            for _, chunk in _read(ActionChunk, inbox.drain()):
                # A worker that was started anew may have another spec; what it said before and
                # now cannot be read together.
                if chunk.spec_hash == self.specs[worker].hash:
                    self.chunks[worker].append(chunk)

    def close(self) -> None:
        """Stop listening."""
        for subscriber in self._subscribers:
            subscriber.undeclare()


def _spec(session: zenoh.Session, keys: Keys, worker: str) -> ModelSpec:
    """The worker's spec; a session that was opened just now does not know yet whom to ask."""
    give_up_s = time.monotonic() + SPEC_PATIENCE_S
    while time.monotonic() < give_up_s:
        for reply in session.get(keys.spec(worker), timeout=SPEC_PATIENCE_S):
            if reply.ok is not None:
                try:
                    return records.decode(ModelSpec, bytes_of(reply.ok.payload))
                except CodecError as error:
                    raise NodeError(f"worker {worker!r}: its spec is not one: {error}") from error
        time.sleep(ASK_AGAIN_S)
    raise NodeError(f"worker {worker!r} tells no spec; is it alive? (`vla-zenoh status`)")


def _read(
    kind: type[Record], arrivals: Sequence[ReceivedSample]
) -> Iterator[tuple[Header, Record]]:
    for arrival in arrivals:
        try:
            header = header_of(arrival.sample)
            record = records.decode(kind, bytes_of(arrival.sample.payload))
        except CodecError:
            continue  # the nodes count and tell what strangers write
        yield header, record
