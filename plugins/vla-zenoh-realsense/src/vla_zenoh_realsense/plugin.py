"""Declaration of the camera source; see `vla_zenoh.plugins`."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

from vla_zenoh.plugins import CameraPlugin, FoundCamera
from vla_zenoh.profile.schema import CameraProfile

if TYPE_CHECKING:
    from vla_zenoh.nodes.camera.source import Source


def _make(serial: str, profile: CameraProfile) -> Source:
    from vla_zenoh_realsense.source import RealsenseSource

    return RealsenseSource(serial, profile)


def _connected() -> Iterator[FoundCamera]:
    from vla_zenoh_realsense.source import connected, sdk

    info = sdk().camera_info
    for one in connected():
        usb = info.usb_type_descriptor
        yield FoundCamera(
            source=f"realsense:{one.get_info(info.serial_number)}",
            name=one.get_info(info.name),
            device=one.get_info(usb) if one.supports(usb) else "",
        )


PLUGIN = CameraPlugin(
    written="realsense:SERIAL",
    make=_make,
    has_lens=True,
    has_intrinsics=True,
    has_depth=True,
    has_locks=True,
    connected=_connected,
    maker="RealSense",
)
