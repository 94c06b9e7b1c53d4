"""Zenoh's side of R2C: what robots and policies of others publish, in buffers with limits."""

from __future__ import annotations

import zenoh

from vla_zenoh.bus.buffers import SampleBuffer
from vla_zenoh.bus.session import open_session
from vla_zenoh.profile import Profile


def connected(profile: Profile, endpoint: str = "") -> zenoh.Session:
    """A session at the profile's router, or at another `endpoint`.

    Raises:
        SessionError: no router answers.
    """
    return open_session(profile.session, connect=(endpoint,) if endpoint else None)


def listen(session: zenoh.Session, key: str, buffer: SampleBuffer) -> None:
    """Let a buffer receive what others publish, until the session is closed."""
    received = zenoh.handlers.Callback(buffer, indirect=False)
    session.declare_subscriber(key, received, allowed_origin=zenoh.Locality.REMOTE)


def declare(session: zenoh.Session, key: str) -> zenoh.Publisher:
    """A publisher with the quality of service of R2C's own: reliable, dropped where full."""
    return session.declare_publisher(
        key,
        reliability=zenoh.Reliability.RELIABLE,
        congestion_control=zenoh.CongestionControl.DROP,
        express=True,
    )
