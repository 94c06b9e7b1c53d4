"""How many robots and cameras one router, and this computer, carry: rates, latency, CPU.

Every robot is a process that follows its commands without a simulator, and a command node; one
worker serves all of them. Cameras are one camera node that publishes an image with a sensor's
noise, read raw by this process.
"""

from __future__ import annotations

import os
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import cv2
import zenoh
from vla_zenoh_benchmarks.command_runner import cpu_s

from benchmarks.chain.process import Server
from benchmarks.picture import HEIGHT, WIDTH, noisy_picture
from vla_zenoh.bus.buffers import bytes_of, header_of
from vla_zenoh.bus.metrics import Percentiles
from vla_zenoh.bus.session import open_session
from vla_zenoh.client.client import Client
from vla_zenoh.codec.image import MAX_IMAGE_BYTES
from vla_zenoh.errors import CodecError, NodeError, SessionError
from vla_zenoh.keys import worker_node
from vla_zenoh.profile import Profile, as_robot, override, to_yaml
from vla_zenoh.runtime.process import ROUTER_PATIENCE_S
from vla_zenoh.runtime.supervisor import NodeCommand, Supervisor

MODEL, SCRIPTED = Path(__file__).parent / "declared_cost.py", "scripted"
WORKER, RATE_HZ, CAMERA_HZ = "model", 10.0, 30.0
PROMPT = "HARD: go up within 0.1"
READY_S, SETTLE_S, POLL_S = 60.0, 3.0, 0.1
HELD_SHARE, HELD_CHUNKS = 0.98, 0.9
"""Of the requested rates; below this it does not hold. Chunks of a declared cost do not count."""
GONE_S = 3.0


