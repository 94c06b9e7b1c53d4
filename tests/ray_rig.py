"""A worker in front of replicas by Ray Serve, in the environment that has Ray, and its replicas."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

VARIABLE = "RAY_PYTHON"
"""Environment variable with the Python that has Ray Serve."""
END_S = 60.0


def replicas(folder: Path) -> set[int]:
    """Processes of the replicas of a worker that was started with this folder."""
    found: set[int] = set()
    for process in Path("/proc").iterdir():
        try:
            named = b"ServeReplica" in (process / "cmdline").read_bytes()
            ours = f"RAY_RIG={folder}".encode() in (process / "environ").read_bytes()
        except OSError:
            continue
        if named and ours:
            found.add(int(process.name))
    return found


@contextmanager
def ray_worker(folder: Path, profile: Path, name: str) -> Iterator[int]:
    """The process of the worker `name`, with a Ray of its own; its log is in `folder`."""
    words = [os.environ[VARIABLE], "-m", "vla_zenoh", "worker", name, "--profile", str(profile)]
    # Ray's sockets have names of a hundred characters at most.
    short = tempfile.mkdtemp(prefix="ray", dir="/tmp")
    environment = {**os.environ, "RAY_TMPDIR": short, "RAY_RIG": str(folder)}
    with (folder / f"{name}.log").open("wb") as log:
        process = subprocess.Popen(
            words, env=environment, stdout=log, stderr=log, start_new_session=True
        )
        try:
            yield process.pid
        finally:
            process.terminate()
            try:
                process.wait(END_S)
            except subprocess.TimeoutExpired:
                os.killpg(process.pid, signal.SIGKILL)
                process.wait()
            shutil.rmtree(short, ignore_errors=True)
