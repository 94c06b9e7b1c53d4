"""Cameras on USB: there, and this user may open them."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

from vla_zenoh.lab.doctor.finding import HostFinding

DEV = Path("/dev")


def video_devices(needed: Sequence[str] = (), dev: Path = DEV) -> HostFinding:
    """Devices the profile names exist, and all there are may be opened.

    Args:
        needed: paths of devices, or their numbers.
        dev: folder of the devices.
    """
    present = sorted(dev.glob("video[0-9]*"))
    wanted = [dev / f"video{name}" if name.isdecimal() else Path(name) for name in needed]
    missing = [str(path) for path in wanted if not path.exists()]
    if missing:
        there = ", ".join(map(str, present)) or "none"
        return HostFinding(
            "video devices",
            "fail",
            f"{', '.join(missing)} not there; devices: {there}",
            "plug the camera in, or correct its source in the profile; in a container: "
            f"--device={missing[0]}",
        )
    closed = [str(path) for path in {*present, *wanted} if not os.access(path, os.R_OK | os.W_OK)]
    if closed:
        return HostFinding(
            "video devices",
            "fail" if wanted else "warn",
            f"no permission: {', '.join(sorted(closed))}",
            "sudo usermod --append --groups video $USER, then log in again",
        )
    return HostFinding("video devices", "ok", ", ".join(map(str, present)) or "none")
