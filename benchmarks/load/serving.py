"""Age of a chunk as the robots of one model become more: our worker beside other servers.

A chunk's age is the time from the camera's stamp to the chunk's arrival at its robot, the same for
all. The robots are one process that publishes images or asks with them; the model sleeps for its
declared cost, c (1 + k (n - 1)) for n robots at once. The other servers answer one robot after
another, so each inference costs c there.
"""

from __future__ import annotations

import json
import os
import tempfile
import threading
import time
from collections.abc import Callable, Iterable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from rich.box import SIMPLE
from rich.table import Table
from vla_zenoh_benchmarks.command_runner import cpu_s
from vla_zenoh_benchmarks.result_file import ResultOptions, kept_rows

from benchmarks import peers
from benchmarks.chain.process import Server, free_port
from benchmarks.load.serving_figure import ALONE, BATCHED, LABELS, write_figures
from benchmarks.picture import noisy_picture
from vla_zenoh.bus.buffers import CallbackRing
from vla_zenoh.bus.node import Node
from vla_zenoh.bus.session import open_session
from vla_zenoh.cli.options import options
from vla_zenoh.cli.output import errors
from vla_zenoh.client.client import Client
from vla_zenoh.errors import NodeError
from vla_zenoh.keys import Kind, worker_node
from vla_zenoh.lab.cli.options import number_list
from vla_zenoh.nodes.camera.camera_publisher import CameraPublisher
from vla_zenoh.profile import Profile, as_robot, load_profile, override, to_yaml
from vla_zenoh.runtime.process import ROUTER_PATIENCE_S
from vla_zenoh.runtime.supervisor import NodeCommand, Supervisor
from vla_zenoh.types import ActionChunk, Task

MODEL, WORKER = Path(__file__).parent / "declared_cost.py", "declared"
PROMPT = "hold"
CAMERA_HZ, TASK_PERIOD_S = 30.0, 0.2
READY_S, SETTLE_S, POLL_S, STATUS_S = 60.0, 1.0, 0.1, 1.5
MAX_CHUNKS = 4096
MOST = 100
OLDEST_S = load_profile("panda_sim").timing.max_observation_age_s
"""A chunk of an older image is rejected by a command node of ours."""
FULL_SHARE = 0.9
"""Of the processors, from which on the figures are those of a full computer."""


@dataclass(frozen=True, slots=True)
class Setup:
    """What every way serves.

    Args:
        robots: their number.
        cost_ms: of an inference for one robot.
        growth: share of it that each further robot adds in a batch; None: one robot at a time.
        rate_hz: of inferences, requested by each robot.
        side: width and height of an image.
        seconds: how long it is measured.
    """

    robots: int
    cost_ms: float
    growth: float | None
    rate_hz: float
    side: int
    seconds: float


@dataclass(slots=True)
class Ages:
    """Ages of the chunks of each robot, in ms."""

    of_robot: list[list[float]] = field(default_factory=list)

    def row(self, took_s: float, oldest_s: float) -> dict[str, Any]:
        """Percentiles over all and of the worst robot, the rate of the robot that gets least, and
        the share that a command node would reject as older than `oldest_s`."""
        least = min(map(len, self.of_robot))
        if not least:
            raise NodeError(f"a robot had no chunk in {took_s:g} s: measure longer (--seconds)")
        every = np.concatenate([np.asarray(ages) for ages in self.of_robot])
        p50, p95 = np.percentile(every, [50, 95])
        worst = max(float(np.percentile(ages, 95)) for ages in self.of_robot)
        return {
            "age_p50_ms": round(float(p50), 1),
            "age_p95_ms": round(float(p95), 1),
            "worst_robot_p95_ms": round(worst, 1),
            "chunks": len(every),
            "chunks_hz": round(least / took_s, 2),
            "too_old": round(float(np.mean(every > 1e3 * oldest_s)), 3),
        }


class Meter:
    """Cores that processes take, and the computer as a whole, from now on."""

    def __init__(self, pids: dict[str, int]) -> None:
        self._pids = pids
        self._began_s, self._spent, self._busy_s = time.monotonic(), self._now(), busy_s()

    def _now(self) -> dict[str, float]:
        return {name: cpu_s(pid) for name, pid in self._pids.items()}

    def row(self) -> dict[str, Any]:
        """What a result has of it."""
        took_s, now = time.monotonic() - self._began_s, self._now()
        cores = {name: round((now[name] - self._spent[name]) / took_s, 2) for name in now}
        busy = round((busy_s() - self._busy_s) / took_s, 2)
        return {"cores": cores, "busy_cores": busy, "host_cores": os.cpu_count() or 1}