class Load:
    """Everything of the benchmark, up while the context lasts.

    Args:
        profile: of a simulated robot, at an address of its own.
        stop: set by Ctrl-C.
        log: (node, line) for what nodes write.
        declared: options of the model of declared cost; None: the scripted one, which takes none.
    """

    def __init__(
        self,
        profile: Profile,
        stop: threading.Event,
        log: Callable[[str, str], None],
        declared: Mapping[str, str] | None = None,
    ) -> None:
        model = str(MODEL) if declared else SCRIPTED
        options = {**declared, "cameras": "0"} if declared else {"camera": ""}
        changes = {
            "task": {"worker": WORKER, "rate_hz": RATE_HZ},
            "workers": [WORKER],
            "models": {WORKER: model},
            "options": {WORKER: options},
        }
        self._profile = override(profile, changes)
        self._chunks_hz = 0.0 if declared else HELD_CHUNKS * RATE_HZ
        self._stop, self._log = stop, log
        self._stack = ExitStack()
        self._supervisors: dict[str, Supervisor] = {}
        self._servers: dict[str, Server] = {}
        self._clients: dict[str, Client] = {}

    def __enter__(self) -> Load:
        made = self._stack.enter_context(tempfile.TemporaryDirectory(prefix="vla-zenoh-load-"))
        self._folder = Path(made)
        endpoint = self._profile.session.listen[0]
        self._servers["router"] = self._stack.enter_context(Server("router", endpoint))
        self._session = self._stack.enter_context(
            open_session(self._profile.session, wait_s=ROUTER_PATIENCE_S)
        )
        return self

    def __exit__(self, *_: object) -> None:
        for supervisor in self._supervisors.values():
            supervisor.kill()
        self._stack.close()

    # -- robots -------------------------------------------------------------------------------
    def robots(self, counts: Sequence[int], seconds: float) -> Iterator[dict[str, Any]]:
        """A row for each count, from the smallest on; robots that are up stay.

        Raises:
            NodeError: Ctrl-C.
        """
        names = [f"r{number}" for number in range(1, max(counts) + 1)]
        served = {"robot": {"name": names[0]}, "serves": {WORKER: names}}
        self._profile = override(self._profile, served)
        file = self._file(self._profile)
        self._start("worker", ("worker", WORKER, "--profile", str(file)))
        for count in sorted(counts):
            for name in names[len(self._clients) : count]:
                self._add(name)
            give_up_s = time.monotonic() + READY_S
            refused = [name for name in names[:count] if not self._activate(name, give_up_s)]
            row = self._measure_robots(names[:count], seconds)
            yield {"robots": count, "cameras": 0, "not_activated": refused, **row}

    def _add(self, name: str) -> None:
        profile = as_robot(self._profile, name)
        file = self._file(profile)
        self._servers[name] = self._stack.enter_context(Server("follower", str(file)))
        self._start(f"command {name}", ("node", "command", "--profile", str(file)))
        self._clients[name] = Client(profile, self._session).subscribe()

    def _activate(self, name: str, give_up_s: float) -> bool:
        """Whether a robot moves by then."""
        client = self._clients[name]
        while time.monotonic() < give_up_s:
            self._wait(POLL_S)
            status = client.status("command")
            if status is None:
                continue
            if status.state == "active":
                return True
            try:
                client.set_prompt(PROMPT)
                client.activate()
                return True
            except SessionError:
                continue
        return False

    def _measure_robots(self, names: Sequence[str], seconds: float) -> dict[str, Any]:
        self._wait(SETTLE_S)
        before, began_s = self._spent(), time.monotonic()
        missed = {name: self._missed(name) for name in names}
        self._wait(seconds)
        took_s = time.monotonic() - began_s
        cores = self._cores(before, took_s)
        loops, chunks, states, p50s, p95s, late = [], [], [], [], [], []
        active = 0
        for name in names:
            snapshot = self._clients[name].snapshot()
            status, age_s, _ = snapshot.get("command", (None, 0.0, False))
            if status is None or age_s > GONE_S:
                continue
            active += status.state == "active"
            loops.append(status.rates_hz.get("loop", 0.0))
            late.append((status.detail.get("late_us") or {}).get("p99", 0.0))
            if "end_to_end" in status.latency_ms:
                p50s.append(status.latency_ms["end_to_end"][0])
                p95s.append(status.latency_ms["end_to_end"][1])
            for node, rate, out in (
                (worker_node(WORKER), "chunks", chunks),
                (self._profile.robot.driver, "state", states),
            ):
                if node in snapshot:
                    out.append(snapshot[node][0].rates_hz.get(rate, 0.0))
        timing = self._profile.timing
        ticks = sum(self._missed(name) - missed[name] for name in names)
        held = (
            active == len(names)
            and _least(loops) >= HELD_SHARE * timing.command_hz
            and _least(chunks) >= self._chunks_hz
        )
        return {
            "active": active,
            "command_hz": _least(loops),
            "missed_ticks": ticks,
            "late_p99_us": max(late, default=0.0),
            "state_hz": _least(states),
            "chunks_hz": _least(chunks),
            "latency_p50_ms": round(max(p50s, default=0.0), 1),
            "latency_p95_ms": round(max(p95s, default=0.0), 1),
            "cores": cores,
            "held": held,
        }

    def _missed(self, name: str) -> int:
        status = self._clients[name].status("command")
        return int(status.counters.get("command.missed_ticks", 0)) if status else 0

    # -- cameras ------------------------------------------------------------------------------
    def cameras(self, counts: Sequence[int], seconds: float) -> Iterator[dict[str, Any]]:
        """A row for each number of cameras; no robot is up."""
        picture = self._folder / "picture.png"
        cv2.imwrite(str(picture), noisy_picture())
        camera = {"source": f"file:{picture}", "width": WIDTH, "height": HEIGHT}
        removed = {name: None for name in self._profile.cameras}
        for count in counts:
            names = [f"c{number}" for number in range(1, count + 1)]
            more = {name: {**camera, "rate_hz": CAMERA_HZ} for name in names}
            changes = {
                "cameras": {**removed, **more},
                "hosts": {"here": {"nodes": ["camera"]}},
            }
            profile = override(as_robot(self._profile, f"cameras{count}"), changes)
            self._start("camera", ("node", "camera", "--profile", str(self._file(profile))))
            row = self._measure_cameras(profile, names, seconds)
            self._supervisors.pop("camera").kill()
            yield {"robots": 0, "cameras": count, **row}

    def _measure_cameras(
        self, profile: Profile, names: Sequence[str], seconds: float
    ) -> dict[str, Any]:
        meters = {name: _Pictures() for name in names}
        subscribers = [
            self._session.declare_subscriber(
                profile.keys.camera_raw(name), zenoh.handlers.Callback(meter, indirect=False)
            )
            for name, meter in meters.items()
        ]
        give_up = time.monotonic() + READY_S
        while any(not meter.count for meter in meters.values()) and time.monotonic() < give_up:
            self._wait(POLL_S)
        self._wait(SETTLE_S)
        for meter in meters.values():
            meter.begin()
        before, began_s = self._spent(), time.monotonic()
        self._wait(seconds)
        took_s = time.monotonic() - began_s
        rates = [meter.count / took_s for meter in meters.values()]
        cores = self._cores(before, took_s)
        ages = [summary for meter in meters.values() if (summary := meter.ages_ms.summary())]
        for subscriber in subscribers:
            subscriber.undeclare()
        return {
            "camera_hz": _least(rates),
            "latency_p50_ms": round(max((p50 for p50, _ in ages), default=0.0), 1),
            "latency_p95_ms": round(max((p95 for _, p95 in ages), default=0.0), 1),
            "mib_s": round(sum(rates) * WIDTH * HEIGHT * 3 / 1024**2, 1),
            "cores": cores,
            "held": _least(rates) >= HELD_SHARE * CAMERA_HZ,
        }

    # -- processes ----------------------------------------------------------------------------
    def _file(self, profile: Profile) -> Path:
        path = self._folder / f"{profile.robot.name}.yaml"
        path.write_text(to_yaml(profile), "utf-8")
        return path

    def _start(self, name: str, arguments: tuple[str, ...]) -> None:
        command = NodeCommand(name, name.split()[0], arguments)
        supervisor = Supervisor([command], log=self._log, tell=self._log)
        self._supervisors[name] = supervisor
        supervisor.start()

    def _wait(self, seconds: float) -> None:
        if self._stop.wait(seconds):
            raise NodeError("interrupted")
        for supervisor in self._supervisors.values():
            if not supervisor.poll():
                raise NodeError("a node keeps crashing; its output is above")

    def _pids(self) -> Mapping[str, list[int]]:
        found: dict[str, list[int]] = {"bench": [os.getpid()]}
        for name, server in self._servers.items():
            found.setdefault("router" if name == "router" else "robot", []).append(server.pid)
        for supervisor in self._supervisors.values():
            for name, (kind, pid) in supervisor.running().items():
                found.setdefault(kind or name, []).append(pid)
        return found

    def _spent(self) -> dict[str, float]:
        return {kind: sum(map(cpu_s, pids)) for kind, pids in self._pids().items()}

    def _cores(self, before: Mapping[str, float], took_s: float) -> dict[str, float]:
        """Kind of process -> cores it took since `before`."""
        return {
            kind: round((spent_s - before.get(kind, 0.0)) / took_s, 2)
            for kind, spent_s in self._spent().items()
        }


class _Pictures:
    """Counts the images of a camera, and their age on arrival."""

    def __init__(self) -> None:
        self.begin()

    def begin(self) -> None:
        """Restart the count."""
        self.count = 0
        self.ages_ms = Percentiles(4096)

    def __call__(self, sample: zenoh.Sample) -> None:
        now_ns = time.time_ns()
        try:
            header = header_of(sample)
            bytes_of(sample.payload, MAX_IMAGE_BYTES)  # a reader copies it, as a worker does
        except CodecError:
            return
        self.count += 1
        self.ages_ms.add((now_ns - header.stamp_wall_ns) / 1e6)


def _least(values: Sequence[float]) -> float:
    return round(min(values, default=0.0), 1)
