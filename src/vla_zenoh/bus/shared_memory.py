"""Shared memory between the processes of one host: whether a session may use it, and its figures.

Zenoh locks every segment that it maps, also those of other processes. One that it may not lock it
cannot read, and drops the message without an error (eclipse-zenoh/zenoh#2788). And it keeps what it
mapped until its own process ends: a sender that is restarted leaves its segments in every reader
(#2787). So our senders use no shared memory once the host's segments have `HOST_BYTES`, and a
process that may not lock that much uses none from the start: its messages are then copied through
its socket.
"""

from __future__ import annotations

import sys
from functools import cache
from pathlib import Path
from typing import Any

POOL_BYTES = 8 * 1024 * 1024
"""Segment for the payloads of a sender: eight colour images of 640 x 480. One that does not fit is
copied through the socket."""
LARGE_BYTES = 32 * 1024
"""Payloads from this size on, images, use shared memory. Every sender of one needs a pool, which
all its readers lock: a status is not worth it."""
METADATA_BYTES = 40 * 32_768
"""Segment with the state of a sender's buffers, in Zenoh 1.10."""
SENDER_BYTES = POOL_BYTES + METADATA_BYTES
HOST_BYTES = 14 * SENDER_BYTES
"""Segments on a host with which a sender that starts uses none: as many cameras and restarts."""
LOCK_BYTES = 2 * HOST_BYTES
"""A process must be permitted to lock this much: twice, since senders that start together do not
see each other's segments yet, and other programs make their own."""
FREE_IT = "restart the router and what reads images (`vla-zenoh up`)"

_FOLDER = Path("/dev/shm")
_CAP_IPC_LOCK = 14


@cache
def obstacle() -> str:
    """Why this process uses no shared memory; empty if it may. Decided once, when it is asked
    first."""
    may_lock = lockable_bytes()
    if may_lock is not None and may_lock < LOCK_BYTES:
        return (
            f"this user may lock {in_mib(may_lock)} of memory (`ulimit -l`), and shared memory "
            f"needs {in_mib(LOCK_BYTES)}: images are copied through sockets"
        )
    held = held_bytes()
    if held + SENDER_BYTES > HOST_BYTES:
        return (
            f"programs of this host hold {in_mib(held)} of shared memory, left by nodes that were "
            f"restarted: images are copied through sockets. To free it, {FREE_IT}"
        )
    return ""


def lockable_bytes() -> int | None:
    """How much memory this process may lock; None: as much as there is."""
    if sys.platform != "linux" or _has_capability(_CAP_IPC_LOCK):
        return None
    import resource

    limit = resource.getrlimit(resource.RLIMIT_MEMLOCK)[0]
    return None if limit == resource.RLIM_INFINITY else limit


def held_bytes(folder: Path = _FOLDER, locks: Path = Path("/proc/locks")) -> int:
    """Size of Zenoh's segments on this host that a process holds.

    Those that nobody holds any more are left out: the next Zenoh process removes them. Not for a
    control loop: Linux lets a reader of /proc/locks wait for 5 to 15 ms (`percpu_down_write`).
    """
    sizes: dict[int, int] = {}
    for path in folder.glob("*.zenoh"):
        try:
            found = path.stat()
        except OSError:  # removed meanwhile
            continue
        sizes[found.st_ino] = found.st_size
    try:  # 1: FLOCK  ADVISORY  READ 4711 00:1b:101 0 EOF
        rows = [row.split() for row in locks.read_text().splitlines()] if sizes else []
    except OSError:
        return 0
    held = {int(row[5].rpartition(":")[2]) for row in rows if row[1:2] == ["FLOCK"]}
    return sum(size for inode, size in sizes.items() if inode in held)


def figures() -> dict[str, Any]:
    """For the status of a node: why it uses no shared memory, and how many bytes its process has
    locked."""
    return {"off": obstacle(), "locked_bytes": _locked_bytes()}


def in_mib(size: int) -> str:
    return f"{size / 1024**2:.0f} MiB"


def _status_field(name: str) -> str:
    """A field of /proc/self/status, empty where there is none."""
    try:
        lines = Path("/proc/self/status").read_text().splitlines()
    except OSError:
        return ""
    return next((line.partition(":")[2].strip() for line in lines if line.startswith(name)), "")


def _has_capability(number: int) -> bool:
    return bool(int(_status_field("CapEff:") or "0", 16) >> number & 1)


def _locked_bytes() -> int:
    return int((_status_field("VmLck:") or "0").split()[0]) * 1024
