"""Zenoh sessions of an owner of a robot of physicalai's, and of its clients."""

from __future__ import annotations

import json
from typing import Any

import zenoh

from vla_zenoh.bus.buffers import bytes_of
from vla_zenoh_physicalai.wire import MAX_BYTES, key

ZError = zenoh.ZError


def open_session(mode: str, **endpoints: str) -> zenoh.Session:
    """A session that meets no other by scouting.

    Args:
        mode: ``client`` or ``peer``.
        endpoints: ``connect`` or ``listen``.

    Raises:
        zenoh.ZError: there is nobody, or somebody else listens there.
    """
    config = zenoh.Config()
    settings: dict[str, Any] = {f"{end}/endpoints": [at] for end, at in endpoints.items()}
    settings |= {"mode": mode, "scouting/multicast/enabled": False}
    settings["scouting/gossip/enabled"] = False
    for setting, value in settings.items():
        config.insert_json5(setting, json.dumps(value))
    return zenoh.open(config)


def declare_publisher(session: zenoh.Session, name: str, what: str) -> zenoh.Publisher:
    """A publisher of states or actions: at once, and the newest alone counts."""
    return session.declare_publisher(
        key(name, what),
        reliability=zenoh.Reliability.BEST_EFFORT,
        congestion_control=zenoh.CongestionControl.DROP,
        express=True,
    )


def subscribe(
    session: zenoh.Session, name: str, what: str
) -> zenoh.Subscriber[zenoh.handlers.Handler[zenoh.Sample]]:
    """A subscriber to states or actions of others, which keeps the newest."""
    return session.declare_subscriber(
        key(name, what), zenoh.handlers.RingChannel(1), allowed_origin=zenoh.Locality.REMOTE
    )


def newest(subscriber: zenoh.Subscriber[zenoh.handlers.Handler[zenoh.Sample]]) -> bytes | None:
    """The payload that came last, None if none has come since.

    Raises:
        CodecError: it has more than `MAX_BYTES`.
    """
    sample = subscriber.try_recv()
    return None if sample is None else bytes_of(sample.payload, MAX_BYTES)
