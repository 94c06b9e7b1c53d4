"""python -m benchmarks readers."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from vla_zenoh_benchmarks.result_file import ResultOptions, write_json

from benchmarks.chain.our_chain import CAMERAS, Chain
from benchmarks.picture import noisy_picture
from vla_zenoh.bus.buffers import CallbackRing
from vla_zenoh.bus.clock import FixedRate
from vla_zenoh.cli.options import options
from vla_zenoh.runtime.process import PARENT_VARIABLE
from vla_zenoh.types import ActionChunk

COMMAND_HZ, CAMERA_HZ = 250.0, 30.0
SHADOWS = ("shadow_a", "shadow_b")
START_S, LAST_S, END_S = 4.0, 0.5, 10.0
LATE_MS = 1000.0 / CAMERA_HZ
"""A chunk that comes after the next images is late."""
CONDITIONS = {
    "alone": (),
    "recorder": ("record",),
    "recorder, viewer": ("record", "view"),
    "recorder, viewer, two shadow workers": ("record", "view", *SHADOWS),
}
"""Name -> what runs beside the chain: commands of `vla-zenoh`, and workers that are not obeyed."""
FILES = {"record": "run.mcap", "view": "run.rrd"}


@options
def readers(
    output: ResultOptions,
    seconds: Annotated[float, typer.Option("--seconds", "-s", min=1.0)] = 20.0,
) -> None:
    """Measure what reaches the obeyed worker late or never when many others read its cameras.

    Three cameras of 640x480 send 30 images a second. Read alone, with a recorder, with a viewer as
    well (`vla-zenoh view -o`), and with two workers that are not obeyed.
    """
    from rich.table import Table

    rows = [_measure(name, beside, seconds) for name, beside in CONDITIONS.items()]
    with output.open() as file:
        write_json(file, rows)
    table = Table(title="three cameras of 640x480 at 30 Hz; image published to chunk received")
    for column in rows[0]:
        table.add_column(column.replace("_", " "), justify="left" if column == "read" else "right")
    for row in rows:
        table.add_row(*(str(value) for value in row.values()))
    output.show(rows, table)


def _measure(name: str, beside: Sequence[str], seconds: float) -> dict[str, Any]:
    pictures = [noisy_picture()] * len(CAMERAS)
    shadows = [word for word in beside if word in SHADOWS]
    with Chain(COMMAND_HZ, pictures, shadows) as chain, tempfile.TemporaryDirectory() as folder:
        commands = [word for word in beside if word not in SHADOWS]
        with _programs(commands, chain.profile_file, Path(folder)):
            _publish(chain, pictures, START_S)
            chunks = chain.node.subscribe(chain.chunk_key, CallbackRing(4096))
            published_ns = _publish(chain, pictures, seconds)
            time.sleep(LAST_S)
    received_ns: dict[int, int] = {}
    for arrival in chunks.drain():
        chunk = chain.node.decode(ActionChunk, arrival)
        if chunk is not None:
            received_ns.setdefault(chunk.record.observation_stamp_ns, arrival.mono_ns)
    ms = [(received_ns[s] - at) / 1e6 for s, at in published_ns.items() if s in received_ns]
    return {
        "read": name,
        "images": len(published_ns),
        "never": len(published_ns) - len(ms),
        "late": sum(each > LATE_MS for each in ms),
        **{f"p{rank}_ms": round(float(np.percentile(ms, rank)), 2) for rank in (50, 95, 99)},
        "max_ms": round(max(ms), 1),
    }


def _publish(chain: Chain, pictures: Sequence[Any], seconds: float) -> dict[int, int]:
    """Publish images at the rate of the cameras; stamp -> time on the monotonic clock."""
    published_ns: dict[int, int] = {}
    pace = FixedRate(CAMERA_HZ)
    with ThreadPoolExecutor(len(pictures)) as threads:
        for _ in range(round(seconds * CAMERA_HZ)):
            pace.wait()
            mono_ns, stamp_ns = chain.publish(pictures, threads.map)
            published_ns[stamp_ns] = mono_ns
    chain.rest()
    return published_ns


@contextmanager
def _programs(words: Sequence[str], profile: Path, folder: Path) -> Iterator[None]:
    """Commands of `vla-zenoh` that read the robot, while the block lasts."""
    programs = [
        subprocess.Popen(
            [sys.executable, "-m", "vla_zenoh", word, "--profile", str(profile)]
            + ["--output", str(folder / FILES[word])],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            env={**os.environ, PARENT_VARIABLE: str(os.getpid())},
        )
        for word in words
    ]
    try:
        yield
        for word, program in zip(words, programs, strict=True):
            assert program.poll() is None, f"{word} ended"
    finally:
        for program in programs:
            program.terminate()
        for program in programs:
            program.wait(END_S)
