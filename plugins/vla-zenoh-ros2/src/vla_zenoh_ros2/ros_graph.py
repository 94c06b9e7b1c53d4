"""Publishers, subscribers, services and action clients in a ROS graph, over one Zenoh session."""

from __future__ import annotations

import contextlib
import itertools
import threading
import time
from collections.abc import Callable
from typing import Any, TypeVar

import zenoh
import zenoh.ext

from vla_zenoh.bus.buffers import CallbackRing, LatestSample, bytes_of
from vla_zenoh.errors import CodecError
from vla_zenoh.profile.robot import Ros2Profile
from vla_zenoh_ros2.keys import (
    DEFAULT,
    Attachment,
    Endpoint,
    EntityRole,
    Qos,
    RmwZenoh,
    Ros2Dds,
    Wire,
    gid_of,
    parts_of,
)
from vla_zenoh_ros2.messages import Messages

Buffer = TypeVar("Buffer", LatestSample, CallbackRing)

CALL_S = 5.0
"""Timeout of a service call."""

MAX_ATTACHMENT_BYTES = 1024
_CDR = zenoh.Encoding("application/cdr")
_ALL_COMPLETE = zenoh.QueryTarget.ALL_COMPLETE


class RosPublisher:
    """Publishes CDR bytes on one topic."""

    def __init__(self, session: zenoh.Session, key: str, gid: bytes | None) -> None:
        drop, first = zenoh.CongestionControl.DROP, zenoh.Priority.REAL_TIME
        self._publisher = session.declare_publisher(
            key, encoding=_CDR, congestion_control=drop, priority=first, express=True
        )
        self._gid = gid
        self._seq = itertools.count(1)

    @property
    def has_subscribers(self) -> bool:
        """Whether there is a subscriber; behind a bridge, one in DDS."""
        return self._publisher.matching_status.matching  # pyright: ignore  # stub says bool

    def publish(self, payload: bytes) -> None:
        self._publisher.put(payload, attachment=_attachment(self._gid, self._seq))


class ServiceClient:
    """Client of one service."""

    def __init__(self, session: zenoh.Session, key: str, gid: bytes | None) -> None:
        self._session, self._key, self._gid = session, key, gid
        self._seq = itertools.count(1)

    def call(
        self, request: bytes, done: Callable[[bytes | None], None], timeout_s: float = CALL_S
    ) -> None:
        """Call the service with a `request` in CDR.

        `done` is called once, on Zenoh's thread, with the answer in CDR, or None after the timeout.
        """
        answers: list[bytes] = []

        def on_reply(reply: zenoh.Reply) -> None:
            if reply.ok is not None:
                with contextlib.suppress(CodecError):  # too large
                    answers.append(bytes_of(reply.ok.payload))

        self._session.get(
            self._key,
            zenoh.handlers.Callback(
                on_reply, lambda: done(next(iter(answers), None)), indirect=False
            ),
            payload=request,
            encoding=_CDR,
            attachment=_attachment(self._gid, self._seq),
            timeout=timeout_s,
            target=zenoh.QueryTarget.BEST_MATCHING if self._gid is None else _ALL_COMPLETE,
        )


def _attachment(gid: bytes | None, seq: itertools.count[int]) -> bytes | None:
    if gid is None:
        return None
    return Attachment(next(seq), time.time_ns(), gid).encode()


class Request:
    """Call of one of our services; answer it once, from any thread."""

    def __init__(self, query: zenoh.Query, key: str, with_attachment: bool) -> None:
        self._query, self._key = query, key
        self.payload = bytes_of(query.payload)
        self._attachment: Attachment | None = None
        if with_attachment:
            given = query.attachment
            payload = None if given is None else bytes_of(given, MAX_ATTACHMENT_BYTES)
            self._attachment = Attachment.decode(payload)

    def answer(self, response: bytes) -> None:
        """Reply with CDR bytes, and with number and gid of the request."""
        given, attachment = self._attachment, None
        if given is not None:
            attachment = given._replace(stamp_ns=time.time_ns()).encode()
        with self._query:
            self._query.reply(self._key, response, encoding=_CDR, attachment=attachment)

    def drop(self, why: str) -> None:
        """Reply with an error; ROS clients see no answer."""
        with self._query:
            self._query.reply_err(why.encode())


