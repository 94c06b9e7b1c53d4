"""What the ROS 2 bridge of a profile sees, and what does not work with it."""

from __future__ import annotations

from collections.abc import Iterator

from vla_zenoh.bus.session import open_session
from vla_zenoh.errors import SecurityError, SessionError
from vla_zenoh.lab.doctor.needs import HostFinding
from vla_zenoh.profile import Profile
from vla_zenoh_ros2.middleware import Bridges, bridge_session

NAME = "ROS 2 bridge"


def ros2_bridge(profile: Profile) -> Iterator[HostFinding]:
    """Findings of the host that runs the node ``ros2``, where a bridge is used."""
    ros2 = profile.ros2
    if ros2 is None or ros2.bridge != "ros2dds":
        return
    start = "vla-zenoh profile bridge-config: makes its settings, and prints how to start it"
    try:
        session = open_session(bridge_session(profile), identity="ros2")
    except (SessionError, SecurityError):
        yield HostFinding(NAME, "warn", "not reached: it does not run, or its router", start)
        return
    with session:
        bridges = Bridges(session, profile)
        view = bridges.view()
        faults = dict(bridges.faults(view))
    if not view.participants:
        yield HostFinding(NAME, "warn", "none answers", start)
        return
    seen = ", ".join(f"{name} ({count})" for name, count in view.middleware.items())
    yield HostFinding(NAME, "ok", f"sees participants of {seen or 'no ROS node yet'}")
    for what, why in faults.items():
        yield HostFinding(NAME, "warn", what.replace("_", " "), why)
