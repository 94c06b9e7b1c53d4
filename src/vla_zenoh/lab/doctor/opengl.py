"""Whether pictures of the simulator can be drawn by OpenGL without a screen."""

from __future__ import annotations

from vla_zenoh.errors import NodeError
from vla_zenoh.lab.doctor.finding import HostFinding
from vla_zenoh.simulation.render import RAYCAST, VARIABLE, Backend, choose_backend

NAME = "pictures"


def opengl(wanted: str | None = None) -> HostFinding:
    """What the simulator will draw with.

    Args:
        wanted: ``auto`` or the way to draw that is asked for; None: as the environment says.
    """
    try:
        return judge(choose_backend(wanted))
    except NodeError as error:
        advice = f"do what it says, or let the simulator choose: unset {VARIABLE}"
        return HostFinding(NAME, "fail", str(error), advice)


def judge(backend: Backend) -> HostFinding:
    """What was chosen, in words."""
    if backend.name != RAYCAST:
        return HostFinding(NAME, "ok", f"drawn by OpenGL through {backend.name}")
    if not backend.reason:
        return HostFinding(NAME, "ok", "ray cast, as asked for")
    return HostFinding(
        NAME,
        "warn",
        f"ray cast, which is slower: no OpenGL without a screen ({backend.reason})",
        f"sudo apt install {backend.install} (with an NVIDIA card also its driver's libnvidia-gl; "
        "in a container with one: NVIDIA_DRIVER_CAPABILITIES=all)",
    )
