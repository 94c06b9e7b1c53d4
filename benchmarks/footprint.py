"""python -m benchmarks footprint: how long a robot's nodes take to start, and their memory."""

from __future__ import annotations

import json
import re
import signal
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from importlib.metadata import distributions
from pathlib import Path
from typing import Annotated

import typer
from vla_zenoh_benchmarks.result_file import ResultOptions, write_json

from benchmarks.chain.process import free_port
from vla_zenoh.bus.buffers import CallbackRing, bytes_of
from vla_zenoh.bus.session import open_session
from vla_zenoh.cli.options import options
from vla_zenoh.client.client import Client
from vla_zenoh.codec import records
from vla_zenoh.errors import NodeError, SessionError
from vla_zenoh.profile import load_profile, override
from vla_zenoh.types import PoseCommand

PATIENCE_S, POLL_S = 90.0, 0.005
MOVED_M = 1e-5
"""A command this far from the first one is the arm's motion."""
SEGMENTS = Path("/dev/shm"), "*.zenoh"
PACKAGES = 12
STARTED = re.compile(r"started \(pid (\d+)\)")
PROMPTS = {"scripted": "HARD: go up", "brick": "put the red brick in the box"}


@options
def footprint(
    output: ResultOptions,
    profile: Annotated[str, typer.Argument(help="Name of a simulated profile.")] = "panda_bricks",
    rounds: Annotated[int, typer.Option("--rounds", "-r", min=1, help="Starts.")] = 5,
    seconds: Annotated[
        float, typer.Option("--seconds", "-s", min=1.0, help="Of motion before memory is read.")
    ] = 20.0,
) -> None:
    """Measure how long `vla-zenoh up` takes to the first motion, and the memory of each process.

    Also names the largest packages of this environment.
    """
    from rich.table import Table

    starts: list[dict[str, float]] = []
    memory: dict[str, dict[str, float]] = {}
    for number in range(rounds):
        with Start(profile) as start:
            starts.append(start.stages_s)
            if number == rounds - 1:
                time.sleep(seconds)
                memory = start.memory()
    median_s = {
        stage: round(statistics.median(each[stage] for each in starts), 2) for stage in starts[0]
    }
    result = {
        "profile": profile,
        "start_s": dict(sorted(median_s.items(), key=lambda item: item[1])),
        "rounds_s": [round(max(each.values()), 2) for each in starts],
        "memory": memory,
        "packages_mb": packages_mb(),
    }
    with output.open() as file:
        write_json(file, result)
    stages = Table("stage", "s", title=f"vla-zenoh up {profile}, median of {rounds}")
    for stage, at_s in result["start_s"].items():
        stages.add_row(stage, f"{at_s:.2f}")
    processes = Table("process", "RSS MB", "its own MB", "threads", title="arm in motion")
    for name, row in memory.items():
        processes.add_row(name, *(f"{value:.0f}" for value in row.values()))
    packages = Table("package", "MB", title=f"the {PACKAGES} largest packages, and all")
    for name, size_mb in result["packages_mb"].items():
        packages.add_row(name, f"{size_mb:.0f}")
    output.show(result, stages, processes, packages)


