"""Room in shared memory and on disk."""

from __future__ import annotations

import fcntl
import os
import shutil
from pathlib import Path

from vla_zenoh.lab.doctor.finding import HostFinding

MIB = 1024 * 1024
SHARED_MEMORY_WANTED_MIB = 256
"""Each Zenoh session that sends pictures takes a pool of 16 MiB; a lab has up to ten of them."""
DISK_WANTED_MIB = 2048
DISK_NEEDED_MIB = 200

SHARED_MEMORY = Path("/dev/shm")


def shared_memory(
    folder: Path = SHARED_MEMORY, wanted_mib: int = SHARED_MEMORY_WANTED_MIB
) -> HostFinding:
    """Pictures find room in shared memory; else they go through sockets, five times slower."""
    advice = (
        f"sudo mount -o remount,size={wanted_mib}M {folder}; "
        f"in a container: --shm-size={wanted_mib}m"
    )
    if not os.access(folder, os.W_OK):
        return HostFinding("shared memory", "warn", f"{folder} cannot be written", advice)
    free_mib = shutil.disk_usage(folder).free // MIB
    found = f"{free_mib} MiB free in {folder}"
    if free_mib < wanted_mib:
        return HostFinding("shared memory", "warn", found, advice)
    return HostFinding("shared memory", "ok", found)


def left_segments(folder: Path = SHARED_MEMORY) -> HostFinding:
    """No killed process of this user has left its Zenoh shared memory behind."""
    segments = sorted(folder.glob("*.zenoh"))
    left = [path for path in segments if _is_left(path)]
    if not left:
        in_use = f"{len(segments)} segments in use" if segments else "no segments at all"
        return HostFinding("left shared memory", "ok", f"none; {in_use}")
    size_mib = sum(_size(path) for path in left) // MIB
    return HostFinding(
        "left shared memory",
        "warn",
        f"{len(left)} Zenoh segments, {size_mib} MiB, left by processes that were killed",
        "the next Zenoh session on this host removes them; by hand: rm "
        + " ".join(str(path) for path in left),
    )


def disk(folder: Path | None = None, wanted_mib: int = DISK_WANTED_MIB) -> HostFinding:
    """Recordings and pictures of runs find room."""
    folder = folder or Path.cwd()
    free_mib = shutil.disk_usage(folder).free // MIB
    found = f"{free_mib / 1024:.1f} GiB free in {folder}"
    if free_mib >= wanted_mib:
        return HostFinding("disk", "ok", found)
    level = "fail" if free_mib < min(DISK_NEEDED_MIB, wanted_mib) else "warn"
    return HostFinding("disk", level, found, "free some, or work in a folder on another disk")


def _size(path: Path) -> int:
    try:
        return path.stat().st_size
    except OSError:
        return 0


def _is_left(segment: Path) -> bool:
    """Whether no process holds `segment`: each that uses it keeps a shared lock on it."""
    try:
        with segment.open("rb") as file:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:  # in use, gone meanwhile, or another user's
        return False
    return True
