"""What zenoh-bridge-ros2dds says of the DDS domain it serves: participants, and who writes a topic.

The bridge answers queries below ``@/ID/ros2``. The first two bytes of a participant's id name the
maker of its DDS. A request of a service travels inside the payload in Cyclone DDS, and so in the
bridge, and beside it in the others: between these two, no service and no action works.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple

VENDORS = {"0101": "Connext DDS", "010f": "Fast DDS", "0110": "Cyclone DDS", "0111": "GurumDDS"}
"""First bytes of a DDS participant's id, in hexadecimal -> its middleware."""
SERVES = "Cyclone DDS"
"""The one middleware whose services and actions the bridge carries."""

CONFIGS, PARTICIPANTS = "@/*/ros2/config", "@/*/ros2/dds/*"
VIEW_KEYS = (CONFIGS, PARTICIPANTS)
"""Key expressions of the queries for a `BridgeView`."""
MAX_REPLY_BYTES = 256 * 1024
Replies = Iterable[tuple[str, bytes]]
"""Key and JSON of every reply."""


class BridgeView(NamedTuple):
    """Bridges, with the ids of the participants that each sees, and its ROS domain."""

    participants: Mapping[str, frozenset[str]]
    domains: Mapping[str, int | None]

    @property
    def middleware(self) -> dict[str, int]:
        """Middleware -> number of its participants, all bridges together."""
        seen = frozenset().union(*self.participants.values())
        return dict(sorted(Counter(map(vendor_of, seen)).items()))

    @property
    def doubled(self) -> tuple[str, ...]:
        """Bridges that see a participant which another bridge sees, too."""
        found = set[str]()
        for bridge, seen in self.participants.items():
            for other, theirs in self.participants.items():
                if bridge != other and seen & theirs:
                    found |= {bridge, other}
        return tuple(sorted(found))


def vendor_of(participant: str) -> str:
    """Middleware of a participant, by its id in hexadecimal."""
    return VENDORS.get(participant[:4].lower(), f"DDS of vendor {participant[:4].lower()}")


def read_view(replies: Replies) -> BridgeView:
    """The view of all replies to `VIEW_KEYS`; what is no such reply is left out."""
    participants: dict[str, set[str]] = {}
    domains: dict[str, int | None] = {}
    for key, payload in replies:
        chunks = key.split("/")
        if len(chunks) < 4 or chunks[0] != "@" or chunks[2] != "ros2":
            continue
        seen = participants.setdefault(chunks[1], set())
        if chunks[3] == "config":
            domain = read_json(payload).get("domain")
            domains[chunks[1]] = domain if isinstance(domain, int) else None
        elif chunks[3] == "dds" and len(chunks) == 5:
            seen.add(chunks[4])
    return BridgeView({bridge: frozenset(seen) for bridge, seen in participants.items()}, domains)


def endpoints_key(side: str, topic: str) -> str:
    """Key expression of the writers or readers (`side`) of a DDS topic, ``rt/..`` or ``rq/..``."""
    return f"@/*/ros2/dds/*/{side}/*/{topic}"


def route_key(topic: str) -> str:
    """Key expression of a bridge's route from us to the DDS topic of a ROS name, ``/..``."""
    return f"@/*/ros2/route/topic/sub{topic}"


def any_active(replies: Replies) -> bool:
    """Whether a route in replies to `route_key` passes messages on."""
    return any(read_json(payload).get("is_active") is True for _, payload in replies)


def vendors(replies: Replies) -> frozenset[str]:
    """Middleware of the ends in replies to `endpoints_key`."""
    chunks = [key.split("/") for key, _ in replies]
    return frozenset(vendor_of(each[4]) for each in chunks if len(each) > 4)


def any_transient_local(replies: Replies) -> bool:
    """Whether an end in replies to `endpoints_key` is transient_local."""
    for _, payload in replies:
        qos = read_json(payload).get("qos")
        durability = qos.get("durability") if isinstance(qos, dict) else None
        kind = durability.get("kind") if isinstance(durability, dict) else durability
        if kind not in (None, "VOLATILE", 0):
            return True
    return False


def read_json(payload: bytes) -> dict[str, Any]:
    """A JSON object that a bridge replies with; what is none is empty."""
    try:
        found = json.loads(payload)
    except (ValueError, RecursionError):
        return {}
    return found if isinstance(found, dict) else {}