def busy_s() -> float:
    """Processor time of this computer so far, of all processes."""
    user, nice, system, _, _, irq, softirq, *_ = Path("/proc/stat").read_text().split()[1:9]
    return sum(map(int, (user, nice, system, irq, softirq))) / os.sysconf("SC_CLK_TCK")


def frame_time(now_s: float, robot: int, robots: int) -> float:
    """When a robot's camera took its newest image; the cameras take turns."""
    shift_s = robot / robots / CAMERA_HZ
    return shift_s + np.floor((now_s - shift_s) * CAMERA_HZ) / CAMERA_HZ


# -- other servers ---------------------------------------------------------------------------------
def ask_peer(peer: str, setup: Setup, stop: threading.Event) -> dict[str, Any]:
    """The row of another server; each robot is a client in a thread of its own."""
    port = free_port()
    ages = Ages([[] for _ in range(setup.robots)])
    with Server("peer", peer, str(port), str(setup.cost_ms / 1e3)) as server:
        server.await_port(port)
        ended = threading.Event()
        measured_s = time.monotonic() + SETTLE_S
        threads = [
            threading.Thread(target=_ask, args=(peer, setup, index, port, ages, measured_s, ended))
            for index in range(setup.robots)
        ]
        for thread in threads:
            thread.start()
        try:
            _wait(SETTLE_S, stop)
            meter = Meter({"server": server.pid, "robots": os.getpid()})
            _wait(setup.seconds, stop)
            spent = meter.row()
        finally:
            ended.set()
            for thread in threads:
                thread.join()
    return ages.row(setup.seconds, OLDEST_S) | spent


def _ask(
    peer: str,
    setup: Setup,
    index: int,
    port: int,
    ages: Ages,
    measured_s: float,
    ended: threading.Event,
) -> None:
    client = peers.load(peer).Client(port)
    picture = [noisy_picture(setup.side, setup.side)]
    due_s = time.monotonic()
    while not ended.wait(max(due_s - time.monotonic(), 0.0)):
        began_s = time.monotonic()
        taken_s = frame_time(began_s, index, setup.robots)
        client.request(picture)
        now_s = time.monotonic()
        if now_s >= measured_s and not ended.is_set():
            ages.of_robot[index].append(1e3 * (now_s - taken_s))
        due_s = max(due_s + 1 / setup.rate_hz, began_s)
    client.close()


# -- our worker ------------------------------------------------------------------------------------
class Robots:
    """Robots of which there is only what a worker knows: images, a task, and who reads chunks."""

    def __init__(self, setup: Setup, profiles: Sequence[Profile], session: Any) -> None:
        self._setup, self._session = setup, session
        self.nodes = [Node("camera", profile, session) for profile in profiles]
        commands = [Node("command", profile, session) for profile in profiles]
        self._tasks = [node.declare_publisher(node.keys.task, Kind.STATE) for node in commands]
        self._cameras = [
            CameraPublisher("front", profile.cameras["front"], "benchmark", node, node.emit)
            for profile, node in zip(profiles, self.nodes, strict=True)
        ]
        self._chunks = [
            node.subscribe(node.keys.delta(WORKER), CallbackRing(MAX_CHUNKS)) for node in self.nodes
        ]
        # Another one each time: the same image twice would be a camera that hangs.
        self._pictures = [noisy_picture(setup.side, setup.side) for _ in range(2)]
        self._pictures[1] = np.ascontiguousarray(self._pictures[1][::-1])
        self._nodes = [*self.nodes, *commands]

    def publish(self, ended: threading.Event) -> None:
        """Images at the camera's rate, and the task, until `ended`."""
        count, period_s = self._setup.robots, 1 / CAMERA_HZ
        task = Task(1, True, PROMPT, WORKER, self._setup.rate_hz)
        began_s, turn, task_s = time.monotonic(), 0, 0.0
        while not ended.wait(max(began_s + turn * period_s / count - time.monotonic(), 0.0)):
            index, number = turn % count, turn // count
            if time.monotonic() >= task_s:
                for tasks in self._tasks:
                    tasks.publish(task)
                task_s = time.monotonic() + TASK_PERIOD_S
            mono_ns, wall_ns = time.monotonic_ns(), self.nodes[index].clock.wall_ns()
            camera = self._cameras[index]
            camera.captured(mono_ns)
            camera.publish_rgb(self._pictures[number % 2], mono_ns, wall_ns)
            turn += 1

    def answered(self) -> bool:
        """Whether each robot has a chunk that was not counted yet."""
        return all(chunks.has_new for chunks in self._chunks)

    def ages(self) -> Ages:
        """Ages of the chunks since the last call."""
        found = Ages()
        for node, chunks in zip(self.nodes, self._chunks, strict=True):
            behind_ns = node.clock.wall_ns() - time.monotonic_ns()
            every = [(arrival, node.decode(ActionChunk, arrival)) for arrival in chunks.drain()]
            found.of_robot.append(
                [
                    (arrival.mono_ns + behind_ns - chunk.record.observation_stamp_ns) / 1e6
                    for arrival, chunk in every
                    if chunk is not None
                ]
            )
        return found

    def complaint(self) -> str:
        """What the worker says of each robot that has no chunk."""
        waiting = [
            Client(node.profile, self._session).subscribe()
            for node, chunks in zip(self.nodes, self._chunks, strict=True)
            if not chunks.has_new
        ]
        time.sleep(STATUS_S)
        told = (client.status(worker_node(WORKER)) for client in waiting)
        found = {status.detail["complaint"] if status else "silent" for status in told}
        return "; ".join(sorted(found)) or "it has ended"

    def close(self) -> None:
        """Close the nodes."""
        for node in self._nodes:
            node.close()


