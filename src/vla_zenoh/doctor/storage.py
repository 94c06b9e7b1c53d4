"""Room in shared memory and on disk."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

from vla_zenoh.doctor.finding import Finding

MIB = 1024 * 1024
SHARED_MEMORY_WANTED_MIB = 256
"""Each Zenoh session that sends pictures takes a pool of 16 MiB; a lab has up to ten of them."""
DISK_WANTED_MIB = 2048
DISK_NEEDED_MIB = 200

SHARED_MEMORY = Path("/dev/shm")
PROC = Path("/proc")


def shared_memory(
    folder: Path = SHARED_MEMORY, wanted_mib: int = SHARED_MEMORY_WANTED_MIB
) -> Finding:
    """Pictures find room in shared memory; else they go through sockets, five times slower."""
    advice = (
        f"sudo mount -o remount,size={wanted_mib}M {folder}; "
        f"in a container: --shm-size={wanted_mib}m"
    )
    if not os.access(folder, os.W_OK):
        return Finding("shared memory", "warn", f"{folder} cannot be written", advice)
    free_mib = shutil.disk_usage(folder).free // MIB
    found = f"{free_mib} MiB free in {folder}"
    if free_mib < wanted_mib:
        return Finding("shared memory", "warn", found, advice)
    return Finding("shared memory", "ok", found)


def left_segments(folder: Path = SHARED_MEMORY, proc: Path = PROC) -> Finding:
    """No killed process has left its Zenoh shared memory behind."""
    segments = {path: _size(path) for path in folder.glob("*.zenoh")}
    used, all_seen = _mapped(proc)
    left = {path: size for path, size in segments.items() if str(path) not in used}
    if not left:
        return Finding("left shared memory", "ok", f"none; {len(segments)} segments in use")
    found = f"{len(left)} Zenoh segments, {sum(left.values()) // MIB} MiB"
    if not all_seen:
        return Finding(
            "left shared memory",
            "ok",
            f"{found} belong to nobody or to processes of other users",
        )
    return Finding(
        "left shared memory",
        "warn",
        f"{found}, left by processes that were killed",
        "the next Zenoh session on this host removes them; by hand: "
        f"rm {' '.join(str(path) for path in sorted(left))}",
    )


def disk(folder: Path | None = None, wanted_mib: int = DISK_WANTED_MIB) -> Finding:
    """Recordings and pictures of runs find room."""
    folder = folder or Path.cwd()
    free_mib = shutil.disk_usage(folder).free // MIB
    found = f"{free_mib / 1024:.1f} GiB free in {folder}"
    if free_mib >= wanted_mib:
        return Finding("disk", "ok", found)
    level = "fail" if free_mib < min(DISK_NEEDED_MIB, wanted_mib) else "warn"
    return Finding("disk", level, found, "free some, or work in a folder on another disk")


def _size(path: Path) -> int:
    try:
        return path.stat().st_size
    except OSError:
        return 0


def _mapped(proc: Path) -> tuple[set[str], bool]:
    """Zenoh segments that processes have mapped, and whether all processes could be read."""
    used: set[str] = set()
    all_seen = True
    for maps in proc.glob("[0-9]*/maps"):
        try:
            lines = maps.read_text(errors="replace").splitlines()
        except PermissionError:
            all_seen = False
            continue
        except OSError:  # it ended while we looked
            continue
        used.update(line[line.index("/") :] for line in lines if ".zenoh" in line and "/" in line)
    return used, all_seen
