"""GPUs of a worker's host, by NVIDIA's driver (NVML), and what this process holds, by PyTorch."""

from __future__ import annotations

import ctypes
import sys
import time
from functools import cache
from typing import Any

PERIOD_S = 5.0
MAX_GPUS, NAME_BYTES = 16, 96
_last: tuple[float, dict[str, Any]] = (-PERIOD_S, {})


class _Memory(ctypes.Structure):
    _fields_ = [(name, ctypes.c_ulonglong) for name in ("total", "free", "used")]


class _Load(ctypes.Structure):
    _fields_ = [(name, ctypes.c_uint) for name in ("gpu", "memory")]


@cache
def _driver() -> ctypes.CDLL | None:
    try:
        driver = ctypes.CDLL("libnvidia-ml.so.1")
        return None if driver.nvmlInit_v2() else driver
    except (OSError, AttributeError):
        return None


def figures() -> dict[str, Any]:
    """Memory and load for a status, at most `PERIOD_S` old.

    ``gpus``: of every GPU of the host, also by other programs; empty: there is none, or no driver.
    A number that the driver does not give is None. ``gpu_own_bytes``: held by PyTorch in this
    process; None: it uses none.
    """
    global _last
    if time.monotonic() - _last[0] >= PERIOD_S:
        _last = (time.monotonic(), {"gpus": _of_host(), "gpu_own_bytes": _own_bytes()})
    return _last[1]


def _of_host() -> list[dict[str, Any]]:
    driver, count, found = _driver(), ctypes.c_uint(), list[dict[str, Any]]()
    if driver is None or driver.nvmlDeviceGetCount_v2(ctypes.byref(count)):
        return found
    for index in range(min(count.value, MAX_GPUS)):
        gpu, name = ctypes.c_void_p(), ctypes.create_string_buffer(NAME_BYTES)
        memory, load = _Memory(), _Load()
        if driver.nvmlDeviceGetHandleByIndex_v2(index, ctypes.byref(gpu)):
            continue
        named = not driver.nvmlDeviceGetName(gpu, name, NAME_BYTES)
        measured = not driver.nvmlDeviceGetMemoryInfo(gpu, ctypes.byref(memory))
        loaded = not driver.nvmlDeviceGetUtilizationRates(gpu, ctypes.byref(load))
        found.append(
            {
                "name": name.value.decode(errors="replace") if named else "",
                "used_bytes": memory.used if measured else None,
                "total_bytes": memory.total if measured else None,
                "load_percent": load.gpu if loaded else None,
            }
        )
    return found


def _own_bytes() -> int | None:
    cuda = getattr(sys.modules.get("torch"), "cuda", None)  # not imported for this
    if cuda is None or not cuda.is_initialized():
        return None
    return sum(cuda.memory_reserved(index) for index in range(cuda.device_count()))