def model_options(setup: Setup) -> dict[str, str]:
    """Of the model of declared cost."""
    cost = {"cost_ms": f"{setup.cost_ms:g}"}
    if setup.growth is None:
        return cost | {"max_batch": "1"}
    return cost | {"growth": f"{setup.growth:g}"}


def bench_profile(setup: Setup, endpoint: str, names: Sequence[str]) -> Profile:
    """The profile of the first robot, whose worker serves all."""
    shipped = load_profile("panda_sim")
    front = {"width": setup.side, "height": setup.side, "rate_hz": CAMERA_HZ}
    others = {name: None for name in shipped.cameras if name != "front"}
    return override(
        shipped,
        {
            "robot": {"name": names[0]},
            "session": {"listen": [endpoint], "connect": [endpoint]},
            "cameras": {"front": front, **others},
            "task": {"worker": WORKER, "rate_hz": setup.rate_hz},
            "workers": [WORKER],
            "models": {WORKER: str(MODEL)},
            "options": {WORKER: model_options(setup)},
            "serves": {WORKER: list(names)},
        },
    )


def serve_ours(
    setup: Setup, stop: threading.Event, log: Callable[[str, str], None]
) -> dict[str, Any]:
    """The row of a router and our worker."""
    names = [f"r{number}" for number in range(1, setup.robots + 1)]
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    profile = bench_profile(setup, endpoint, names)
    with ExitStack() as up:
        folder = up.enter_context(tempfile.TemporaryDirectory(prefix="vla-zenoh-serving-"))
        file = Path(folder) / "robots.yaml"
        file.write_text(to_yaml(profile), "utf-8")
        router = up.enter_context(Server("router", endpoint))
        session = up.enter_context(open_session(profile.session, wait_s=ROUTER_PATIENCE_S))
        arguments = ("worker", WORKER, "--profile", str(file), "--images", "raw")
        supervisor = Supervisor([NodeCommand("worker", "worker", arguments)], log=log, tell=log)
        supervisor.start()
        up.callback(supervisor.kill)
        robots = Robots(setup, [as_robot(profile, name) for name in names], session)
        up.callback(robots.close)
        ended = threading.Event()
        publishing = threading.Thread(target=robots.publish, args=(ended,))
        publishing.start()
        up.callback(publishing.join)
        up.callback(ended.set)
        give_up_s = time.monotonic() + READY_S
        while not robots.answered():
            if not supervisor.poll() or time.monotonic() > give_up_s:
                raise NodeError(f"the worker does not answer every robot: {robots.complaint()}")
            _wait(POLL_S, stop)
        _wait(SETTLE_S, stop)
        robots.ages()
        (worker,) = supervisor.pids().values()
        meter = Meter({"router": router.pid, "worker": worker, "robots": os.getpid()})
        _wait(setup.seconds, stop)
        spent = meter.row()
        return robots.ages().row(setup.seconds, OLDEST_S) | spent


def _wait(seconds: float, stop: threading.Event) -> None:
    if stop.wait(seconds):
        raise NodeError("interrupted")


