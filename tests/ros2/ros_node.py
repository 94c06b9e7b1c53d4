"""A ROS 2 node without ROS: a Cyclone DDS participant that says and names things as rmw does.

Topics are ``rt/<name>``, services ``rq/<name>Request`` and ``rr/<name>Reply``, and the topic
``ros_discovery_info`` tells which readers and writers belong to the node; a bridge takes entities
that are not named there for something other than ROS. Nothing leaves the loopback interface.
"""

from __future__ import annotations

import itertools
import os
import random
import socket
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, Generic, TypeVar

from cyclonedds.core import (
    InstanceState,
    Policy,
    Qos,
    ReadCondition,
    SampleState,
    ViewState,
    WaitSet,
)
from cyclonedds.domain import Domain, DomainParticipant
from cyclonedds.pub import DataWriter
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic
from cyclonedds.util import duration
from ros_messages import Gid, NodeEntitiesInfo, ParticipantEntitiesInfo

LOOPBACK_XML = Path(__file__).with_name("loopback.xml").read_text("utf-8")
"""Cyclone DDS's settings for one computer by itself; for programs in C as ``CYCLONEDDS_URI``."""

DOMAIN_PORTS, FIRST_PORT, FIRST_UNICAST = 250, 7400, 10
DOMAINS = range(20, 100)
"""Of these the ports end below those that Linux gives to programs that want any."""

Request = TypeVar("Request")
Reply = TypeVar("Reply")
Message = TypeVar("Message")


def free_domain() -> int:
    """A DDS domain in which nobody on this computer has a participant."""
    for domain in random.sample(DOMAINS, len(DOMAINS)):
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
            try:
                probe.bind(("", FIRST_PORT + DOMAIN_PORTS * domain + FIRST_UNICAST))
            except OSError:
                continue
            return domain
    raise RuntimeError("every DDS domain is in use")


def qos(
    *, reliable: bool = True, kept: bool = False, depth: int = 10, user_data: str | None = None
) -> Qos:
    """What a ROS 2 publisher or subscription asks for; `kept`: transient local."""
    policies = [
        Policy.Reliability.Reliable(duration(seconds=1))
        if reliable
        else Policy.Reliability.BestEffort,
        Policy.Durability.TransientLocal if kept else Policy.Durability.Volatile,
        Policy.History.KeepLast(depth),
        Policy.DataRepresentation(use_cdrv0_representation=True),
    ]
    if user_data is not None:
        policies.append(Policy.Userdata(user_data.encode()))
    return Qos(*policies)


class RosNode:
    """See the module.

    Args:
        name: of the node.
        domain: ROS domain id.
    """

    _domains: dict[int, Domain] = {}  # noqa: RUF012  one configuration a domain and process

    def __init__(self, name: str, domain: int) -> None:
        if domain not in self._domains:
            # Cyclone DDS would put the variable's settings beside these.
            os.environ.pop("CYCLONEDDS_URI", None)
            self._domains[domain] = Domain(domain, LOOPBACK_XML)
        self.name = name
        self._participant = DomainParticipant(domain, Qos(Policy.Userdata(b"enclave=/;")))
        self._readers: list[DataReader[Any]] = []
        self._writers: list[DataWriter[Any]] = []
        self._info: DataWriter[Any] = DataWriter(
            self._participant,
            Topic(self._participant, "ros_discovery_info", ParticipantEntitiesInfo),
            qos(kept=True, depth=1),
        )
        self._tell()

    def publisher(self, topic: str, kind: type[Message], **how: Any) -> DataWriter[Message]:
        """A writer of `topic` (with its leading slash); `how` as for `qos`."""
        return self.writer(f"rt{topic}", kind, **how)

    def subscription(self, topic: str, kind: type[Message], **how: Any) -> DataReader[Message]:
        """Likewise a reader; `take` it."""
        return self.reader(f"rt{topic}", kind, **how)

    def writer(self, name: str, kind: type[Message], **how: Any) -> DataWriter[Message]:
        """A writer of a DDS topic."""
        topic = Topic(self._participant, name, kind)
        made = DataWriter(self._participant, topic, qos(**how))
        self._writers.append(made)
        self._tell()
        return made

    def reader(self, name: str, kind: type[Message], **how: Any) -> DataReader[Message]:
        """A reader of a DDS topic."""
        topic = Topic(self._participant, name, kind)
        made = DataReader(self._participant, topic, qos(**how))
        self._readers.append(made)
        self._tell()
        return made

    def leave(self, reader: DataReader[Any]) -> None:
        """Give a reader up; the caller has to let go of it, too."""
        self._readers.remove(reader)
        self._tell()

    def client(self, name: str, request: type[Request], reply: type[Reply]) -> Client[Reply]:
        """Of the service `name` (with its leading slash)."""
        return Client(self, name, request, reply)

    def server(
        self,
        name: str,
        request: type[Request],
        reply: type[Reply],
        answer: Callable[[Request], Reply | None],
    ) -> Server:
        """Of the service `name`; call its `poll` now and then."""
        return Server(self, name, request, reply, answer)

    def close(self) -> None:
        """Leave the domain."""
        self._readers.clear()
        self._writers.clear()
        del self._info
        del self._participant

    def _tell(self) -> None:
        me = NodeEntitiesInfo(
            "/",
            self.name,
            [_gid(reader) for reader in self._readers],
            [_gid(writer) for writer in self._writers],
        )
        self._info.write(ParticipantEntitiesInfo(_gid(self._participant), [me]))


