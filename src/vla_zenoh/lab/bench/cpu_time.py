"""CPU time of a process."""

from __future__ import annotations

import ctypes
import os
import time

from vla_zenoh.errors import NodeError


def cpu_s(pid: int) -> float:
    """CPU time of a process so far, ended threads included, s."""
    clock = ctypes.c_int()
    error = ctypes.CDLL(None).clock_getcpuclockid(pid, ctypes.byref(clock))
    if error:
        raise NodeError(f"process {pid} of the benchmark has ended: {os.strerror(error)}")
    return time.clock_gettime(clock.value)
