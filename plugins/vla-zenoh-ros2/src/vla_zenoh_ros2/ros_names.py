"""What the nodes of a ROS domain publish, subscribe to and serve, as a bridge or rmw_zenoh says."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any, Literal

from vla_zenoh_ros2.bridge_view import SERVES, Replies, read_json, read_view, vendor_of
from vla_zenoh_ros2.keys import EntityRole, read_token, ros_type
from vla_zenoh_ros2.messages import NO_HASH

ENTITIES = "@/*/ros2/dds/*/*/*/**"
"""Key expression of the bridges' writers and readers in DDS."""
DOMAINS = range(233)
OURS = "vla_"
"""Names of our own nodes begin with it."""
_GOAL, _GOAL_TYPE = "/_action/send_goal", "_SendGoal"
_HASHED = b"typehash="


@dataclass
class RosDomain:
    """A ROS domain that a Zenoh session reaches.

    Args:
        bridge: how; as in a profile.
        number: of the domain.
        published: topic -> type, and so in the others.
        hashed: types have hashes, as in every distribution since Iron.
        unreached: services and actions which the bridge carries no call to -> their middleware.
    """

    bridge: Literal["ros2dds", "rmw_zenoh"]
    number: int
    published: dict[str, str] = field(default_factory=dict)
    subscribed: dict[str, str] = field(default_factory=dict)
    services: dict[str, str] = field(default_factory=dict)
    actions: dict[str, str] = field(default_factory=dict)
    hashed: bool = False
    unreached: dict[str, str] = field(default_factory=dict)

    @property
    def way(self) -> str:
        """How it is reached, in words."""
        through = "zenoh-bridge-ros2dds" if self.bridge == "ros2dds" else "rmw_zenoh"
        return f"{through}, domain {self.number}"

    @property
    def distribution(self) -> Literal["humble", "jazzy"]:
        """One whose types have these hashes: they are the same from Iron to Lyrical."""
        return "jazzy" if self.hashed else "humble"

    def serves(self, name: str, kind: str, middleware: str = SERVES) -> None:
        """Note a service, of an action that to begin a goal."""
        if name.endswith(_GOAL) and kind.endswith(_GOAL_TYPE):
            name = name.removesuffix(_GOAL)
            self.actions[name] = kind.removesuffix(_GOAL_TYPE)
        else:
            self.services[name] = kind
        if middleware != SERVES:
            self.unreached[name] = middleware


def domains_of_bridges(replies: Replies) -> list[RosDomain]:
    """Domains that bridges serve, by their replies to `CONFIGS` and `ENTITIES`."""
    replies = list(replies)
    served = read_view(replies).domains.items()
    numbers = {one: domain if domain and domain in DOMAINS else 0 for one, domain in served}
    found = {number: RosDomain("ros2dds", number) for number in numbers.values()}
    for key, payload in replies:
        # @/BRIDGE/ros2/dds/PARTICIPANT/SIDE/ID/TOPIC
        chunks = key.split("/", 7)
        if len(chunks) == 8 and chunks[3] == "dds" and chunks[1] in numbers:
            domain = found[numbers[chunks[1]]]
            _entity(domain, vendor_of(chunks[4]), chunks[5], chunks[7], read_json(payload))
    return list(found.values())


def _entity(domain: RosDomain, vendor: str, side: str, topic: str, said: dict[str, Any]) -> None:
    kind = ros_type(str(said.get("type_name")))
    room, _, name = topic.partition("/")
    if kind is None:
        return
    if room == "rt":
        at = domain.published if side == "writer" else domain.subscribed
        at[f"/{name}"] = kind
        domain.hashed |= _HASHED in _user_data(said)
    elif room == "rq" and side == "reader" and name.endswith("Request"):
        domain.serves(f"/{name.removesuffix('Request')}", kind.removesuffix("_Request"), vendor)


def _user_data(said: dict[str, Any]) -> bytes:
    qos = said.get("qos")
    given = qos.get("user_data") if isinstance(qos, dict) else None
    try:
        return bytes(given) if isinstance(given, list) else b""
    except (TypeError, ValueError):
        return b""


def domains_of_rmw(tokens: Iterable[str]) -> list[RosDomain]:
    """Domains of nodes with rmw_zenoh, by their liveliness tokens."""
    found: dict[int, RosDomain] = {}
    for end in filter(None, map(read_token, tokens)):
        if end.node.startswith(OURS) or end.domain not in DOMAINS:
            continue
        domain = found.setdefault(end.domain, RosDomain("rmw_zenoh", end.domain))
        if end.role == EntityRole.PUBLISHER.value:
            domain.published[end.name] = end.type
        elif end.role == EntityRole.SUBSCRIBER.value:
            domain.subscribed[end.name] = end.type
        elif end.role == EntityRole.SERVER.value:
            domain.serves(end.name, end.type)
        domain.hashed |= end.type_hash != NO_HASH
    return list(found.values())
