"""Declarations of the camera sources; see `vla_zenoh.plugins`.

Every command that reads a profile with cameras imports this file, so that the sources and their
libraries are imported below.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING
from urllib.parse import urlsplit

from vla_zenoh.plugins import CameraPlugin, FoundCamera
from vla_zenoh.profile.schema import CameraProfile, reachable_address

if TYPE_CHECKING:
    from vla_zenoh.nodes.camera.source import Source


def _v4l2(device: str, profile: CameraProfile) -> Source:
    from vla_zenoh.nodes.camera.opencv_sources import V4l2Source

    return V4l2Source(device, profile)


def _v4l2_connected() -> list[FoundCamera]:
    from vla_zenoh.nodes.camera.v4l2_devices import list_devices

    return [FoundCamera(one.source, one.name, str(one.path)) for one in list_devices()]


def _rtsp(place: str, profile: CameraProfile) -> Source:
    from vla_zenoh.nodes.camera.opencv_sources import RtspSource

    return RtspSource(profile.source)


def _rtsp_fault(place: str) -> str:
    host = place.removeprefix("//").partition("/")[0].rpartition("@")[2]
    if not host or not place.startswith("//"):
        return "lacks the host: write rtsp://HOST/PATH"
    try:
        parts = urlsplit(f"//{host}")
        reachable_address(parts.hostname or "")
        fits = parts.port != 0
    except ValueError as error:
        return f"has a host or port that cannot be: {error}"
    return "" if fits else "has port 0, which leads nowhere"


def _file(path: str, profile: CameraProfile) -> Source:
    from vla_zenoh.nodes.camera.opencv_sources import FileSource

    return FileSource(path, profile.rate_hz)


# Drawn by the camera node from the simulator's scene, and served by the node ros2.
SIM = CameraPlugin(written="sim:CAMERA", has_depth=True)
ROS2 = CameraPlugin(written="ros2:TOPIC", has_depth=True, same_moving_s=2.0)

V4L2 = CameraPlugin(
    written="v4l2:DEVICE", make=_v4l2, has_lens=True, has_locks=True, connected=_v4l2_connected
)
RTSP = CameraPlugin(
    written="rtsp://HOST/PATH", make=_rtsp, check=_rtsp_fault, has_lens=True, same_moving_s=5.0
)
RTSPS = replace(RTSP, written="rtsps://HOST/PATH")
FILE = CameraPlugin(
    written="file:VIDEO_OR_FOLDER", make=_file, is_path=True, has_lens=True, same_moving_s=0.0
)
