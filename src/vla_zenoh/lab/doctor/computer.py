"""Checks of the computer: scheduling, processors, memory, disk, cameras, clock."""

from __future__ import annotations

import ctypes
import ctypes.util
import os
import resource
import shutil
from collections.abc import Sequence
from pathlib import Path

from vla_zenoh.bus.shared_memory import (
    FREE_IT,
    HOST_BYTES,
    LOCK_BYTES,
    SENDER_BYTES,
    held_bytes,
    in_mib,
)
from vla_zenoh.errors import NodeError
from vla_zenoh.lab.doctor.needs import HostFinding, judged
from vla_zenoh.nodes.camera.v4l2_devices import DEV, find_device

PRIORITY = 50
NICENESS = -10
FEWEST_PROCESSORS = 2

LIMITS_FILE = "/etc/security/limits.d/90-vla-zenoh.conf"
CPU = Path("/sys/devices/system/cpu")


def may_use_priority(priority: int) -> bool:
    """Whether this user may use a real-time priority (tried, and undone)."""
    policy, parameters = os.sched_getscheduler(0), os.sched_getparam(0)
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))
    except OSError:
        return False
    os.sched_setscheduler(0, policy, parameters)
    return True


def real_time_priority() -> HostFinding:
    """This user may use the priority of nodes that move an arm."""
    may, limit = may_use_priority(PRIORITY), resource.getrlimit(resource.RLIMIT_RTPRIO)[0]
    found = f"not permitted (RLIMIT_RTPRIO is {limit}); pose commands may come late under load"
    found = f"SCHED_FIFO {PRIORITY} is permitted" if may else found
    return judged("real-time priority", may, found, _limit_advice(f"rtprio {PRIORITY}"))


def niceness() -> HostFinding:
    """This user may lower the niceness (tried, and undone)."""
    before = os.getpriority(os.PRIO_PROCESS, 0)
    try:
        os.setpriority(os.PRIO_PROCESS, 0, NICENESS)
    except OSError:
        found = f"{NICENESS} is not permitted; other programs may delay nodes that move an arm"
        return HostFinding("niceness", "warn", found, _limit_advice(f"nice {NICENESS}"))
    os.setpriority(os.PRIO_PROCESS, 0, before)
    return HostFinding("niceness", "ok", f"{NICENESS} is permitted")


def processors() -> HostFinding:
    """At least two processors: one for the controller, one for everything else."""
    usable = len(os.sched_getaffinity(0))
    found = f"{usable} usable of {os.cpu_count()}"
    advice = "give this host two or more; in a container: --cpus=2 or more"
    return judged("processors", usable >= FEWEST_PROCESSORS, found, advice)


def governor(cpu: Path = CPU) -> HostFinding:
    """The frequency governor keeps processors awake between two ticks of a controller."""
    kinds = sorted({_text(path) for path in cpu.glob("cpu*/cpufreq/scaling_governor")})
    return judged(
        "frequency governor",
        kinds in ([], ["performance"]),
        ", ".join(kinds) or "none; the clock frequency is fixed or hidden",
        "sudo cpupower frequency-set --governor performance (Debian: linux-cpupower, "
        "Ubuntu: linux-tools-generic)",
    )


def _text(path: Path) -> str:
    try:
        return path.read_text().strip()
    except OSError:
        return "unreadable"


def _limit_advice(limit: str) -> str:
    return f"{_limit_line(limit)}; in a container: --cap-add=SYS_NICE"


def _limit_line(limit: str) -> str:
    user = os.environ.get("USER") or str(os.getuid())
    return f"add the line '{user} - {limit}' to {LIMITS_FILE} and log in again"


MIB = 1024 * 1024
SHARED_MEMORY_WANTED_MIB = HOST_BYTES // MIB
DISK_WANTED_MIB = 2048
DISK_NEEDED_MIB = 200

SHARED_MEMORY = Path("/dev/shm")


