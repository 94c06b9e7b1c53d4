"""Which cameras Video4Linux has on this computer, and which a profile means; needs no OpenCV."""

from __future__ import annotations

import re
from pathlib import Path
from typing import NamedTuple

from vla_zenoh.errors import NodeError

DEV, SYS = Path("/dev"), Path("/sys/class/video4linux")
NUMBER_DIGITS = 3
"""More digits are a serial number."""
_FIRST = re.compile(r"^usb-(.+)-video-index0$")


class V4l2Device(NamedTuple):
    """A camera of Video4Linux.

    Args:
        path: ``/dev/videoN``, which may be another one after it was plugged in again.
        name: as its driver calls it.
        serial: of the USB device; empty: none.
        by_id: its name in ``/dev/v4l/by-id``; empty: none.
    """

    path: Path
    name: str
    serial: str
    by_id: str

    @property
    def source(self) -> str:
        """How to write it in a profile, so that it is the same camera after a restart."""
        return f"v4l2:{self.serial or self.by_id or self.path}"


def list_devices(dev: Path = DEV, sys: Path = SYS) -> list[V4l2Device]:
    """Every camera, by its first device: the others of one camera give no images."""
    links = {link.resolve().name: link.name for link in _entries(dev / "v4l" / "by-id")}
    found: list[V4l2Device] = []
    for folder in sorted(_entries(sys), key=lambda one: (len(one.name), one.name)):
        if not folder.name.startswith("video") or _text(folder / "index") not in ("", "0"):
            continue
        # The interface of the USB device; the device itself is above it.
        usb = (folder / "device").resolve().parent
        by_id = links.get(folder.name, "")
        name = _text(folder / "name")
        found.append(V4l2Device(dev / folder.name, name, _text(usb / "serial"), by_id))
    return found


def find_device(wanted: str, dev: Path = DEV, sys: Path = SYS) -> Path:
    """The device that a profile means by a path, a number of ``/dev/videoN``, a serial number, or a
    name in ``/dev/v4l/by-id``.

    Raises:
        NodeError: no camera has this serial number, or two have; says which there are.
    """
    if "/" in wanted:
        return Path(wanted)
    if wanted.isdecimal() and len(wanted) <= NUMBER_DIGITS:
        return dev / f"video{wanted}"
    devices = list_devices(dev, sys)
    named = [
        one for one in devices if wanted in (one.serial, one.by_id, _FIRST.sub(r"\1", one.by_id))
    ]
    if len(named) > 1:
        paths = ", ".join(str(one.path) for one in named)
        raise NodeError(
            f"{paths} all have the serial number {wanted!r}: name them by their place, as "
            f"v4l2:{dev}/v4l/by-path/..."
        )
    if not named:
        there = ", ".join(f"{one.source} ({one.name})" for one in devices) or "none"
        raise NodeError(
            f"there is no camera with the serial number or name {wanted!r}; cameras here: {there}"
        )
    return named[0].path


def _entries(folder: Path) -> list[Path]:
    try:
        return list(folder.iterdir())
    except OSError:
        return []


def _text(path: Path) -> str:
    try:
        return path.read_text("utf-8", "replace").strip()
    except OSError:
        return ""
