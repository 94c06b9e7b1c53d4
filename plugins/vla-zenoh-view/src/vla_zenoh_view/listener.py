"""Receives what a robot publishes, for display."""

from __future__ import annotations

from contextlib import suppress

import zenoh

from vla_zenoh.bus.buffers import bytes_of
from vla_zenoh.bus.reception import Reception
from vla_zenoh.codec import records
from vla_zenoh.errors import CodecError
from vla_zenoh.lab.recording.sample_queue import SampleQueue
from vla_zenoh.profile import Profile
from vla_zenoh.types import NodeStatus

QUEUE_BYTES = 16 * 1024 * 1024
QUEUE_SAMPLES = 8_000
"""Some ten seconds: a display that is further behind shows the past."""
REPLY_TIMEOUT_S = 1.0


class ViewListener(SampleQueue):
    """Queue of all samples of a robot but raw images.

    Args:
        session: an open session; the caller closes it.
        queue_bytes: payloads kept at most; samples that do not fit are dropped and counted.
    """

    def __init__(
        self, session: zenoh.Session, profile: Profile, *, queue_bytes: int = QUEUE_BYTES
    ) -> None:
        super().__init__(session, max_bytes=queue_bytes, max_samples=QUEUE_SAMPLES)
        self.reception = Reception(profile.keys)
        self._statuses = profile.keys.all_status.removesuffix("*")
        expressions = profile.keys_of_all_parts.without_raw_images
        self.subscribe(expressions)
        for expression in expressions:
            self.reception.watch(expression, self.arrived)
        # Specs are published once a second, and chunks cannot be drawn without them.
        for reply in session.get(profile.keys.all_specs, timeout=REPLY_TIMEOUT_S):
            if reply.ok is not None:
                self.receive(reply.ok)

    def receive(self, sample: zenoh.Sample) -> None:
        """As `SampleQueue.receive`; a status tells `reception` at once what was sent until then."""
        super().receive(sample)
        if str(sample.key_expr).startswith(self._statuses):
            with suppress(CodecError):
                status = records.decode(NodeStatus, bytes_of(sample.payload))
                self.reception.status_received(status)
