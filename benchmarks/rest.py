"""python -m benchmarks rest: what a robot's host takes while its arm rests, beside Zenoh alone.

Ours: router, robot (a Python class that is always where it is commanded), command node and two
camera nodes, each a process as `vla-zenoh up` starts it; nobody watches, no model is connected.
Zenoh alone: the same processes, each a loop that puts the same number of bytes on the same keys at
the same rates, as ours told in their statuses, and subscribes to what its namesake reads.
"""

from __future__ import annotations

import json
import os
import tempfile
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Annotated, Any

import cv2
import typer
from rich.table import Table
from vla_zenoh_benchmarks.result_file import ResultOptions, Rows, kept_rows
from vla_zenoh_figures.style import COLUMN_IN, Drawn, look, panels, styled, write

from benchmarks.chain.process import CHECKOUT, Server, free_port
from benchmarks.picture import HEIGHT, WIDTH, noisy_picture
from vla_zenoh.bus.session import open_session
from vla_zenoh.cli.options import options
from vla_zenoh.cli.output import errors
from vla_zenoh.client.client import Client
from vla_zenoh.errors import NodeError
from vla_zenoh.profile import Profile, load_profile, override, to_yaml
from vla_zenoh.runtime.launch import node_commands
from vla_zenoh.runtime.process import ROUTER_PATIENCE_S
from vla_zenoh.runtime.supervisor import Supervisor
from vla_zenoh.types import NodeStatus

OURS, PLAIN = "vla-zenoh", "Zenoh alone"
ROUTER, ROBOT, COMMAND, CAMERAS = "router", "arm", "command", ("camera-here", "camera-there")
NAMES = (ROUTER, COMMAND, ROBOT, *CAMERAS)
READS: Mapping[str, Sequence[str]] = {
    COMMAND: (ROBOT, *CAMERAS),
    ROBOT: (COMMAND,),
    **{camera: () for camera in CAMERAS},
}
"""Node -> nodes of which it reads every key; of all others it reads the status."""
CAMERA_HZ = 30.0
READY_S, SETTLE_S, POLL_S = 60.0, 8.0, 0.2
KINDS = ("svg", "pdf")
HEIGHT_IN = 1.6

Sent = dict[str, tuple[float, int]]
"""Key -> Hz, and bytes of a record."""


@options
def rest(
    output: ResultOptions,
    seconds: Annotated[
        float, typer.Option("--seconds", "-s", min=3, max=600, help="How long each is measured.")
    ] = 60.0,
    rounds: Annotated[
        int, typer.Option("--rounds", "-r", min=1, help="Both in turn, so many times.")
    ] = 1,
    pictures: Annotated[
        Path | None, typer.Option("--pictures", help="Folder for the figure, as SVG and PDF.")
    ] = None,
) -> None:
    """Measure what the nodes of a robot's host take at rest, beside Zenoh with the same traffic."""
    from vla_zenoh.runtime.process import die_with_parent, stop_on_signals

    stop = stop_on_signals()
    die_with_parent()
    with kept_rows(output, _tables) as rows:
        for _ in range(rounds):
            row, sent = measure_ours(seconds, stop, rows)
            rows.append({"way": OURS, "seconds": seconds, **row, "sent": sent})
            rows.append({"way": PLAIN, "seconds": seconds, **measure_plain(sent, seconds, stop)})
            errors().print("a round is measured", style="dim")
    if pictures is not None:
        pictures.mkdir(parents=True, exist_ok=True)
        for kind in KINDS:
            write(draw(rows), pictures / f"rest.{kind}")


def _tables(rows: Rows) -> list[Table]:
    table = Table("way", *NAMES, "all", "user", "system", title="Percent of a core")
    for row in rows:
        shares = row["percent"]
        user, system = (sum(each[i] for each in shares.values()) for i in (0, 1))
        cells = [f"{sum(shares[name]):.1f}" for name in NAMES]
        table.add_row(row["way"], *cells, f"{user + system:.1f}", f"{user:.1f}", f"{system:.1f}")
    return [table]


def bench_profile(folder: Path) -> Profile:
    """The example's robot at an address of its own, with two cameras that show an image."""
    picture = folder / "picture.png"
    cv2.imwrite(str(picture), noisy_picture())
    camera = {"source": f"file:{picture}", "width": WIDTH, "height": HEIGHT, "rate_hz": CAMERA_HZ}
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    changes = {
        "robot": {"name": "resting"},
        "session": {"listen": [endpoint], "connect": [endpoint]},
        "cameras": {"front": camera, "wrist": camera},
        "hosts": {
            "here": {"nodes": [ROUTER, ROBOT, COMMAND, "camera"], "cameras": ["front"]},
            "there": {"nodes": ["camera"], "cameras": ["wrist"]},
        },
        "arm": {"file": str(CHECKOUT / "examples" / "python_robot.py")},
    }
    return override(load_profile(str(CHECKOUT / "examples" / "python_robot.yaml")), changes)


