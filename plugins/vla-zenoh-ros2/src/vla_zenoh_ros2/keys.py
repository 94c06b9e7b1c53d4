"""Names, key expressions and attachments of the ROS 2 side, for both transports: the only file
with such text.

``ros2dds``: the names zenoh-bridge-ros2dds gives to topics and services, and the liveliness tokens
by which bridges tell each other what to route. ``rmw_zenoh``: those of robots that run rmw_zenoh.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum
from hashlib import blake2b
from typing import NamedTuple

from vla_zenoh.errors import CodecError
from vla_zenoh_ros2.messages import split_type

CANCEL_GOAL = "action_msgs/srv/CancelGoal"
_SLASH_OF_BRIDGES = "§"
_SLASH_OF_RMW = "%"
GID_BYTES = 16
_ATTACHMENT = struct.Struct(f"<qqB{GID_BYTES}s")


def dds_type(kind: str) -> str:
    """``sensor_msgs/msg/Image`` -> ``sensor_msgs::msg::dds_::Image_``."""
    package, room, name = split_type(kind)
    return f"{package}::{room}::dds_::{name}_"


_DDS_TYPE = re.compile(r"([a-z][a-z0-9_]*)::(msg|srv|action)::dds_::([A-Za-z]\w*)_")


def ros_type(dds: str) -> str | None:
    """The reverse of `dds_type`; None: it is no type of ROS."""
    match = _DDS_TYPE.fullmatch(dds)
    return None if match is None else "/".join(match.groups())


class Operation(NamedTuple):
    """A request of a ROS user: the last part and type of its topic, and those of its service."""

    name: str
    type: str
    service: str
    service_type: str


TEXT, BOOL, EMPTY = "std_msgs/msg/String", "std_msgs/msg/Bool", "std_msgs/msg/Empty"
_TRIGGER = "std_srvs/srv/Trigger"
STOP = Operation("stop", EMPTY, "stop", _TRIGGER)
RESET = Operation("reset", EMPTY, "reset", _TRIGGER)
ACTIVE = Operation("active", BOOL, "set_active", "std_srvs/srv/SetBool")
PROMPT = Operation("prompt", TEXT, "set_prompt", "vla_msgs/srv/SetPrompt")
REQUEST = Operation("request", TEXT, "set_request", "vla_msgs/srv/SetRequest")
OPERATIONS = (STOP, RESET, ACTIVE, PROMPT, REQUEST)

ANSWER_TOPIC, STATUS_TOPIC = "answer", "status"
ROSOUT, LOG = "/rosout", "rcl_interfaces/msg/Log"


# -- endpoints -----------------------------------------------------------------------------------
@dataclass(frozen=True, slots=True)
class Qos:
    """The used part of a ROS 2 QoS profile; history is always the last `depth` samples."""

    depth: int = 10
    reliable: bool = True
    transient_local: bool = False

    def as_ros2dds(self, type_hash: str | None) -> str:
        """As in the bridge's tokens: key-less, DDS's numbers, and the hash as user data."""
        text = f":{int(self.reliable)}:{int(self.transient_local)}:0,{self.depth}"
        return text if type_hash is None else f"{text}:typehash={type_hash};"

    def as_rmw_zenoh(self) -> str:
        """As in rmw_zenoh's tokens: what is the default (reliable, volatile) is left out."""
        reliability = "" if self.reliable else "2"
        durability = "1" if self.transient_local else ""
        return f"{reliability}:{durability}:,{self.depth}:,:,:,,"


DEFAULT = Qos()
SENSOR = Qos(depth=5, reliable=False)
"""rclcpp's SensorDataQoS: matches both reliable and best-effort publishers."""
COMMAND = Qos(depth=1)
"""Setpoints: reliable, so that it matches every subscriber; the newest replaces older ones."""
LATCHED = Qos(transient_local=True)
"""What somebody who comes late should read as well."""


class EntityRole(Enum):
    """Our end of a topic, service or action; the value is its name in liveliness tokens."""

    PUBLISHER = "MP"
    SUBSCRIBER = "MS"
    SERVER = "SS"
    CLIENT = "SC"
    ACTION_CLIENT = "AC"


@dataclass(frozen=True, slots=True)
class Endpoint:
    """One of our ends in the ROS graph: of a topic, service or action.

    `name` is the full one with its leading slash, `type` the ROS type; `qos` is that of a topic.
    """

    role: EntityRole
    name: str
    type: str
    qos: Qos = DEFAULT


def parts_of(action: Endpoint) -> dict[str, Endpoint]:
    """The services an action client uses: send_goal, get_result and cancel_goal."""
    kinds = {
        "send_goal": f"{action.type}_SendGoal",
        "get_result": f"{action.type}_GetResult",
        "cancel_goal": CANCEL_GOAL,
    }
    return {
        part: Endpoint(EntityRole.CLIENT, f"{action.name}/_action/{part}", kind)
        for part, kind in kinds.items()
    }


