"""Whether the wall clock is kept in step with the world: stamps cross hosts."""

from __future__ import annotations

import ctypes
import ctypes.util

from vla_zenoh.lab.doctor.finding import HostFinding

TIMEX_BYTES = 256
"""More than struct timex has on any architecture."""
TIME_ERROR = 5

_ADVICE = "sudo apt install chrony (needed when nodes run on more than one host)"


def wall_clock() -> HostFinding:
    """The kernel says the wall clock is synchronised."""
    state = kernel_state()
    if state is None:
        return HostFinding("wall clock", "warn", "cannot be told here", _ADVICE)
    return judge(state)


def judge(state: int) -> HostFinding:
    """What adjtimex returned, in words."""
    if state == TIME_ERROR:
        return HostFinding("wall clock", "warn", "not synchronised", _ADVICE)
    return HostFinding("wall clock", "ok", "synchronised")


def kernel_state() -> int | None:
    """What adjtimex says of the clock, None where it cannot be asked."""
    try:
        libc = ctypes.CDLL(ctypes.util.find_library("c") or "libc.so.6", use_errno=True)
        state = int(libc.adjtimex(ctypes.create_string_buffer(TIMEX_BYTES)))
    except (OSError, AttributeError):
        return None
    return state if state >= 0 else None
