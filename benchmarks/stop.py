"""python -m benchmarks stop: from typing ``vla-zenoh stop`` to an arm that stands."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from statistics import median
from typing import Annotated

import numpy as np
import typer
import zenoh

from vla_zenoh.bus.buffers import bytes_of, header_of
from vla_zenoh.cli.options import effective_profile
from vla_zenoh.cli.output import console, errors, new_table
from vla_zenoh.client.client import Client
from vla_zenoh.codec import records
from vla_zenoh.errors import NodeError, VlaZenohError
from vla_zenoh.lab.cli.loopback import own_address
from vla_zenoh.profile import Profile, override, to_yaml
from vla_zenoh.runtime.launch import Host
from vla_zenoh.types import PoseState

SPEED_M_S, RATE_HZ = 0.2, 20.0
"""The scripted worker's step is 10 mm."""
READY_S, PATIENCE_S = 60.0, 20.0
MOVE_S, MOST_TRIES = 5.0, 10
STANDS_M_S = 0.002
WATCH_S = 0.3
"""It stands if it is slow for this long."""
LOW_M, HIGH_M = 0.35, 0.5


def stop(
    times: Annotated[int, typer.Option("--times", min=1, help="How often, at each load.")] = 30,
    load: Annotated[int, typer.Option("--load", min=0, help="Busy processes beside it.")] = 8,
) -> None:
    """Measure how long `vla-zenoh stop` takes at 0.2 m/s, on an idle and on a busy computer.

    From the start of the process to the sample on the key, to the transition in the command node,
    to the measured arm at rest. The robot, the command and the busy processes are in sessions of
    their own, as of three terminals.
    """
    profile = own_address(effective_profile("panda_sim"))
    profile = override(
        profile,
        {
            "task": {"rate_hz": RATE_HZ},
            # A busy computer must not brake the arm before the stop does.
            "timing": {"command_timeout_s": 0.5, "state_timeout_s": 0.5},
        },
    )
    table = new_table(
        "load", "times", "sample ms", "worst", "command node ms", "worst", "stands ms", "worst",
        left=(),
    )  # fmt: skip
    with Host(profile, None, log=lambda *_: None, tell=lambda *_: None) as host:
        lab = _Lab(profile, host)
        for busy in dict.fromkeys((0, load)):
            with _busy(busy):
                rows = [lab.measure() for _ in range(times)]
            figures = [f(column) * 1e3 for column in zip(*rows, strict=True) for f in (median, max)]
            words = [f"{value:.0f}" for value in figures]
            errors().print(f"load {busy}, ms: {', '.join(words)}", style="dim")
            table.add_row(str(busy), str(times), *words)
    console().print(table)


class _Lab:
    """A simulated robot that goes up and down, and its observed states."""

    def __init__(self, profile: Profile, host: Host) -> None:
        assert host.session is not None
        assert host.client is not None
        self._host, self._client, self._up = host, host.client, True
        self._speed_m_s, self._z_m, self._slow_since_s = 0.0, 0.0, 0.0
        self._sample_s = 0.0
        keys = profile.keys
        self._declared = [
            host.session.declare_subscriber(key, zenoh.handlers.Callback(call, indirect=False))
            for key, call in ((keys.state_pose, self._on_pose), (keys.stop, self._on_stop))
        ]
        self._folder = tempfile.TemporaryDirectory()
        self._file = Path(self._folder.name) / "robot.yaml"
        self._file.write_text(to_yaml(profile), "utf-8")

    def _typed(self, *words: str) -> list[str]:
        return [sys.executable, "-m", "vla_zenoh", *words, "--profile", str(self._file)]

    def _on_pose(self, sample: zenoh.Sample) -> None:
        pose = records.decode(PoseState, bytes_of(sample.payload))
        header_of(sample)
        self._z_m = float(pose.position_m[2])
        self._speed_m_s = float(np.linalg.norm(pose.twist[:3]))
        if self._speed_m_s > STANDS_M_S:
            self._slow_since_s = 0.0
        elif not self._slow_since_s:
            self._slow_since_s = time.time()

    def _on_stop(self, sample: zenoh.Sample) -> None:
        self._sample_s = self._sample_s or time.time()

    def measure(self) -> tuple[float, float, float]:
        """Seconds from the start of the command to sample, transition and rest."""
        client: Client = self._client
        self._until("a robot", lambda: client.task and "worker-scripted" in client.alive, READY_S)
        for _ in range(MOST_TRIES):  # a busy computer may end an activation by itself
            if self._moves():
                break
        else:
            raise NodeError("the arm does not get to 0.2 m/s: this computer is too busy")
        client.pop_events()
        self._sample_s, began_s = 0.0, time.time()
        typed = subprocess.Popen(
            self._typed("stop"),
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            start_new_session=True,
        )
        stopped_s = self._until("a transition", self._stopped_s, PATIENCE_S)
        self._until(
            "rest",
            lambda: self._slow_since_s and time.time() - self._slow_since_s > WATCH_S,
            PATIENCE_S,
        )
        stood_s = self._slow_since_s
        typed.wait(PATIENCE_S)
        return self._sample_s - began_s, stopped_s - began_s, stood_s - began_s

    def _moves(self) -> bool:
        """Activate the arm, and wait until it has its speed."""
        client = self._client
        self._up = self._z_m < (LOW_M + HIGH_M) / 2
        give_up_s = time.monotonic() + READY_S
        while True:
            try:
                client.reset()
                client.set_prompt(f"HARD: go {'up' if self._up else 'down'}", PATIENCE_S)
                client.activate()
                break
            except VlaZenohError:
                if time.monotonic() > give_up_s:
                    raise
                time.sleep(0.2)
        with suppress(NodeError):
            self._until("0.2 m/s", lambda: self._speed_m_s > 0.9 * SPEED_M_S, MOVE_S)
            return True
        return False

    def _stopped_s(self) -> float:
        """When the command node entered ``stopped``, by the stamp of its event."""
        for node, header, event in self._client.pop_events():
            if node == "command" and event.kind == "transition" and "stopped" in event.what:
                return header.stamp_wall_ns / 1e9
        status = self._client.status("command")  # on a busy computer an event may be dropped
        return time.time() if status is not None and status.state == "stopped" else 0.0

    def _until(self, what, condition, patience_s: float):  # pyright: ignore
        give_up_s = time.monotonic() + patience_s
        while not (found := condition()):
            self._host.poll()
            if time.monotonic() > give_up_s:
                raise NodeError(f"no {what} within {patience_s:g} s")
            time.sleep(0.002)
        return found


@contextmanager
def _busy(count: int) -> Iterator[None]:
    """`count` processes that compute without end."""
    words = ["sh", "-c", 'for _ in "$@"; do while :; do :; done & done; wait', "sh", *"x" * count]
    running = subprocess.Popen(words, start_new_session=True)
    try:
        yield
    finally:
        os.killpg(running.pid, signal.SIGKILL)
        running.wait()


if __name__ == "__main__":
    typer.run(stop)