def shared_memory(
    folder: Path = SHARED_MEMORY, wanted_mib: int = SHARED_MEMORY_WANTED_MIB
) -> HostFinding:
    """Room in shared memory for images; without it they go through sockets, twice as slow."""
    advice = (
        f"sudo mount -o remount,size={wanted_mib}M {folder}; "
        f"in a container: --shm-size={wanted_mib}m"
    )
    if not os.access(folder, os.W_OK):
        return HostFinding("shared memory", "warn", f"{folder} cannot be written", advice)
    held = held_bytes()
    if held + SENDER_BYTES > HOST_BYTES:
        found = f"{in_mib(held)} of at most {in_mib(HOST_BYTES)} are held by programs of this host"
        return HostFinding("shared memory", "warn", f"{found}; new nodes use none", FREE_IT)
    free_mib = (shutil.disk_usage(folder).free + held) // MIB
    found = f"{free_mib} MiB in {folder}, {in_mib(held)} of them held by programs of this host"
    return judged("shared memory", free_mib >= wanted_mib, found, advice)


def locked_memory(may_lock: int | None) -> HostFinding:
    """Memory that this user may lock, as `lockable_bytes` has it: Zenoh locks what it shares."""
    enough = may_lock is None or may_lock >= LOCK_BYTES
    if may_lock is None:
        found = "no limit"
    elif enough:
        found = in_mib(may_lock)
    else:
        found = (
            f"{in_mib(may_lock)} (`ulimit -l`), shared memory needs {in_mib(LOCK_BYTES)}: our "
            "programs copy images through sockets, twice as slow; another Zenoh program that keeps "
            "shared memory on loses them without an error"
        )
    advice = (
        f"{_limit_line('memlock unlimited')}; in a systemd unit: LimitMEMLOCK=infinity; in a "
        "container: --ulimit memlock=-1. In other Zenoh programs: "
        "transport/shared_memory/enabled: false"
    )
    return judged("locked memory", enough, found, advice)


def disk(folder: Path | None = None, wanted_mib: int = DISK_WANTED_MIB) -> HostFinding:
    """Room on the disk for recordings and videos."""
    folder = folder or Path.cwd()
    free_mib = shutil.disk_usage(folder).free // MIB
    found = f"{free_mib / 1024:.1f} GiB free in {folder}"
    level = "fail" if free_mib < min(DISK_NEEDED_MIB, wanted_mib) else "warn"
    advice = "free some space, or work in a folder on another disk"
    return judged("disk", free_mib >= wanted_mib, found, advice, level)


def video_devices(needed: Sequence[str] = (), dev: Path = DEV) -> HostFinding:
    """The video devices of the profile exist, and this user may open every video device.

    Args:
        needed: as `find_device` takes them: paths, numbers, serial numbers, names.
    """
    present = sorted(dev.glob("video[0-9]*"))
    try:
        wanted = [find_device(name, dev) for name in needed]
    except NodeError as error:
        why = "plug the camera in, or correct its source: `vla-zenoh camera list`"
        return HostFinding("video devices", "fail", str(error), why)
    missing = [str(path) for path in wanted if not path.exists()]
    if missing:
        there = ", ".join(map(str, present)) or "none"
        return HostFinding(
            "video devices",
            "fail",
            f"{', '.join(missing)} not found; devices: {there}",
            "plug the camera in, or correct its source in the profile; in a container: "
            f"--device={missing[0]}",
        )
    closed = [str(path) for path in {*present, *wanted} if not os.access(path, os.R_OK | os.W_OK)]
    found = f"no permission: {', '.join(sorted(closed))}"
    return judged(
        "video devices",
        not closed,
        found if closed else ", ".join(map(str, present)) or "none",
        "sudo usermod --append --groups video $USER, then log in again",
        "fail" if wanted else "warn",
    )


TIMEX_BYTES = 256
"""More than struct timex has on any architecture."""
TIME_ERROR = 5


def wall_clock() -> HostFinding:
    """The wall clock is synchronised, as the kernel reports: time stamps cross hosts."""
    return clock_finding(kernel_state())


def clock_finding(state: int | None) -> HostFinding:
    """Finding on the return value of adjtimex; None: it cannot be called."""
    found = {None: "unknown here", TIME_ERROR: "not synchronised"}.get(state, "synchronised")
    advice = "sudo apt install chrony (needed when nodes run on more than one host)"
    return judged("wall clock", state not in (None, TIME_ERROR), found, advice)


def kernel_state() -> int | None:
    """Return value of adjtimex, None where it cannot be called."""
    try:
        libc = ctypes.CDLL(ctypes.util.find_library("c") or "libc.so.6", use_errno=True)
        state = int(libc.adjtimex(ctypes.create_string_buffer(TIMEX_BYTES)))
    except (OSError, AttributeError):
        return None
    return state if state >= 0 else None