@dataclass(frozen=True, slots=True)
class Ros2Dds:
    """zenoh-bridge-ros2dds: a key is the name without its first slash, payloads are plain CDR.

    `type_hash` gives the hash of a type; None where the distribution has none.
    """

    session_id: str
    type_hash: Callable[[str], str] | None

    def key(self, endpoint: Endpoint) -> str:
        """The key of its samples or queries."""
        return endpoint.name.removeprefix("/")

    def token(self, endpoint: Endpoint, number: int) -> str:
        """The liveliness token that makes it seen; an action has one for all its parts."""
        kind, key = endpoint.type, self.key(endpoint)
        chunks = [self.node_token(), endpoint.role.value]
        chunks += [text.replace("/", _SLASH_OF_BRIDGES) for text in (key, kind)]
        if endpoint.role in (EntityRole.PUBLISHER, EntityRole.SUBSCRIBER):
            known = None if self.type_hash is None else self.type_hash(kind)
            chunks.append(endpoint.qos.as_ros2dds(known))
        return "/".join(chunks)

    def node_token(self) -> str:
        """Token that a bridge declares."""
        return f"@/{self.session_id}/@ros2_lv"

    def others(self) -> str:
        """Key expression of the tokens of all bridges."""
        return "@/*/@ros2_lv"


@dataclass(frozen=True, slots=True)
class RmwZenoh:
    """rmw_zenoh: a key is domain, name, type and hash.

    `node` is our name in the ROS graph, in the root namespace; `type_hash` gives the hash of a
    type, or what stands in its place.
    """

    session_id: str
    node: str
    domain: int
    type_hash: Callable[[str], str]

    def key(self, endpoint: Endpoint) -> str:
        name, kind = endpoint.name.strip("/"), endpoint.type
        return f"{self.domain}/{name}/{dds_type(kind)}/{self.type_hash(kind)}"

    def token(self, endpoint: Endpoint, number: int) -> str:
        """The liveliness token that makes it seen; each endpoint has another `number`."""
        at, name = self._at(number, endpoint.role.value), endpoint.name.replace("/", _SLASH_OF_RMW)
        kind, hashed = dds_type(endpoint.type), self.type_hash(endpoint.type)
        return f"{at}/{name}/{kind}/{hashed}/{endpoint.qos.as_rmw_zenoh()}"

    def node_token(self) -> str:
        """Liveliness token of the node itself."""
        return self._at(0, "NN")

    def others(self) -> str:
        """Key expression of the tokens of all nodes."""
        return f"@ros2_lv/{self.domain}/*/*/*/NN/**"

    def _at(self, number: int, role: str) -> str:
        root = _SLASH_OF_RMW  # enclave and namespace
        return (
            f"@ros2_lv/{self.domain}/{self.session_id}/0/{number}/{role}/{root}/{root}/{self.node}"
        )


class Announced(NamedTuple):
    """An end of a topic or service that a node of rmw_zenoh announces: what its token says."""

    domain: int
    role: str
    node: str
    name: str
    type: str
    type_hash: str


TOKENS_OF_RMW = "@ros2_lv/**"
"""Key expression of all tokens of rmw_zenoh, in every domain."""
_ANNOUNCED, DOMAIN_DIGITS = 13, 3
"""Chunks of the token of an end; digits of its domain."""


def read_token(token: str) -> Announced | None:
    """What a token of rmw_zenoh says; None: it is none of an end in a ROS graph."""
    chunks = token.split("/")
    if len(chunks) != _ANNOUNCED or chunks[0] != "@ros2_lv":
        return None
    if not (chunks[1].isdecimal() and len(chunks[1]) <= DOMAIN_DIGITS):
        return None
    kind = ros_type(chunks[10])
    if kind is None:
        return None
    name = chunks[9].replace(_SLASH_OF_RMW, "/")
    return Announced(int(chunks[1]), chunks[5], chunks[8], name, kind, chunks[11])


Wire = Ros2Dds | RmwZenoh
"""How the ROS side names and announces endpoints."""


# -- attachments of rmw_zenoh ----------------------------------------------------------------------
class Attachment(NamedTuple):
    """Sequence number, source time and writer of a sample, request or reply.

    A ROS 2 subscriber drops samples without it; a reply repeats number and gid of its request.
    """

    seq: int
    stamp_ns: int
    gid: bytes

    def encode(self) -> bytes:
        """33 bytes: ``int64 seq, int64 stamp_ns, uint8 16, 16 bytes gid``, little-endian."""
        return _ATTACHMENT.pack(self.seq, self.stamp_ns, GID_BYTES, self.gid)

    @classmethod
    def decode(cls, payload: bytes | None) -> Attachment:
        """Read the 33 bytes, or raise a `CodecError`: ``no_attachment``, or ``malformed``."""
        if payload is None:
            raise CodecError("no_attachment", "rmw_zenoh sends an attachment with everything")
        if len(payload) != _ATTACHMENT.size:
            why = f"an attachment of {len(payload)} bytes, wanted {_ATTACHMENT.size}"
            raise CodecError("malformed", why)
        seq, stamp_ns, length, gid = _ATTACHMENT.unpack(payload)
        if length != GID_BYTES or seq < 0 or stamp_ns < 0:
            raise CodecError("malformed", "an attachment of another layout")
        return cls(seq, stamp_ns, gid)


def gid_of(token: str) -> bytes:
    """GID of a writer: 16 bytes derived from its liveliness token, which is unique."""
    return blake2b(token.encode(), digest_size=GID_BYTES).digest()
