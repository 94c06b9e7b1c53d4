"""Diagnosis of a host: what is missing, and the package or setting that helps."""

from __future__ import annotations

import platform
from collections.abc import Callable, Iterator

from vla_zenoh.bus.shared_memory import lockable_bytes
from vla_zenoh.lab.doctor.access import router
from vla_zenoh.lab.doctor.computer import (
    disk,
    governor,
    locked_memory,
    niceness,
    processors,
    real_time_priority,
    shared_memory,
    video_devices,
    wall_clock,
)
from vla_zenoh.lab.doctor.needs import HostFinding, Level, Needs, Role, needs_of
from vla_zenoh.lab.doctor.software import libraries, opengl

__all__ = ["HostFinding", "Level", "Needs", "Role", "examine", "needs_of"]

ROLES: tuple[Role, ...] = ("base", "camera", "control", "sim")


def examine(needs: Needs, try_zenoh: Callable[[str], str]) -> Iterator[HostFinding]:
    """Run all checks; yields each finding as soon as it is made. Some take seconds.

    Args:
        try_zenoh: opens a session at an endpoint and closes it; returns why that failed, or "".
    """
    yield HostFinding("Python", "ok", platform.python_version())  # pip refuses an older one
    results = {role: libraries(role, required=role in needs.roles) for role in ROLES}
    yield from results.values()
    if results["sim"].level == "ok":
        yield opengl()
    yield processors()
    yield governor()
    yield real_time_priority()
    yield niceness()
    yield shared_memory()
    yield locked_memory(lockable_bytes())
    yield disk()
    for endpoint in needs.endpoints:
        yield router(endpoint, is_router=needs.is_router, try_zenoh=try_zenoh)
    yield wall_clock()
    yield video_devices(needs.devices)