class Start:
    """One ``vla-zenoh up`` at an address of its own, until the arm moves; ends with the context.

    `stages_s` has the seconds since it was called.
    """

    def __init__(self, profile: str) -> None:
        self._name = profile
        self._endpoint = f"tcp/127.0.0.1:{free_port()}"
        address = {"connect": [self._endpoint], "listen": [self._endpoint]}
        self._profile = override(load_profile(profile), {"session": address})
        self._pids: dict[str, int] = {}
        self._segments = set(SEGMENTS[0].glob(SEGMENTS[1]))
        self.stages_s: dict[str, float] = {}

    def __enter__(self) -> Start:
        self._running = self._run()
        self._running.__enter__()
        return self

    def __exit__(self, *_: object) -> None:
        self._running.__exit__(None, None, None)

    @contextmanager
    def _run(self) -> Iterator[None]:
        with tempfile.TemporaryDirectory() as folder:
            self._began_s = time.monotonic()
            address = ("--listen", self._endpoint, "--connect", self._endpoint)
            process = subprocess.Popen(
                [sys.executable, "-m", "vla_zenoh", "up", self._name, *address]
                + ["--log-dir", folder, "--json"],
                stdout=subprocess.PIPE,
                text=True,
            )
            self._pids["up"] = process.pid
            reader = threading.Thread(target=self._read, args=(process,))
            reader.start()
            try:
                with open_session(self._profile.session, wait_s=PATIENCE_S) as session:
                    self._reached("router answers")
                    client = Client(self._profile, session).subscribe()
                    self._watch(client)
                    yield
                    client.deactivate()
            finally:
                process.send_signal(signal.SIGINT)
                process.wait(PATIENCE_S)
                reader.join()

    def _reached(self, stage: str) -> None:
        self.stages_s.setdefault(stage, time.monotonic() - self._began_s)

    @property
    def _late(self) -> bool:
        return time.monotonic() > self._began_s + PATIENCE_S

    def _read(self, process: subprocess.Popen[str]) -> None:
        assert process.stdout is not None
        for line in process.stdout:
            said = json.loads(line)
            found = STARTED.match(said["text"])
            if found is not None:
                self._reached("profile checked, first process started")
                self._pids[said["node"]] = int(found[1])

    def _watch(self, client: Client) -> None:
        """Follow the nodes until each is alive, and the arm until it moves."""
        poses = CallbackRing(1 << 14)
        subscription = poses.subscribe(client.session, client.keys.command_pose)
        missing = client.expected.keys() - {"router"}
        while missing and not self._late:
            for node in client.alive & missing:
                self._reached(f"{node} is alive")
            missing -= client.alive
            time.sleep(POLL_S)
        prompt = PROMPTS.get(self._profile.task.worker, self._profile.task.prompt)
        while True:
            with suppress(SessionError):
                client.set_prompt(prompt)
                client.activate()
                break
            if self._late:
                raise NodeError("the arm cannot be activated")
        self._reached("activated")
        first: PoseCommand | None = None
        while True:
            arrival = poses.pop()
            if arrival is None:
                if self._late:
                    raise NodeError("the arm does not move")
                time.sleep(POLL_S)
                continue
            pose = records.decode(PoseCommand, bytes_of(arrival.sample.payload))
            first = first or pose
            if max(abs(pose.position_m - first.position_m)) > MOVED_M:
                self.stages_s["the arm is commanded to move"] = (
                    arrival.mono_ns / 1e9 - self._began_s
                )
                break
        subscription.undeclare()

    def memory(self) -> dict[str, dict[str, float]]:
        """Process -> its resident set, what of it is its own alone (MB), and its threads."""
        found = {name: memory(pid) for name, pid in self._pids.items()}
        rows = list(found.values())
        found["all"] = {key: sum(row[key] for row in rows) for key in rows[0]}
        segments = set(SEGMENTS[0].glob(SEGMENTS[1])) - self._segments
        total_mb = sum(path.stat().st_size for path in segments) / 1e6
        found[f"{len(segments)} shared-memory segments"] = {"rss_mb": total_mb}
        return found


def memory(pid: int) -> dict[str, float]:
    """Resident set of a process, what of it is its own alone (MB), and its threads."""
    lines = Path(f"/proc/{pid}/smaps_rollup").read_text().splitlines()[1:]
    kb = {name: int(value.split()[0]) for name, value in (line.split(":") for line in lines)}
    own_kb = kb["Private_Clean"] + kb["Private_Dirty"]
    threads = len(list(Path(f"/proc/{pid}/task").iterdir()))
    return {"rss_mb": kb["Rss"] / 1e3, "own_mb": own_kb / 1e3, "threads": threads}


def packages_mb() -> dict[str, float]:
    """Name -> size of the largest packages of this environment, and of all together."""
    found: dict[str, float] = {}
    for package in distributions():
        paths = [Path(str(package.locate_file(file))) for file in package.files or ()]
        size = sum(path.stat().st_size for path in paths if path.is_file())
        found[package.name] = size / 1e6
    largest = sorted(found, key=lambda name: -found[name])[:PACKAGES]
    return {**{name: found[name] for name in largest}, "all": sum(found.values())}