def measure_ours(
    seconds: float, stop: threading.Event, rows: Rows
) -> tuple[dict[str, Any], dict[str, Sent]]:
    """The row of our nodes, and what each of them sent."""
    with ExitStack() as up:
        folder = Path(up.enter_context(tempfile.TemporaryDirectory(prefix="vla-zenoh-rest-")))
        profile = bench_profile(folder)
        file = folder / "robot.yaml"
        file.write_text(to_yaml(profile), "utf-8")
        commands = [each for host in profile.hosts for each in node_commands(profile, host, file)]
        supervisor = Supervisor(commands, log=rows.log, tell=rows.log)
        supervisor.start()
        up.callback(supervisor.kill)
        session = up.enter_context(open_session(profile.session, wait_s=ROUTER_PATIENCE_S))
        client = Client(profile, session).subscribe()
        give_up_s = time.monotonic() + READY_S
        while not all(client.status(name) for name in READS):
            if not supervisor.poll() or time.monotonic() > give_up_s:
                missing = [name for name in READS if not client.status(name)]
                raise NodeError(f"no status of {', '.join(missing)}; their output is above")
            _wait(POLL_S, stop)
        _wait(SETTLE_S, stop)
        pids = supervisor.pids()
        with measured({name: pids[name] for name in NAMES}) as found:
            before = {name: _status(client, name) for name in READS}
            _wait(seconds, stop)
            after = {name: _status(client, name) for name in READS}
        return found, {name: sent(before[name], after[name], seconds) for name in READS}


def measure_plain(
    sent: Mapping[str, Sent], seconds: float, stop: threading.Event
) -> dict[str, Any]:
    """The row of Zenoh alone."""
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    with ExitStack() as up:
        folder = Path(up.enter_context(tempfile.TemporaryDirectory(prefix="vla-zenoh-rest-")))
        servers = {ROUTER: up.enter_context(Server("router", endpoint))}
        for name, keys in sent.items():
            file = folder / f"{name}.json"
            reads = [key for other in READS[name] for key in sent[other]]
            plan = {"endpoint": endpoint, "puts": keys, "reads": [*reads, "status/*"]}
            file.write_text(json.dumps(plan), "utf-8")
            servers[name] = up.enter_context(Server("plain", str(file)))
        _wait(SETTLE_S, stop)
        with measured({name: server.pid for name, server in servers.items()}) as found:
            _wait(seconds, stop)
        for server in servers.values():
            server.check()
        return found


def sent(before: NodeStatus, after: NodeStatus, took_s: float) -> Sent:
    """What a node put between two of its statuses."""
    had = before.detail["net"]["sent"]
    return {
        key: (round((count - had[key][2]) / took_s if key in had else hz, 2), round(bytes_s / hz))
        for key, (hz, bytes_s, count) in after.detail["net"]["sent"].items()
        if hz
    }


def _status(client: Client, name: str) -> NodeStatus:
    status = client.status(name)
    if status is None:
        raise NodeError(f"the node {name} fell silent")
    return status


def _wait(seconds: float, stop: threading.Event) -> None:
    if stop.wait(seconds):
        raise NodeError("interrupted")


@contextmanager
def measured(pids: Mapping[str, int]) -> Iterator[dict[str, Any]]:
    """Fill the row with each process's percent of a core, (user, system), during the context."""
    row: dict[str, Any] = {"host_cores": os.cpu_count()}
    began_s, before = time.monotonic(), {name: _times_s(pid) for name, pid in pids.items()}
    yield row
    took_s = time.monotonic() - began_s
    row["percent"] = {
        name: [
            round(100 * (now - then) / took_s, 2)
            for now, then in zip(_times_s(pid), before[name], strict=True)
        ]
        for name, pid in pids.items()
    }


def _times_s(pid: int) -> tuple[float, float]:
    """User and system time of a process so far."""
    try:
        words = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    except OSError as error:
        raise NodeError(f"process {pid} of the benchmark has ended: {error}") from error
    ticks = os.sysconf("SC_CLK_TCK")
    return int(words[11]) / ticks, int(words[12]) / ticks


@styled
def draw(rows: Sequence[Mapping[str, Any]]) -> Drawn:
    """Percent of a core of each process, ours and plain side by side, mean of the rounds."""
    figure, (axis,) = panels(1, COLUMN_IN, HEIGHT_IN)
    for index, way in enumerate((OURS, PLAIN)):
        own = [row["percent"] for row in rows if row["way"] == way]
        means = [sum(sum(each[name]) for each in own) / len(own) for name in NAMES]
        places = [number + 0.4 * index for number in range(len(NAMES))]
        axis.bar(places, means, 0.36, color=look(index, 2).colour, label=way)
    axis.set_xticks(
        [number + 0.2 for number in range(len(NAMES))], [*NAMES[:3], "camera", "camera"]
    )
    axis.set_ylabel("percent of a core")
    axis.legend()
    caption = "Processor time of the nodes of a robot's host at rest, user and system."
    return Drawn(figure, caption)


def play_plain(file: str, stop: threading.Event) -> None:
    """Put and read what the plan in `file` says, until `stop` is set."""
    import zenoh

    from benchmarks.chain.echo import session_at
    from vla_zenoh.bus.clock import FixedRate
    from vla_zenoh.bus.session import QOS
    from vla_zenoh.keys import Kind

    plan = json.loads(Path(file).read_text("utf-8"))
    with session_at(plan["endpoint"], listen=False) as session:
        outs = {
            key: (hz, bytes(size), session.declare_publisher(key, **QOS[Kind.STATE]))
            for key, (hz, size) in plan["puts"].items()
        }
        handler = zenoh.handlers.Callback(lambda _: None, indirect=False)
        subscribers = [session.declare_subscriber(key, handler) for key in plan["reads"]]
        fastest_hz = max(hz for hz, _, _ in outs.values())
        pace, due = FixedRate(fastest_hz), dict.fromkeys(outs, 0.0)
        while not stop.is_set():
            pace.wait()
            for key, (hz, payload, out) in outs.items():
                due[key] += hz / fastest_hz
                if due[key] >= 1.0:
                    due[key] -= 1.0
                    out.put(payload)
        for subscriber in subscribers:
            subscriber.undeclare()
