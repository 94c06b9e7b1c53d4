"""Whether nodes can keep time on this host: priority, processors, clock frequency."""

from __future__ import annotations

import os
import resource
from pathlib import Path

from vla_zenoh.lab.doctor.finding import HostFinding

PRIORITY = 50
NICENESS = -10
FEWEST_PROCESSORS = 2

LIMITS_FILE = "/etc/security/limits.d/90-vla-zenoh.conf"
CPU = Path("/sys/devices/system/cpu")


def real_time_priority() -> HostFinding:
    """This user may run threads at a real-time priority: found out by doing it, and undone."""
    policy, parameters = os.sched_getscheduler(0), os.sched_getparam(0)
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(PRIORITY))
    except OSError:
        allowed = resource.getrlimit(resource.RLIMIT_RTPRIO)[0]
        return HostFinding(
            "real-time priority",
            "warn",
            f"not permitted (RLIMIT_RTPRIO is {allowed}); pose commands may come late under load",
            f"add the line '{_user()} - rtprio {PRIORITY}' to {LIMITS_FILE} and log in again; "
            "in a container: --cap-add=SYS_NICE",
        )
    os.sched_setscheduler(0, policy, parameters)
    return HostFinding("real-time priority", "ok", f"SCHED_FIFO {PRIORITY} is permitted")


def niceness() -> HostFinding:
    """This user may put nodes before other programs: found out by doing it, and undone."""
    before = os.getpriority(os.PRIO_PROCESS, 0)
    try:
        os.setpriority(os.PRIO_PROCESS, 0, NICENESS)
    except OSError:
        return HostFinding(
            "niceness",
            "warn",
            f"{NICENESS} is not permitted; other programs may hold up nodes that move an arm",
            f"add the line '{_user()} - nice {NICENESS}' to {LIMITS_FILE} and log in again; "
            "in a container: --cap-add=SYS_NICE",
        )
    os.setpriority(os.PRIO_PROCESS, 0, before)
    return HostFinding("niceness", "ok", f"{NICENESS} is permitted")


def processors() -> HostFinding:
    """There is a processor for the controller besides the one for everything else."""
    usable = len(os.sched_getaffinity(0))
    found = f"{usable} usable of {os.cpu_count()}"
    if usable < FEWEST_PROCESSORS:
        return HostFinding(
            "processors",
            "warn",
            found,
            "give this host two or more; in a container: --cpus=2 or more",
        )
    return HostFinding("processors", "ok", found)


def governor(cpu: Path = CPU) -> HostFinding:
    """The processors do not fall asleep between two ticks of a controller."""
    kinds = sorted({_text(path) for path in cpu.glob("cpu*/cpufreq/scaling_governor")})
    if not kinds:
        return HostFinding(
            "frequency governor", "ok", "none; the clock frequency is fixed or hidden"
        )
    if kinds == ["performance"]:
        return HostFinding("frequency governor", "ok", "performance")
    return HostFinding(
        "frequency governor",
        "warn",
        ", ".join(kinds),
        "sudo cpupower frequency-set --governor performance (Debian: linux-cpupower, "
        "Ubuntu: linux-tools-generic)",
    )


def _text(path: Path) -> str:
    try:
        return path.read_text().strip()
    except OSError:
        return "unreadable"


def _user() -> str:
    return os.environ.get("USER") or str(os.getuid())
