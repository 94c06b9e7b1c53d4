"""vla-zenoh canary: a new model beside the obeyed one on several robots, promoted or taken back."""

from __future__ import annotations

import signal
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import typer

from vla_zenoh.cli.options import MAX_SECONDS, JsonOption, node_name, options
from vla_zenoh.cli.output import console, errors, fail, new_table
from vla_zenoh.cli.target import RobotTarget
from vla_zenoh.client.client import Client
from vla_zenoh.errors import NodeError, RecordError, nearest
from vla_zenoh.keys import worker_node
from vla_zenoh.lab.cli.output import print_json, progress
from vla_zenoh.lab.cli.output_path import ForceOption, output_file
from vla_zenoh.profile import as_robot
from vla_zenoh_canary.figures import RobotFigures, Spread
from vla_zenoh_canary.judge import Demands, Refusal, refusals
from vla_zenoh_canary.record import CanaryRecord, Promoted, read_record, write_record
from vla_zenoh_canary.switch import (
    TASK_PATIENCE_S,
    Switched,
    present,
    since_promotion,
    switch_all,
    take_back,
)
from vla_zenoh_canary.watch import watch_robots

REFUSED = 3
"""Exit status; 1 and 2 are those of every command for errors."""
RobotsOption = Annotated[
    str | None,
    typer.Option(
        "--robots",
        "-r",
        help="Names, separated by commas, of robots of the profile's kind on this router. Default: "
        "of `watch` those that the profile says the worker serves, else all of the file.",
    ),
]
FileArgument = Annotated[Path, typer.Argument(help="File of `canary watch`.")]


@dataclass(frozen=True)
class DemandOptions:
    """What the figures must show."""

    min_seconds: Annotated[
        float, typer.Option("--min-seconds", min=0, max=MAX_SECONDS, help="Watched, each robot.")
    ] = 30.0
    min_pairs: Annotated[
        int, typer.Option("--min-pairs", min=1, max=10**9, help="Pairs of chunks, each robot.")
    ] = 50
    max_rejected: Annotated[
        float,
        typer.Option(
            "--max-rejected", min=0, max=100, help="Percent of its answers that are unusable."
        ),
    ] = 1.0
    max_apart_mm: Annotated[
        float | None,
        typer.Option(
            "--max-apart-mm", min=0, max=1e4, help="p95 of how far chunks end apart. Default: any."
        ),
    ] = None
    max_apart_mrad: Annotated[
        float | None,
        typer.Option(
            "--max-apart-mrad", min=0, max=3200, help="The same, of orientations. Default: any."
        ),
    ] = None
    max_age_ms: Annotated[
        float | None,
        typer.Option(
            "--max-age-ms", min=0, max=1e6, help="p95 of the age of its chunks. Default: any."
        ),
    ] = None

    def demands(self) -> Demands:
        return Demands(
            self.min_seconds,
            self.min_pairs,
            self.max_rejected,
            self.max_apart_mm,
            self.max_apart_mrad,
            self.max_age_ms,
        )


@options
def watch(
    target: RobotTarget,
    worker: Annotated[str, typer.Argument(parser=node_name, help="The new worker, in shadow.")],
    output: Annotated[Path, typer.Option("--output", "-o", help="File for the figures.")],
    robots: RobotsOption = None,
    against: Annotated[
        str | None,
        typer.Option(
            "--against",
            parser=node_name,
            help="The worker to compare it with. Default: the obeyed one of each robot.",
        ),
    ] = None,
    seconds: Annotated[
        float,
        typer.Option("--seconds", "-s", min=1.0, max=MAX_SECONDS, help="How long; Ctrl-C ends it."),
    ] = 60.0,
    force: ForceOption = False,
    as_json: JsonOption = False,
) -> None:
    """Watch a worker in shadow beside the obeyed one, on one or several robots; nothing moves.

    How far their chunks end apart, latency, age and rejected chunks go into a file, with their
    number and time: `canary promote FILE` decides by it.
    """
    with output_file(output, force=force) as file, target.client() as client:
        names = _names(robots) or client.profile.serves.get(worker, (client.keys.robot,))
        clients = _clients(client, names)
        others = {name: _other(each, worker, against) for name, each in clients.items()}
        stop = threading.Event()
        signal.signal(signal.SIGINT, lambda *_: stop.set())
        with progress(f"watching {', '.join(names)} for {seconds:g} s"):
            figures = watch_robots(clients, worker, others, seconds, stop.is_set)
        record = CanaryRecord(worker, time.time_ns(), figures)
        write_record(file, record)
    if as_json:
        print_json(asdict(record))
    else:
        _print_figures(figures)


