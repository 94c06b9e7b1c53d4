"""Age of a chunk as the robots of one model become more: our worker beside other servers.

A chunk's age is the time from the cameras' stamp to the chunk's arrival at its robot, the same for
all. The robots are one process that publishes images or asks with them; the model sleeps for its
declared cost, c (1 + k (n - 1)) for n robots at once. The other servers answer one robot after
another, so each inference costs c there. LeRobot's serves one robot, so each has one, and they take
turns on one GPU.
"""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np
import typer
from rich.box import SIMPLE
from rich.table import Table
from vla_zenoh_benchmarks.command_runner import cpu_s
from vla_zenoh_benchmarks.result_file import ResultOptions, kept_rows

from benchmarks.chain.process import CHECKOUT, free_port
from benchmarks.footprint import memory
from benchmarks.load.ages import Came, age_row
from benchmarks.load.asking import CAMERA_HZ, Asked
from benchmarks.load.declared_cost import CAMERAS
from benchmarks.load.serving_figure import ALONE, BATCHED, LABELS, LEROBOT, write_figures
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
from vla_zenoh.policy import CameraSpec
from vla_zenoh.policy.observation import size_variant
from vla_zenoh.profile import Profile, as_robot, load_profile, override, to_yaml
from vla_zenoh.runtime.process import ROUTER_PATIENCE_S
from vla_zenoh.runtime.supervisor import NodeCommand, Supervisor
from vla_zenoh.types import ActionChunk, Task

