"""Our ends in the ROS graph: topics, services and actions over one Zenoh session."""

from __future__ import annotations

import contextlib
import itertools
import threading
import time
from collections.abc import Callable
from typing import Any, TypeVar

import zenoh

from vla_zenoh.bus.buffers import CallbackRing, LatestSample, bytes_of
from vla_zenoh.errors import CodecError
from vla_zenoh.interop.ros2 import attachment as attachments
from vla_zenoh.interop.ros2.attachment import Attachment
from vla_zenoh.interop.ros2.keys import Endpoint, EntityRole, RmwZenoh, Ros2Dds, Wire, parts_of
from vla_zenoh.interop.ros2.messages import Messages
from vla_zenoh.interop.ros2.qos import DEFAULT, Qos
from vla_zenoh.profile.ros2 import Ros2Profile

Slot = TypeVar("Slot", LatestSample, CallbackRing)
Done = Callable[[bytes | None], None]
"""Takes the answer of a service, None where there was none."""

CALL_S = 5.0
"""Longest wait for a service to answer."""

_COMMANDS: dict[str, Any] = {
    "congestion_control": zenoh.CongestionControl.DROP,
    "priority": zenoh.Priority.REAL_TIME,
    "express": True,
}
MAX_ATTACHMENT_BYTES = 1024
_CDR = zenoh.Encoding("application/cdr")


class Writer:
    """Writes one topic."""

    def __init__(self, session: zenoh.Session, key: str, gid: bytes | None) -> None:
        self._publisher = session.declare_publisher(key, encoding=_CDR, **_COMMANDS)
        self._gid = gid
        self._seq = itertools.count(1)

    @property
    def heard(self) -> bool:
        """Somebody listens: with a bridge, a subscriber in DDS."""
        return self._publisher.matching_status.matching  # pyright: ignore  # stub says bool

    def put(self, payload: bytes) -> None:
        """Write CDR bytes."""
        self._publisher.put(payload, attachment=_attachment(self._gid, self._seq))


class Caller:
    """Calls one service."""

    def __init__(self, session: zenoh.Session, key: str, gid: bytes | None, wait_s: float) -> None:
        self._session, self._key, self._gid, self._wait_s = session, key, gid, wait_s
        self._seq = itertools.count(1)

    def call(self, request: bytes, done: Done, wait_s: float | None = None) -> None:
        """Ask; `done` is called once, on Zenoh's thread.

        Args:
            request: CDR bytes.
            done: takes the answer, or None where none came in time.
            wait_s: how long an answer is waited for; None: as long as the caller was made for.
        """
        answers: list[bytes] = []

        def take(reply: zenoh.Reply) -> None:
            if reply.ok is not None:
                with contextlib.suppress(CodecError):  # too large to be an answer
                    answers.append(bytes_of(reply.ok.payload))

        def end() -> None:
            done(answers[0] if answers else None)

        self._session.get(
            self._key,
            zenoh.handlers.Callback(take, end, indirect=False),
            payload=request,
            encoding=_CDR,
            attachment=_attachment(self._gid, self._seq),
            timeout=self._wait_s if wait_s is None else wait_s,
            target=zenoh.QueryTarget.BEST_MATCHING if self._gid is None else _ALL_COMPLETE,
        )


_ALL_COMPLETE = zenoh.QueryTarget.ALL_COMPLETE


def _attachment(gid: bytes | None, seq: itertools.count[int]) -> bytes | None:
    if gid is None:
        return None
    return attachments.encode(Attachment(next(seq), time.time_ns(), gid))


class Request:
    """A call of one of our services, to be answered once, from any thread."""

    def __init__(self, query: zenoh.Query, key: str, with_attachment: bool) -> None:
        self._query, self._key = query, key
        payload = query.payload
        self.payload = bytes_of(payload)
        self._given: Attachment | None = None
        if with_attachment:
            attachment = query.attachment
            self._given = attachments.decode(
                None if attachment is None else bytes_of(attachment, MAX_ATTACHMENT_BYTES)
            )

    def answer(self, response: bytes) -> None:
        """Reply with CDR bytes; number and gid of the request go back with them."""
        given = self._given
        attachment = None
        if given is not None:
            attachment = attachments.encode(Attachment(given.seq, time.time_ns(), given.gid))
        with self._query:
            self._query.reply(self._key, response, encoding=_CDR, attachment=attachment)

    def drop(self, why: str) -> None:
        """Answer with an error, which ROS callers see as no answer."""
        with self._query:
            self._query.reply_err(why.encode())