# -- the command -----------------------------------------------------------------------------------
@options
def serving(
    output: ResultOptions,
    robots: Annotated[
        str, typer.Option("--robots", help="Numbers of robots, separated by commas.")
    ] = "1,2,4,8,16",
    model_ms: Annotated[
        str, typer.Option("--model-ms", help="Costs c of an inference for one robot.")
    ] = "20,80,140",
    growth: Annotated[
        str, typer.Option("--growth", help="Shares k of c that each further robot adds.")
    ] = "0.15,0.5,1",
    only: Annotated[
        list[str] | None,
        typer.Option("--only", help=f"Measure only this way of {', '.join(LABELS)}; repeatable."),
    ] = None,
    rate_hz: Annotated[
        float, typer.Option("--rate", min=0.5, max=50, help="Inferences a robot asks for, in Hz.")
    ] = 10.0,
    side: Annotated[
        int, typer.Option("--side", min=32, max=1024, help="Width and height of an image.")
    ] = 224,
    seconds: Annotated[
        float, typer.Option("--seconds", min=2, max=600, help="How long each is measured.")
    ] = 8.0,
    earlier: Annotated[
        list[Path] | None,
        typer.Option("--show", help="Measure nothing, show this result; repeatable."),
    ] = None,
    pictures: Annotated[
        Path | None, typer.Option("--pictures", help="Folder for the curves, as SVG and PDF.")
    ] = None,
) -> None:
    """Measure the age of chunks as robots of one model become more, beside other servers.

    The model costs c (1 + k (n - 1)) ms for n robots at once.
    """
    from vla_zenoh.runtime.process import die_with_parent, stop_on_signals

    unknown = set(only or ()) - LABELS.keys()
    if unknown:
        raise typer.BadParameter(f"--only {', '.join(unknown)}: it is one of {', '.join(LABELS)}")
    if earlier:
        rows = [row for file in earlier for row in json.loads(file.read_text("utf-8"))]
        _show(output, rows, pictures)
        return
    counts = sorted({int(count) for count in number_list("--robots", robots, 1, MOST)})
    costs = number_list("--model-ms", model_ms, 1, 10_000)
    shares = number_list("--growth", growth, 0, 1)
    stop = stop_on_signals()
    die_with_parent()
    with kept_rows(output) as rows:
        for cost_ms in costs:
            for way, share in _ways(only or list(LABELS), shares):
                for count in counts:
                    if count == 1 and share not in (None, shares[0]):
                        continue  # a batch of one has no share
                    setup = Setup(count, cost_ms, share, rate_hz, side, seconds)
                    what = {"way": way, "robots": count, "model_ms": cost_ms, "growth": share}
                    ours = way in (BATCHED, ALONE)
                    found = (
                        serve_ours(setup, stop, rows.log) if ours else ask_peer(way, setup, stop)
                    )
                    rows.append(what | {"seconds": seconds} | found)
                    errors().print(f"{way}, {count} robots measured", style="dim")
                    if full := fullest(rows[-1]):
                        errors().print(f"the processors are full, most of it {full}")
                        break
        compare(rows)
    _show(output, rows, pictures)


def _ways(chosen: Sequence[str], shares: Sequence[float]) -> Iterable[tuple[str, float | None]]:
    for way in LABELS:
        if way in chosen:
            yield from ((way, share) for share in (shares if way == BATCHED else (None,)))


def fullest(row: dict[str, Any]) -> str:
    """The process that takes most where ours fill the processors; else empty."""
    cores = row["cores"]
    full = sum(cores.values()) >= FULL_SHARE * row["host_cores"]
    return max(cores, key=lambda name: cores[name]) if full else ""


def compare(rows: list[dict[str, Any]]) -> None:
    """Add to each of our rows its p95 as a share of that of openpi's server."""
    theirs = {
        (row["robots"], row["model_ms"]): row["age_p95_ms"]
        for row in rows
        if row["way"] == "openpi"
    }
    for row in rows:
        other = theirs.get((row["robots"], row["model_ms"]))
        if row["way"] in (BATCHED, ALONE) and other is not None:
            row["p95_of_openpi"] = round(row["age_p95_ms"] / other, 2)


def _show(output: ResultOptions, rows: list[dict[str, Any]], pictures: Path | None) -> None:
    for file in write_figures(pictures, rows) if pictures is not None else ():
        errors().print(str(file), style="dim")
    order = list(LABELS)
    table = Table(box=SIMPLE, pad_edge=False)
    for column in (
        *("c", "robots", "way", "k", "age p50", "p95", "worst robot", "of openpi's"),
        *("chunks Hz", "too old", "cores", "busy"),
    ):
        table.add_column(column, justify="left" if column == "way" else "right")
    for row in sorted(
        rows,
        key=lambda row: (
            row["model_ms"],
            row["robots"],
            order.index(row["way"]),
            row["growth"] or 0,
        ),
    ):
        cores = ", ".join(f"{name} {share:g}" for name, share in row["cores"].items())
        table.add_row(
            f"{row['model_ms']:g} ms",
            str(row["robots"]),
            row["way"],
            "" if row["growth"] is None else f"{row['growth']:g}",
            *(f"{row[name]:.0f} ms" for name in ("age_p50_ms", "age_p95_ms", "worst_robot_p95_ms")),
            f"{row['p95_of_openpi']:g}" if "p95_of_openpi" in row else "",
            f"{row['chunks_hz']:g}",
            f"{row['too_old']:.0%}",
            cores,
            f"{row['busy_cores']:g} of {row['host_cores']}",
        )
    output.show(rows, table)