MODEL, WORKER = Path(__file__).parent / "declared_cost.py", "declared"
PROMPT = "hold"
TASK_PERIOD_S = 0.2
READY_S, SETTLE_S, POLL_S, STATUS_S = 60.0, 1.0, 0.1, 1.5
SETTLE_ROUNDS, ROUNDS = 1.5, 4
"""Of all robots one after another: before it is measured, and how many at least."""
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
        seconds: how long it is measured at least.
        cameras: of each robot.
        jpeg: images travel as JPEG of the model's size, and nothing in shared memory, as to a
            worker on another host.
    """

    robots: int
    cost_ms: float
    growth: float | None
    rate_hz: float
    side: int
    seconds: float
    cameras: int = 1
    jpeg: bool = False

    @property
    def round_s(self) -> float:
        """An inference for each robot, one after another."""
        return self.robots * self.cost_ms / 1e3

    @property
    def settle_s(self) -> float:
        """Before it is measured."""
        return max(SETTLE_S, SETTLE_ROUNDS * self.round_s)

    @property
    def measured_s(self) -> float:
        """How long it is measured."""
        return max(self.seconds, ROUNDS * self.round_s)


class Meter:
    """Cores that processes take, and the computer as a whole, from now on."""

    def __init__(self, pids: dict[str, list[int]]) -> None:
        self._pids = pids
        self._began_s, self._spent, self._busy_s = time.monotonic(), self._now(), busy_s()

    def _now(self) -> dict[str, float]:
        return {name: sum(map(cpu_s, pids)) for name, pids in self._pids.items()}

    def row(self) -> dict[str, Any]:
        """What a result has of it; memory is what a process has for itself alone."""
        took_s, now = time.monotonic() - self._began_s, self._now()
        cores = {name: round((now[name] - self._spent[name]) / took_s, 3) for name in now}
        busy = round((busy_s() - self._busy_s) / took_s, 2)
        own = {name: round(sum(map(own_mb, pids)), 1) for name, pids in self._pids.items()}
        return {"cores": cores, "busy_cores": busy, "host_cores": os.cpu_count() or 1, "mb": own}


def own_mb(pid: int) -> float:
    """Memory of a process that no other one shares."""
    return memory(pid)["own_mb"]


def busy_s() -> float:
    """Processor time of this computer so far, of all processes."""
    user, nice, system, _, _, irq, softirq, *_ = Path("/proc/stat").read_text().split()[1:9]
    return sum(map(int, (user, nice, system, irq, softirq))) / os.sysconf("SC_CLK_TCK")


# -- other servers ---------------------------------------------------------------------------------
def ask_peer(peer: str, python: Path, setup: Setup, stop: threading.Event) -> dict[str, Any]:
    """The row of another server; each robot is a client in a thread of its own."""
    asked = Asked(
        setup.robots,
        setup.robots if peer == LEROBOT else 1,
        setup.cost_ms,
        setup.rate_hz,
        setup.side,
        setup.cameras,
        setup.settle_s,
        setup.measured_s,
    )
    command = [str(python), "-m", "benchmarks.load.asking", peer, asked.text()]
    with ExitStack() as up:
        # LeRobot writes logs where it is started.
        folder = Path(up.enter_context(tempfile.TemporaryDirectory(prefix="vla-zenoh-serving-")))
        said = up.enter_context((folder / "said").open("wb+"))
        process = subprocess.Popen(
            command,
            cwd=folder,
            env={**os.environ, "PYTHONPATH": str(CHECKOUT)},
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=said,
        )
        assert process.stdout is not None
        up.callback(process.wait, READY_S)
        up.callback(process.kill)  # its servers end with it
        lines = map(json.loads, up.enter_context(process.stdout))
        try:
            pids = next(lines)
            meter = Meter({"server": pids["servers"], "robots": [pids["robots"]]})
            _wait(setup.measured_s - SETTLE_S, stop)
            spent = meter.row()
            found = next(lines)
        except StopIteration:
            told = (folder / "said").read_text("utf-8", "replace")
            raise NodeError(f"{peer}'s robots or server have ended: {told[-2000:]}") from None
    return age_row(found["came"], setup.measured_s, OLDEST_S) | spent


# -- our worker ------------------------------------------------------------------------------------
class Robots:
    """Robots of which there is only what a worker knows: images, a task, and who reads chunks."""

    def __init__(self, setup: Setup, profiles: Sequence[Profile], session: Any) -> None:
        self._setup, self._session = setup, session
        self.nodes = [Node("camera", profile, session) for profile in profiles]
        commands = [Node("command", profile, session) for profile in profiles]
        self._tasks = [node.declare_publisher(node.keys.task, Kind.STATE) for node in commands]
        self._cameras = [
            [
                CameraPublisher(name, profile.cameras[name], "benchmark", node, node.emit)
                for name in CAMERAS[: setup.cameras]
            ]
            for profile, node in zip(profiles, self.nodes, strict=True)
        ]
        if setup.jpeg:
            for camera in (camera for cameras in self._cameras for camera in cameras):
                camera.fitted.serve(fitted_size(camera.name, setup.side))
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
            for camera in self._cameras[index]:
                camera.captured(mono_ns)
                camera.publish_rgb(self._pictures[number % 2], mono_ns, wall_ns)
            turn += 1

    def answered(self) -> bool:
        """Whether each robot has a chunk that was not counted yet."""
        return all(chunks.has_new for chunks in self._chunks)

    def came(self) -> Came:
        """Of each robot, when an image was taken and its chunk came, since the last call."""
        found = []
        for node, chunks in zip(self.nodes, self._chunks, strict=True):
            behind_ns = node.clock.wall_ns() - time.monotonic_ns()
            every = [(arrival, node.decode(ActionChunk, arrival)) for arrival in chunks.drain()]
            found.append(
                [
                    (
                        (chunk.record.observation_stamp_ns - behind_ns) / 1e9,
                        arrival.mono_ns / 1e9,
                    )
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


def fitted_size(camera: str, side: int) -> dict[str, CameraSpec]:
    """The size that the model asks for, by the name of its stream."""
    spec = CameraSpec(camera=camera, width=side, height=side, resize="pad")
    return {str(size_variant(spec)): spec}


class Link(NamedTuple):
    """What a process has sent and received on its TCP connections, bytes."""

    sent: int
    received: int


def link_of(pid: int) -> Link:
    """Of a process so far, as ``ss`` tells.

    Raises:
        NodeError: ``ss`` (iproute2) is missing.
    """
    try:
        told = subprocess.run(["ss", "-tinpHO"], capture_output=True, text=True, check=True).stdout
    except (OSError, subprocess.CalledProcessError) as error:
        raise NodeError(f"--jpeg counts bytes with ss of iproute2: {error}") from error
    return read_link(told, pid)


def read_link(told: str, pid: int) -> Link:
    """The sums of a process over the lines of ``ss``."""
    mine = [line for line in told.splitlines() if f"pid={pid}," in line]
    sent, received = (
        sum(int(count) for line in mine for count in re.findall(rf"\b{word}:(\d+)", line))
        for word in ("bytes_sent", "bytes_received")
    )
    return Link(sent, received)


def model_options(setup: Setup) -> dict[str, str]:
    """Of the model of declared cost."""
    cost = {"cost_ms": f"{setup.cost_ms:g}", "cameras": str(setup.cameras)}
    if setup.jpeg:
        cost["side"] = str(setup.side)
    if setup.growth is None:
        return cost | {"max_batch": "1"}
    return cost | {"growth": f"{setup.growth:g}"}


def bench_profile(setup: Setup, endpoint: str, names: Sequence[str]) -> Profile:
    """The profile of the first robot, whose worker serves all."""
    shipped = load_profile("panda_sim")
    camera = {
        "source": "sim:front",
        "width": setup.side,
        "height": setup.side,
        "rate_hz": CAMERA_HZ,
        "fit_for_workers": setup.jpeg,
    }
    none: dict[str, Any] = dict.fromkeys(shipped.cameras)
    cameras = none | dict.fromkeys(CAMERAS[: setup.cameras], camera)
    session = {"listen": [endpoint], "connect": [endpoint], "shared_memory": not setup.jpeg}
    return override(
        shipped,
        {
            "robot": {"name": names[0]},
            "session": session,
            "cameras": cameras,
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
        images = "jpeg" if setup.jpeg else "raw"
        where = ("--profile", str(file))
        commands = [
            NodeCommand("router", "router", ("node", "router", *where)),
            NodeCommand("worker", "worker", ("worker", WORKER, *where, "--images", images)),
        ]
        supervisor = Supervisor(commands, log=log, tell=log)
        supervisor.start()
        up.callback(supervisor.kill)
        session = up.enter_context(open_session(profile.session, wait_s=ROUTER_PATIENCE_S))
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
        _wait(setup.settle_s, stop)
        robots.came()
        pids = supervisor.pids()
        worker = pids["worker"]
        before = link_of(worker) if setup.jpeg else None
        meter = Meter({"router": [pids["router"]], "worker": [worker], "robots": [os.getpid()]})
        _wait(setup.measured_s, stop)
        spent = meter.row()
        if before is not None:
            after = link_of(worker)
            spent["to_worker_kb_s"], spent["from_worker_kb_s"] = (
                round((now - then) / 1e3 / setup.measured_s, 1)
                for now, then in (
                    (after.received, before.received),
                    (after.sent, before.sent),
                )
            )
        return age_row(robots.came(), setup.measured_s, OLDEST_S) | spent


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
    cameras: Annotated[str, typer.Option("--cameras", help="Numbers of cameras of a robot.")] = "1",
    jpeg: Annotated[
        bool,
        typer.Option(
            "--jpeg",
            help="Send our worker JPEG without shared memory, as to another host; count bytes.",
        ),
    ] = False,
    lerobot: Annotated[
        Path | None,
        typer.Option("--lerobot", help="Python of an environment with lerobot[async]."),
    ] = None,
    seconds: Annotated[
        float, typer.Option("--seconds", min=2, max=600, help="How long each is measured.")
    ] = 8.0,
    earlier: Annotated[
        list[Path] | None,
        typer.Option("--show", help="Measure nothing, show this result; repeatable."),
    ] = None,
    pictures: Annotated[
        Path | None,
        typer.Option("--pictures", help="Folder for the curves: SVG, PNG and PDF, in two widths."),
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
        compare(rows)
        output.show(rows, *_tables(rows))
        _draw(rows, pictures)
        return
    counts = sorted({int(count) for count in number_list("--robots", robots, 1, MOST)})
    costs = number_list("--model-ms", model_ms, 1, 10_000)
    numbers = sorted({int(n) for n in number_list("--cameras", cameras, 1, len(CAMERAS))})
    chosen = only or [way for way in LABELS if lerobot is not None or way != LEROBOT]
    if lerobot is None and LEROBOT in chosen:
        raise typer.BadParameter("LeRobot's server needs --lerobot PYTHON")
    shares = number_list("--growth", growth, 0, 1)
    stop = stop_on_signals()
    die_with_parent()
    with kept_rows(output, _tables) as rows:
        for cost_ms, count_of_cameras, (way, share) in product(
            costs, numbers, _ways(chosen, shares)
        ):
            for count in counts:
                if count == 1 and share not in (None, shares[0]):
                    continue  # a batch of one has no share
                setup = Setup(count, cost_ms, share, rate_hz, side, seconds, count_of_cameras, jpeg)
                if way in (BATCHED, ALONE):
                    found = serve_ours(setup, stop, rows.log)
                else:
                    python = lerobot if way == LEROBOT and lerobot else Path(sys.executable)
                    found = ask_peer(way, python, setup, stop)
                what = {"way": way, "robots": count, "model_ms": cost_ms, "growth": share}
                how = {"cameras": count_of_cameras, "side": side, "jpeg": jpeg}
                rows.append(what | how | {"seconds": setup.measured_s} | found)
                errors().print(f"{way}, {count} robots measured", style="dim")
                if full := fullest(rows[-1]):
                    errors().print(f"the processors are full, most of it {full}")
                    break
        compare(rows)
    _draw(rows, pictures)


def _draw(rows: list[dict[str, Any]], pictures: Path | None) -> None:
    for file in write_figures(pictures, rows) if pictures is not None else ():
        errors().print(str(file), style="dim")


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
    theirs = {_served(row): row["age_p95_ms"] for row in rows if row["way"] == "openpi"}
    for row in rows:
        other = theirs.get(_served(row))
        if row["way"] in (BATCHED, ALONE) and other is not None:
            row["p95_of_openpi"] = round(row["age_p95_ms"] / other, 2)


def _served(row: dict[str, Any]) -> tuple[Any, ...]:
    return tuple(row[name] for name in ("robots", "model_ms", "cameras", "side"))


def _tables(rows: list[dict[str, Any]]) -> list[Table]:
    order = list(LABELS)
    table = Table(box=SIMPLE, pad_edge=False)
    for column in (
        *("c", "robots", "cameras", "way", "k", "age p50", "p95", "worst robot", "of openpi's"),
        *("held p50", "p95", "chunks Hz", "too old", "cores", "MB", "kB/s", "busy"),
    ):
        table.add_column(column, justify="left" if column == "way" else "right")
    for row in sorted(
        rows,
        key=lambda row: (
            row["model_ms"],
            row["cameras"],
            row["side"],
            row["robots"],
            order.index(row["way"]),
            row["growth"] or 0,
        ),
    ):
        cores = ", ".join(f"{name} {share:.2f}" for name, share in row["cores"].items())
        table.add_row(
            f"{row['model_ms']:g} ms",
            str(row["robots"]),
            f"{row['cameras']} of {row['side']}" + (", JPEG" if row["jpeg"] else ""),
            row["way"],
            "" if row["growth"] is None else f"{row['growth']:g}",
            *(f"{row[name]:.0f} ms" for name in ("age_p50_ms", "age_p95_ms", "worst_robot_p95_ms")),
            f"{row['p95_of_openpi']:g}" if "p95_of_openpi" in row else "",
            *(f"{row[name]:.0f} ms" for name in ("held_p50_ms", "held_p95_ms")),
            f"{row['chunks_hz']:g}",
            f"{row['too_old']:.0%}",
            cores,
            ", ".join(f"{name} {mb:.0f}" for name, mb in row["mb"].items()),
            f"{row['to_worker_kb_s']:.0f}" if row["jpeg"] and "to_worker_kb_s" in row else "",
            f"{row['busy_cores']:g} of {row['host_cores']}",
        )
    return [table]
