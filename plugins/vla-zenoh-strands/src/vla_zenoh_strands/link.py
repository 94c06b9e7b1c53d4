"""Zenoh's side of the mesh: messages out, with the session that they come from, and buffers in."""

from __future__ import annotations

import json
import time

import zenoh

from vla_zenoh.bus.buffers import SampleBuffer
from vla_zenoh_strands.identity import Identity
from vla_zenoh_strands.wire import MeshKeys, Message


class Link:
    """A session with the router of the mesh, as one of its peers.

    Args:
        session: with that router.
        keys: of the mesh.
        identity: signs what is sent; None: nothing is signed.
    """

    def __init__(
        self, session: zenoh.Session, keys: MeshKeys, identity: Identity | None = None
    ) -> None:
        self._session, self.keys, self._identity = session, keys, identity
        self.zid = str(session.zid())
        self._source = session.declare_publisher(keys.presence(keys.us))
        self._sent = 0

    def put(self, key: str, body: Message, *, signed: bool = False) -> None:
        """Publish a message, with its source: peers believe no presence, answer or stop without."""
        if signed and self._identity is not None:
            body = self._identity.sign(body, time.time())
        self._sent += 1
        self._session.put(
            key,
            json.dumps(body).encode(),
            source_info=zenoh.SourceInfo(self._source.id, self._sent),
            congestion_control=zenoh.CongestionControl.DROP,
            express=True,
        )

    def listen(self, key: str, buffer: SampleBuffer) -> None:
        """Let a buffer receive what others publish, until the session is closed."""
        received = zenoh.handlers.Callback(buffer, indirect=False)
        self._session.declare_subscriber(key, received, allowed_origin=zenoh.Locality.REMOTE)
