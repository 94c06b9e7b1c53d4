"""Which source a profile's words mean."""

from __future__ import annotations

from vla_zenoh.errors import NodeError
from vla_zenoh.nodes.camera.file import FileSource
from vla_zenoh.nodes.camera.rtsp import RtspSource
from vla_zenoh.nodes.camera.source import Source
from vla_zenoh.nodes.camera.v4l2 import V4l2Source
from vla_zenoh.profile import Profile
from vla_zenoh.profile.schema import CameraProfile

SIM, ROS2 = "sim:", "ros2:"


def choose_cameras(profile: Profile, cameras: tuple[str, ...] | None) -> dict[str, CameraProfile]:
    """The cameras asked for, or all that are not ROS 2's.

    Raises:
        NodeError: there is no such camera, it is not ours to serve, or none is left.
    """
    ours = {
        name: camera
        for name, camera in profile.cameras.items()
        if not camera.source.startswith(ROS2)
    }
    known = f"this node can serve: {', '.join(ours) or 'none'}"
    for name in cameras or ():
        if name not in profile.cameras:
            raise NodeError(f"profile {profile.name!r} has no camera {name!r}; {known}")
        if name not in ours:
            raise NodeError(f"camera {name!r} comes from ROS 2, the ros2 node serves it; {known}")
    chosen = ours if cameras is None else {name: ours[name] for name in cameras}
    if not chosen:
        raise NodeError(f"profile {profile.name!r} has no camera for this node to serve")
    return chosen


def make_source(profile: CameraProfile) -> Source:
    """The source of a camera that has a thread of its own.

    Raises:
        NodeError: the source is none of these.
    """
    kind, _, rest = profile.source.partition(":")
    if kind == "v4l2":
        return V4l2Source(rest, profile)
    if kind in ("rtsp", "rtsps"):
        return RtspSource(profile.source)
    if kind == "file":
        return FileSource(rest, profile.rate_hz, profile.loop)
    raise NodeError(f"no camera source called {kind!r}; there are: v4l2, rtsp, rtsps, file, sim")