@options
def promote(
    target: RobotTarget,
    file: FileArgument,
    demands: DemandOptions,
    robots: RobotsOption = None,
    as_json: JsonOption = False,
) -> None:
    """Let the watched worker move the robots of a file, if its figures allow it.

    All robots are looked at before the first one changes; with a reason against one of them none
    does, and the exit status is 3. An active arm keeps moving: its command node checks the other
    worker, and the present plan goes on until a chunk of that worker takes its place. Where an arm
    does not follow it, all of them obey their worker from before.
    """
    record = read_record(file)
    names = _names(robots) or tuple(record.robots)
    with target.operator("canary", "promote", str(file)) as client:
        clients = _clients(client, names)
        against: list[Refusal] = []
        for name, each in clients.items():
            found = record.robots.get(name)
            workers = () if found is None else (record.new, found.other.worker)
            asked = present(each, workers)
            against += refusals(name, found, asked, demands.demands())
        shown = {name: record.robots[name] for name in names if name in record.robots}
        if not as_json:
            _print_figures(shown)
        if against:
            _refuse(against, as_json=as_json)

        def keep(promoted: Mapping[str, Promoted]) -> None:
            write_record(file, replace(record, promoted={**record.promoted, **promoted}))

        switched = switch_all(clients, record, keep)
    _report(switched, {"robots": {name: asdict(each) for name, each in shown.items()}}, as_json)


@options
def back(
    target: RobotTarget,
    file: FileArgument,
    robots: RobotsOption = None,
    as_json: JsonOption = False,
) -> None:
    """Let the worker from before a promotion move the robots again; then say what happened since.

    Nothing is measured first. An active arm keeps moving, as in a promotion; where its command node
    rejects the worker, the arm is left as it is and the exit status is 1.
    """
    record = read_record(file)
    wanted = _names(robots) or tuple(record.promoted)
    unknown = [name for name in wanted if name not in record.promoted]
    if unknown or not wanted:
        which = f"robot {unknown[0]!r}" if unknown else "no robot"
        known = ", ".join(record.promoted) or "none"
        raise RecordError(f"not_promoted: {which} is promoted in {file}; promoted: {known}")
    with target.operator("canary", "back", str(file)) as client:
        clients = _clients(client, wanted)
        switched = list(take_back(clients, record))
        done = {each.robot for each in switched if not each.why}
        left = {name: each for name, each in record.promoted.items() if name not in done}
        since = {name: since_promotion(each, record, name) for name, each in clients.items()}
        write_record(file, replace(record, promoted=left))
    if not as_json:
        _print_figures({name: record.robots[name] for name in wanted})
        for name, found in since.items():
            _print_since(name, found)
    _report(switched, {"since": since}, as_json)


# -- robots ---------------------------------------------------------------------------------------
def _names(text: str | None) -> tuple[str, ...]:
    return () if text is None else tuple(dict.fromkeys(map(node_name, text.split(","))))


def _clients(client: Client, names: Sequence[str]) -> dict[str, Client]:
    """A client of each robot, once its command node has said its task."""
    out: dict[str, Client] = {}
    for name in names:
        own = client
        if name != client.keys.robot:
            profile = as_robot(client.profile, name)
            own = Client(profile, client.session, patience_s=client.patience_s).subscribe()
        out[name] = own
    for name, each in out.items():
        if each.wait_for(lambda each=each: each.task, TASK_PATIENCE_S) is None:
            raise NodeError(f"no command node of robot {name!r} says its task; see `status`")
    return out