class RosGraph:
    """See the module.

    Args:
        session: one that reaches the bridge or the router of the robot.
        profile: the section ros2.
        messages: of the robot's distribution.
        node: our name in the ROS graph.
    """

    def __init__(
        self, session: zenoh.Session, profile: Ros2Profile, messages: Messages, node: str
    ) -> None:
        self.session = session
        self._rmw = profile.bridge == "rmw_zenoh"
        session_id = str(session.zid())
        self._wire: Wire
        if self._rmw:
            self._wire = RmwZenoh(session_id, node, profile.domain, messages.hash)
        else:
            hashed = messages.distribution != "humble"
            self._wire = Ros2Dds(session_id, messages.hash if hashed else None)
        self._numbers = itertools.count(1)
        self._lock = threading.Lock()
        self._others: set[str] = set()
        self._declared: list[Any] = []
        self.slots: list[LatestSample | CallbackRing] = []
        """Of all topics that are read."""
        own = self._wire.node_token()
        self._declared.append(session.liveliness().declare_token(own))

        def seen(sample: zenoh.Sample) -> None:
            token = str(sample.key_expr)
            with self._lock:
                if sample.kind == zenoh.SampleKind.PUT and token != own:
                    self._others.add(token)
                else:
                    self._others.discard(token)

        self._declared.append(
            session.liveliness().declare_subscriber(
                self._wire.others(), zenoh.handlers.Callback(seen, indirect=False), history=True
            )
        )

    @property
    def others(self) -> int:
        """Bridges, or nodes of rmw_zenoh, that are there beside us."""
        with self._lock:
            return len(self._others)

    def _declare(self, endpoint: Endpoint) -> tuple[str, bytes | None]:
        """Announce an endpoint; its key, and its gid where the wire has gids."""
        token = self._wire.token(endpoint, next(self._numbers))
        self._declared.append(self.session.liveliness().declare_token(token))
        return self._wire.key(endpoint), attachments.gid_of(token) if self._rmw else None

    def read(self, name: str, kind: str, slot: Slot, qos: Qos = DEFAULT) -> Slot:
        """Let samples of a topic fall into `slot`."""
        key, _ = self._declare(Endpoint(EntityRole.SUBSCRIBER, name, kind, qos))
        self.slots.append(slot)
        handler = zenoh.handlers.Callback(slot, indirect=False)
        if qos.transient_local:
            subscriber = zenoh.ext.declare_advanced_subscriber(
                self.session,
                key,
                handler,
                history=zenoh.ext.HistoryConfig(detect_late_publishers=True),
            )
        else:
            subscriber = self.session.declare_subscriber(key, handler)
        self._declared.append(subscriber)
        return slot

    def write(self, name: str, kind: str, qos: Qos = DEFAULT) -> Writer:
        """A writer of a topic."""
        return Writer(self.session, *self._declare(Endpoint(EntityRole.PUBLISHER, name, kind, qos)))

    def serve(self, name: str, kind: str, take: Callable[[Request], None]) -> None:
        """Take calls of a service of ours, on Zenoh's thread."""
        key, _ = self._declare(Endpoint(EntityRole.SERVER, name, kind))

        def handle(query: zenoh.Query) -> None:
            try:
                request = Request(query, key, self._rmw)
            except CodecError as error:
                with query:
                    query.reply_err(str(error).encode())
                return
            take(request)

        handler = zenoh.handlers.Callback(handle, indirect=False)
        self._declared.append(self.session.declare_queryable(key, handler, complete=True))

    def call(self, name: str, kind: str, wait_s: float = CALL_S) -> Caller:
        """A caller of somebody's service."""
        return Caller(self.session, *self._declare(Endpoint(EntityRole.CLIENT, name, kind)), wait_s)

    def call_action(self, name: str, kind: str) -> dict[str, Caller]:
        """Callers of an action's services: ``send_goal``, ``get_result``, ``cancel_goal``."""
        action = Endpoint(EntityRole.ACTION_CLIENT, name, kind)
        parts = parts_of(action)
        if self._rmw:  # there every part is announced, a bridge is told of the action
            return {part: self.call(end.name, end.type, CALL_S) for part, end in parts.items()}
        self._declare(action)
        return {
            part: Caller(self.session, self._wire.key(end), None, CALL_S)
            for part, end in parts.items()
        }

    def close(self) -> None:
        """Leave the graph."""
        for declared in reversed(self._declared):
            declared.undeclare()
        self._declared.clear()
