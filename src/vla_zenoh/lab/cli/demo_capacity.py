"""Whether this computer keeps up with a demo, and what gives way where it does not."""

from __future__ import annotations

import os
import time
from pathlib import Path
from typing import NamedTuple

from vla_zenoh.profile import Profile, override

WANTED_CORES, LEAST_CORES = 3.0, 0.7
"""Free cores for a demo with two cameras drawn in software; with less than the second it fails."""
SMALL_PICTURES_HZ, SMALL_CONTROL_HZ = 15.0, 100.0
LOOK_S = 0.5
STAT = Path("/proc/stat")
IDLE_FIELDS = (1, 3, 4)
"""Of the first line of that file: low priority, idle, waiting for a disk."""


class Capacity(NamedTuple):
    """Cores that this process may use, and how many of them other programs leave free."""

    cores: int
    free: float

    @property
    def enough(self) -> bool:
        return self.free >= WANTED_CORES

    def said(self) -> str:
        """What gives way, in a sentence; empty: nothing."""
        if self.enough:
            return ""
        found = f"{self.free:.1f} of {self.cores} cores are free, the demo wants {WANTED_CORES:g}: "
        if self.free < LEAST_CORES:
            return f"{found}it will probably fail; end other programs first"
        rate = f"{SMALL_CONTROL_HZ:g} Hz"
        return f"{found}pictures are smaller and fewer, commands and states come at {rate}"


def measure_capacity() -> Capacity:
    """The capacity of this computer, watched for `LOOK_S`; where that is unknown all is free."""
    try:
        cores = len(os.sched_getaffinity(0))
    except AttributeError:
        cores = os.cpu_count() or 1
    try:
        before = _times()
        time.sleep(LOOK_S)
        return Capacity(cores, cores * idle_share(before, _times()))
    except (OSError, ValueError, IndexError):
        return Capacity(cores, float(cores))


def idle_share(before: list[int], after: list[int]) -> float:
    """Share of the time between two readings of /proc/stat that a program of ours could have."""
    spent = [later - earlier for earlier, later in zip(before, after, strict=True)]
    return sum(spent[field] for field in IDLE_FIELDS) / max(sum(spent), 1)


def _times() -> list[int]:
    return [int(text) for text in STAT.read_text().splitlines()[0].split()[1:9]]


def small(profile: Profile) -> Profile:
    """The profile with cameras of half the size, and less of everything per second."""
    cameras = {
        name: {
            **camera.model_dump(mode="json"),
            "width": camera.width // 2,
            "height": camera.height // 2,
            "rate_hz": min(camera.rate_hz, SMALL_PICTURES_HZ),
        }
        for name, camera in profile.cameras.items()
    }
    timing = {
        "state_hz": min(profile.timing.state_hz, SMALL_CONTROL_HZ),
        "command_hz": min(profile.timing.command_hz, SMALL_CONTROL_HZ),
    }
    return override(profile, {"cameras": cameras, "timing": timing})
