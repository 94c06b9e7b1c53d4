"""Measures duration and lateness of the command node's ticks in the real chain."""

from __future__ import annotations

import ctypes
import os
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from vla_zenoh.errors import NodeError
from vla_zenoh.lab.episode import EpisodeRunner, Interrupted
from vla_zenoh.lab.newest_records import NewestRecords
from vla_zenoh.nodes.command.node import SPREAD_S
from vla_zenoh.profile import Profile, override
from vla_zenoh.runtime.launch import Host
from vla_zenoh.types import PoseState
from vla_zenoh_benchmarks.bare_loop import bare_loop


def cpu_s(pid: int) -> float:
    """CPU time of a process so far, ended threads included, s."""
    clock = ctypes.c_int()
    error = ctypes.CDLL(None).clock_getcpuclockid(pid, ctypes.byref(clock))
    if error:
        raise NodeError(f"process {pid} of the benchmark has ended: {os.strerror(error)}")
    return time.clock_gettime(clock.value)


PROMPT = "HARD: go up within 0.2"
RATE_HZ = 10.0
STATUS_S = 1.0
COMPUTES = "while True: sum(range(100_000))"


def measure_command(
    profile: Profile,
    command_hz: float,
    seconds: float,
    stop: threading.Event,
    log: Callable[[str, str], None],
    busy: int = 0,
) -> dict[str, Any]:
    """Measure ticks at one rate while the arm moves up and down.

    Args:
        log: called with (node, line) of the nodes' output.

    Raises:
        NodeError: the chain does not come up, or the arm does not stay active.
    """
    profile = override(profile, {"timing": {"command_hz": command_hz}})
    with Host(profile, None, log=log, tell=log, own_router=True) as host:
        assert host.client is not None
        client = host.client

        run = EpisodeRunner(client, stop, host.poll)
        streams = NewestRecords(client.session, {PoseState: client.keys.state_pose})
        run.wait_until_ready(profile.task.worker, streams)
        run.start(PROMPT, RATE_HZ)
        if stop.wait(STATUS_S):
            raise Interrupted
        pid = host.supervisor.pids()["command"]
        missed, spent_s, began_s = _missed(host), cpu_s(pid), time.monotonic()
        with _load(busy), bare_loop(command_hz) as bare:
            if stop.wait(max(seconds, SPREAD_S)):
                raise Interrupted
            status = client.status("command")
            missed_ticks = _missed(host) - missed
        spent_s, took_s = cpu_s(pid) - spent_s, time.monotonic() - began_s
        if status is None or status.state != "active":
            found = f"{status.state} ({status.detail.get('why')})" if status else "silent"
            raise NodeError(f"the command node at {command_hz:g} Hz is {found}")
        return {
            "command_hz": command_hz,
            "held_hz": round(status.rates_hz.get("loop", 0.0), 1),
            "tick_us": status.detail["tick_us"],
            "late_us": status.detail["late_us"],
            "pose_age_ms": status.detail["pose_age_ms"],
            "busy": busy,
            "missed_ticks": missed_ticks,
            "bare_ticks": bare.ticks,
            "bare_missed_ticks": bare.missed,
            "core_share": round(spent_s / took_s, 3),
            "realtime": status.detail["realtime"],
            "seconds": round(took_s, 1),
        }


@contextmanager
def _load(count: int) -> Iterator[None]:
    """Load the processors with `count` programs of this one's niceness."""
    programs = [subprocess.Popen([sys.executable, "-c", COMPUTES]) for _ in range(count)]
    try:
        yield
    finally:
        for program in programs:
            program.kill()
            program.wait()


def _missed(host: Host) -> int:
    status = host.client.status("command") if host.client else None
    return int(status.counters.get("command.missed_ticks", 0)) if status else 0
