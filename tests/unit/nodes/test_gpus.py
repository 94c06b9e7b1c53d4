"""GPUs of a host in the status of its workers: what the driver says, and nothing else.

No computer of these tests has a GPU. A library with the functions of NVML that are used, compiled
here from its C types, stands for the driver; layouts and units are NVML's.
"""

from __future__ import annotations

import io
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from vla_zenoh.cli import status_table
from vla_zenoh.cli.output import Screen
from vla_zenoh.types import NodeStatus

GIB = 2**30
DRIVER = """
#include <stdint.h>
#include <stdio.h>
typedef struct {{ unsigned long long total, free, used; }} memory_t;
typedef struct {{ unsigned int gpu, memory; }} utilization_t;
static int gpus[2];
int nvmlInit_v2(void) {{ return {init}; }}
int nvmlDeviceGetCount_v2(unsigned int *count) {{ *count = 2; return 0; }}
int nvmlDeviceGetHandleByIndex_v2(unsigned int index, void **gpu) {{
  *gpu = &gpus[index];
  return 0;
}}
int nvmlDeviceGetName(void *gpu, char *name, unsigned int size) {{
  return snprintf(name, size, "Card %d", (int)((int *)gpu - gpus)) < 0;
}}
int nvmlDeviceGetMemoryInfo(void *gpu, memory_t *out) {{
  out->total = 80ull << 30;
  out->used = (gpu == &gpus[0] ? 3ull : 70ull) << 30;
  out->free = out->total - out->used;
  return 0;
}}
int nvmlDeviceGetUtilizationRates(void *gpu, utilization_t *out) {{
  out->gpu = 34;
  out->memory = 12;
  return gpu == &gpus[0] ? 0 : 3; /* NVML_ERROR_NOT_SUPPORTED, as of a part of a GPU */
}}
"""
ASK = "import json; from vla_zenoh.nodes.worker import gpus; print(json.dumps(gpus.figures()))"


def figures(folder: Path, *, init: int = 0, driver: bool = True) -> dict[str, Any]:
    """What a process says whose driver is ours, or none."""
    compiler = shutil.which("cc")
    if driver and compiler is None:
        pytest.skip("needs a C compiler")
    if driver:
        source = folder / "driver.c"
        source.write_text(DRIVER.format(init=init))
        library = folder / "libnvidia-ml.so.1"
        subprocess.run([str(compiler), "-shared", "-fPIC", source, "-o", library], check=True)
    environment = {**os.environ, "LD_LIBRARY_PATH": str(folder)}
    said = subprocess.run(
        [sys.executable, "-c", ASK], env=environment, check=True, capture_output=True, text=True
    )
    return json.loads(said.stdout)


def table(detail: dict[str, Any]) -> str:
    status = NodeStatus("worker-a", "inferring", "h", 1, 2, detail={"obeyed": False, **detail})
    screen = Screen(file=io.StringIO(), width=160, force_terminal=True, color_system=None)
    screen.print(status_table.render("panda", {"worker-a": (status, 0.2, True)}, [], width=160))
    assert isinstance(screen.file, io.StringIO)
    return screen.file.getvalue()


def test_every_gpu_has_memory_and_load_and_what_is_not_known_is_none(tmp_path: Path) -> None:
    found = figures(tmp_path)
    first = {"name": "Card 0", "used_bytes": 3 * GIB, "total_bytes": 80 * GIB, "load_percent": 34}
    second = {"name": "Card 1", "used_bytes": 70 * GIB, "total_bytes": 80 * GIB}
    assert found["gpus"] == [first, {**second, "load_percent": None}]
    shown = table(found)
    assert "shadow mode, GPU 34 %, 3.0 of 80.0 GiB" in shown
    assert "GPU ? %, 70.0 of 80.0 GiB" in shown


@pytest.mark.parametrize("init", [9, None])
def test_a_host_without_gpu_or_driver_says_none(tmp_path: Path, init: int | None) -> None:
    if init is None and Path("/proc/driver/nvidia").exists():
        pytest.skip("this computer has a GPU")
    found = figures(tmp_path, init=init or 0, driver=init is not None)
    assert found == {"gpus": [], "gpu_own_bytes": None}
    assert "shadow mode, no GPU" in table(found)


def test_a_worker_of_an_older_version_says_nothing_of_gpus() -> None:
    assert "GPU" not in table({})