def _gid(entity: Any) -> Gid:
    return Gid(list(entity.guid.bytes))


class Client(Generic[Reply]):
    """Asks a service; one question at a time."""

    def __init__(self, node: RosNode, name: str, request: type, reply: type[Reply]) -> None:
        self.name, self._request = name, request
        self._me = random.getrandbits(63)
        user_data = f"clientid= {'.'.join(f'{byte:x}' for byte in self._me.to_bytes(16))};"
        self._ask = node.writer(f"rq{name}Request", request, user_data=user_data)
        self._heard = node.reader(f"rr{name}Reply", reply, user_data=user_data)
        self._numbers = itertools.count(1)

    @property
    def ready(self) -> bool:
        """Whether a server is there, for both ways."""
        asked = self._ask.get_publication_matched_status().current_count
        return asked > 0 and self._heard.get_subscription_matched_status().current_count > 0

    def call(self, *fields: Any, timeout_s: float = 5.0) -> Reply:
        """The reply to a request with these fields.

        Raises:
            TimeoutError: no server, or no reply from it.
        """
        give_up = time.monotonic() + timeout_s
        while not self.ready:
            if time.monotonic() > give_up:
                raise TimeoutError(f"nobody serves {self.name}")
            time.sleep(0.01)
        number = next(self._numbers)
        self._ask.write(self._request(self._me, number, *fields))
        while time.monotonic() < give_up:
            for reply in self._heard.take(10):
                if (reply.client, reply.number) == (self._me, number):
                    return reply
            time.sleep(0.002)
        raise TimeoutError(f"{self.name} does not answer")


class Server:
    """Answers a service whenever it is polled; an answer of None is given later by `reply`."""

    def __init__(
        self,
        node: RosNode,
        name: str,
        request: type,
        reply: type,
        answer: Callable[[Any], Any],
    ) -> None:
        self._answer = answer
        # A server is known by its own id, as a client is by its.
        user_data = f"serviceid= {random.getrandbits(63):x};"
        self._heard = node.reader(f"rq{name}Request", request, user_data=user_data)
        self._say = node.writer(f"rr{name}Reply", reply, user_data=user_data)

    def poll(self) -> None:
        """Answer what was asked since the last time."""
        for request in self._heard.take(10):
            reply = self._answer(request)
            if reply is not None:
                self.reply(reply)

    def reply(self, reply: Any) -> None:
        """Answer a question of before; `reply` names it by client and number."""
        self._say.write(reply)


class Listener:
    """Hands on what arrives at readers, at once, in a thread of its own.

    Args:
        handlers: reader -> what to do with a message and the wall clock at its arrival.
    """

    def __init__(self, handlers: dict[DataReader[Any], Callable[[Any, int], None]]) -> None:
        self._handlers = handlers
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="dds-listener", daemon=True)
        self._thread.start()

    def _run(self) -> None:
        mask = SampleState.NotRead | ViewState.Any | InstanceState.Any
        participant = next(iter(self._handlers)).participant
        anything = WaitSet(participant)
        conditions = [ReadCondition(reader, mask) for reader in self._handlers]
        for condition in conditions:
            anything.attach(condition)
        while not self._stop.is_set():
            anything.wait(duration(milliseconds=100))
            arrived_ns = time.time_ns()
            for reader, handle in self._handlers.items():
                for message in reader.take(100):
                    if message.sample_info.valid_data:
                        handle(message, arrived_ns)

    def close(self) -> None:
        self._stop.set()
        self._thread.join()