class RosGraph:
    """A node of a ROS graph: declares its publishers, subscribers, services and clients.

    The `session` is to the bridge or the router of the robot; `buffers` are of all subscribers.
    """

    def __init__(
        self, session: zenoh.Session, profile: Ros2Profile, messages: Messages, node: str
    ) -> None:
        self.session = session
        self._rmw = profile.bridge == "rmw_zenoh"
        session_id = str(session.zid())
        hashed = messages.hash if messages.distribution != "humble" else None
        self._wire: Wire = Ros2Dds(session_id, hashed)
        if self._rmw:
            self._wire = RmwZenoh(session_id, node, profile.domain, messages.hash)
        self._numbers = itertools.count(1)
        self._lock = threading.Lock()
        self._others: set[str] = set()
        self._declared: list[Any] = []
        self.buffers: list[LatestSample | CallbackRing] = []
        own = self._wire.node_token()
        self._declared.append(session.liveliness().declare_token(own))

        def on_token(sample: zenoh.Sample) -> None:
            token = str(sample.key_expr)
            with self._lock:
                if sample.kind == zenoh.SampleKind.PUT and token != own:
                    self._others.add(token)
                else:
                    self._others.discard(token)

        handler = zenoh.handlers.Callback(on_token, indirect=False)
        tokens = session.liveliness().declare_subscriber(self._wire.others(), handler, history=True)
        self._declared.append(tokens)

    @property
    def others(self) -> int:
        """Number of bridges, or of other nodes of rmw_zenoh."""
        with self._lock:
            return len(self._others)

    def _declare(self, endpoint: Endpoint) -> tuple[str, bytes | None]:
        """Declare an endpoint; its key, and its gid if the wire format has gids."""
        token = self._wire.token(endpoint, next(self._numbers))
        self._declared.append(self.session.liveliness().declare_token(token))
        return self._wire.key(endpoint), gid_of(token) if self._rmw else None

    def subscribe(self, name: str, kind: str, buffer: Buffer, qos: Qos = DEFAULT) -> Buffer:
        """Subscribe to a topic; its samples go to `buffer`."""
        key, _ = self._declare(Endpoint(EntityRole.SUBSCRIBER, name, kind, qos))
        self.buffers.append(buffer)
        self._declared.append(buffer.subscribe(self.session, key))
        return buffer

    def subscribe_to_others(self, name: str, kind: str, buffer: CallbackRing, qos: Qos) -> None:
        """Subscribe to a topic that we publish, too; to a transient_local one with its history."""
        key, _ = self._declare(Endpoint(EntityRole.SUBSCRIBER, name, kind, qos))
        self.buffers.append(buffer)
        handler = zenoh.handlers.Callback(buffer, indirect=False)
        history = None
        if qos.transient_local:
            history = zenoh.ext.HistoryConfig(detect_late_publishers=True)
        subscriber = zenoh.ext.declare_advanced_subscriber(
            self.session, key, handler, allowed_origin=zenoh.Locality.REMOTE, history=history
        )
        self._declared.append(subscriber)

    def listen(self, name: str, kind: str, on_sample: Callable[[zenoh.Sample], None]) -> None:
        """Subscribe to a topic; `on_sample` is called on Zenoh's thread."""
        key, _ = self._declare(Endpoint(EntityRole.SUBSCRIBER, name, kind))
        handler = zenoh.handlers.Callback(on_sample, indirect=False)
        self._declared.append(self.session.declare_subscriber(key, handler))

    def publisher(self, name: str, kind: str, qos: Qos = DEFAULT) -> RosPublisher:
        endpoint = Endpoint(EntityRole.PUBLISHER, name, kind, qos)
        return RosPublisher(self.session, *self._declare(endpoint))

    def serve(self, name: str, kind: str, on_request: Callable[[Request], None]) -> None:
        """Serve a service; `on_request` is called on Zenoh's thread."""
        key, _ = self._declare(Endpoint(EntityRole.SERVER, name, kind))

        def handle(query: zenoh.Query) -> None:
            try:
                request = Request(query, key, self._rmw)
            except CodecError as error:
                with query:
                    query.reply_err(str(error).encode())
                return
            on_request(request)

        handler = zenoh.handlers.Callback(handle, indirect=False)
        self._declared.append(self.session.declare_queryable(key, handler, complete=True))

    def client(self, name: str, kind: str) -> ServiceClient:
        endpoint = Endpoint(EntityRole.CLIENT, name, kind)
        return ServiceClient(self.session, *self._declare(endpoint))

    def action_client(self, name: str, kind: str) -> dict[str, ServiceClient]:
        """Clients of an action's services: ``send_goal``, ``get_result``, ``cancel_goal``."""
        action = Endpoint(EntityRole.ACTION_CLIENT, name, kind)
        parts = parts_of(action)
        if self._rmw:  # there every part is declared; a bridge needs only the action
            return {part: self.client(end.name, end.type) for part, end in parts.items()}
        self._declare(action)
        return {
            part: ServiceClient(self.session, self._wire.key(end), None)
            for part, end in parts.items()
        }

    def close(self) -> None:
        for declared in reversed(self._declared):
            declared.undeclare()
        self._declared.clear()