def _other(client: Client, worker: str, against: str | None) -> str:
    """The worker to compare with; both must be alive."""
    assert client.task is not None
    robot, other = client.keys.robot, against or client.task.worker
    if other == worker:
        raise NodeError(
            f"robot {robot} obeys {worker!r}, so it is in no shadow; name another worker with "
            "--against"
        )
    for name in (worker, other):
        if not client.await_start(worker_node(name)):
            prefix = worker_node("")
            alive = [node[len(prefix) :] for node in client.alive if node.startswith(prefix)]
            raise NodeError(
                f"worker {name!r} of robot {robot} is not alive{nearest(name, alive)} Alive are: "
                f"{', '.join(sorted(alive)) or 'none'}; start it with `vla-zenoh worker`"
            )
    return other


# -- output ---------------------------------------------------------------------------------------
def _print_figures(robots: dict[str, RobotFigures]) -> None:
    columns = ("robot", "worker", "chunks", "Hz", "inference ms", "age ms", "unusable", "silent s")
    table = new_table(*columns, left=("robot", "worker"))
    for name, found in robots.items():
        for each in (found.new, found.other):
            table.add_row(
                name,
                each.worker,
                str(each.chunks),
                f"{each.rate_hz:.1f}",
                _spread(each.inference_ms),
                _spread(each.age_ms),
                f"{each.rejected_percent:.1f} %",
                f"{each.longest_silence_s:.1f}",
            )
    out = console()
    out.print(table)
    for name, found in robots.items():
        apart = found.apart
        text = (
            f"{name}: {apart.pairs} pairs in {found.seconds:.0f} s ({found.active_s:.0f} s active) "
            f"end {_spread(apart.distance_mm)} mm, {_spread(apart.angle_mrad)} mrad apart, "
            f"{apart.after_s:g} s ahead"
        )
        if apart.gripper_percent is not None:
            text += f"; the gripper differs in {apart.gripper_percent:g} %"
        out.print(text, soft_wrap=True)
    out.print("All spreads are p50 / p95.")


def _spread(found: Spread | None) -> str:
    return "-" if found is None else f"{found[0]:.1f} / {found[1]:.1f}"


def _print_since(robot: str, found: dict[str, Any]) -> None:
    rejected = found["rejected"]
    counts = ", ".join(f"{name} {count}" for name, count in (rejected or {}).items())
    said = "its command node was restarted" if rejected is None else counts or "nothing rejected"
    latencies = ", ".join(
        f"{worker} {_spread(spread)} ms" for worker, spread in found["inference_ms"].items()
    )
    console().print(
        f"{robot}, {found['seconds']:.0f} s since the promotion: {said}; inference {latencies}; "
        f"{found['state']}: {found['why']}",
        soft_wrap=True,
    )


def _refuse(against: Sequence[Refusal], *, as_json: bool) -> None:
    if as_json:
        print_json({"ok": False, "refused": [each._asdict() for each in against]})
    else:
        out = errors()
        out.print("not promoted:", style="bold red")
        for robot, name, why in against:
            out.print(f"  - {robot}: {name}: {why}", soft_wrap=True)
    raise typer.Exit(REFUSED)


def _report(switched: Sequence[Switched], more: dict[str, Any], as_json: bool) -> None:
    failed = [each for each in switched if each.why]
    if as_json:
        rows = [each._asdict() for each in switched]
        print_json({"ok": not failed, "switched": rows, **more})
        if failed:
            raise typer.Exit(1)
        return
    for line in _lines(switched):
        console().print(line, soft_wrap=True)
    if failed:
        fail("; ".join(f"{each.robot}: {each.why}" for each in failed))


def _lines(switched: Sequence[Switched]) -> Iterator[str]:
    for each in switched:
        if each.why:
            yield f"{each.robot}: not {each.worker}"
        elif each.after_s is None:
            yield f"{each.robot}: {each.before} -> {each.worker}"
        else:
            text = f"in motion, a chunk of it in force after {each.after_s:.2f} s"
            yield f"{each.robot}: {each.before} -> {each.worker}, {text}"
