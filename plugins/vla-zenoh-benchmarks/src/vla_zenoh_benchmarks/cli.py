"""vla-zenoh bench sim: success rates on manipulation benchmarks of others."""

from __future__ import annotations

import tempfile
import threading
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from rich.progress import TimeRemainingColumn

from vla_zenoh import __version__
from vla_zenoh.cli.options import (
    MAX_INDEX,
    JsonOption,
    ModelOptions,
    endpoint,
    model_options,
    options,
)
from vla_zenoh.cli.output import console, errors, new_table
from vla_zenoh.errors import ResourceError, nearest
from vla_zenoh.lab.cli.output import print_json, progress_bars
from vla_zenoh.lab.cli.output_path import check_folder
from vla_zenoh.lab.tasks.task import shown_camera
from vla_zenoh.policy.loader import find_worker
from vla_zenoh_benchmarks.contract import BenchmarkTask
from vla_zenoh_benchmarks.episode import (
    DISAGREEMENT,
    Composition,
    EpisodeConditions,
    EpisodeOutcome,
    EpisodeRequest,
    Mode,
)
from vla_zenoh_benchmarks.journal import PLAN, RunJournal, actions_file, read_episodes, read_json
from vla_zenoh_benchmarks.process import BenchmarkProcess, BenchmarkSetting
from vla_zenoh_benchmarks.result import summary, write_page, write_videos
from vla_zenoh_benchmarks.result_file import counts, rate_cells, write_json
from vla_zenoh_benchmarks.run import BenchmarkStage, Does, LocalRun, run_at_places

REPLAY, RECORDINGS = "replay", "recordings"


@dataclass(frozen=True)
class BenchmarkEpisodes:
    """Options for what is run."""

    suite: Annotated[
        str | None, typer.Option("--suite", help="Of the benchmark; default: its first.")
    ] = None
    tasks: Annotated[
        str | None, typer.Option("--tasks", help="Numbers and names: 0-9,door-open-v3.")
    ] = None
    episodes: Annotated[
        int, typer.Option("--episodes", "-n", min=1, max=100_000, help="Of every task.")
    ] = 10
    first: Annotated[
        int,
        typer.Option(
            "--first", min=0, max=MAX_INDEX, help="Index of the first initial state, or seed."
        ),
    ] = 0
    mode: Annotated[
        Mode,
        typer.Option(
            "--mode",
            help="native: the environment waits for the model. live: its clock runs on, the arm "
            "stands meanwhile. command: it runs on, through our command node.",
        ),
    ] = "native"
    delay_ms: Annotated[
        float | None,
        typer.Option(
            "--delay",
            min=0,
            max=10_000,
            help="Virtual ms of an inference in live and command; default: what it took.",
        ),
    ] = None
    replan: Annotated[
        int,
        typer.Option(
            "--replan", min=0, max=100_000, help="Steps to carry out of each chunk; 0: all."
        ),
    ] = 0

    composition: Annotated[
        Composition,
        typer.Option("--composition", help="Of chunks that overlap, in mode command."),
    ] = "replace"
    takeover: Annotated[
        str,
        typer.Option(
            "--takeover",
            metavar="WORKER",
            help="A model that watches, and leads to the end of an episode from where it "
            "disagrees; recorded, that is an intervention.",
        ),
    ] = ""
    disagreement: Annotated[
        float | None,
        typer.Option(
            "--disagreement",
            min=0.0,
            max=10.0,
            help="With --takeover: difference of both motions within 0.25 s that is too large, as "
            f"a share of the watching model's.  [default: {DISAGREEMENT:g}]",
        ),
    ] = None

    @property
    def conditions(self) -> EpisodeConditions:
        if self.mode == "native" and self.delay_ms:
            raise typer.BadParameter("--delay: in native mode no time passes; add --mode live")
        if self.mode != "command" and self.composition != "replace":
            raise typer.BadParameter(
                "--composition: only our command node has it; add --mode command"
            )
        if self.mode != "native" and self.takeover:
            raise typer.BadParameter(
                "--takeover: only where the environment waits; leave out --mode"
            )
        if self.disagreement is not None and not self.takeover:
            raise typer.BadParameter("--disagreement: with whom? add --takeover WORKER")
        share = DISAGREEMENT if self.disagreement is None else self.disagreement
        own = (self.mode, self.delay_ms, self.replan, self.composition)
        return EpisodeConditions(*own, disagreement=share)

    def requests(self, about: dict[str, Any]) -> list[EpisodeRequest]:
        known = [BenchmarkTask(**task) for task in about["tasks"]]
        chosen = known if self.tasks is None else _chosen(self.tasks, known)
        last = self.first + self.episodes
        for task in chosen:
            if task.episodes and last > task.episodes:
                raise typer.BadParameter(
                    f"--episodes: {task.name} has {task.episodes} initial states"
                )
        return [
            EpisodeRequest(about["suite"], task, index)
            for task in chosen
            for index in range(self.first, last)
        ]


def ray_address(text: str) -> str:
    """Parse the address of a Ray cluster, as ``ray start`` tells it, or raise a `ValueError`."""
    if text == "auto":
        return text
    try:
        endpoint(f"tcp/{text.removeprefix('ray://')}")
    except ValueError as error:
        raise ValueError(
            f"{text!r} is no address of a Ray cluster: write HOST:PORT, as 10.0.0.2:6379, "
            "ray://HOST:PORT or auto"
        ) from error
    return text


@dataclass(frozen=True)
class BenchmarkPlace:
    """Options for where it runs."""

    processes: Annotated[
        int, typer.Option("--processes", min=1, max=256, help="Environments at once, one worker.")
    ] = 1
    ray: Annotated[
        str | None,
        typer.Option(
            "--ray",
            parser=ray_address,
            help="Address of a Ray cluster that runs them, each with a worker.",
        ),
    ] = None
    connect: Annotated[
        str | None,
        typer.Option(
            "--connect",
            parser=endpoint,
            help="Router of a worker that runs already, serving robots sim0, sim1, ...",
        ),
    ] = None
    benchmark_python: Annotated[
        str | None,
        typer.Option("--benchmark-python", help="Interpreter of the benchmark's environment."),
    ] = None


@dataclass(frozen=True)
class BenchmarkOutput:
    """Options for where the result goes."""

    output: Annotated[
        Path | None,
        typer.Option(
            "--output",
            "-o",
            help="Folder for result.json, index.html, steps and videos; a run that was ended goes "
            "on there.",
        ),
    ] = None
    videos: Annotated[
        int,
        typer.Option("--videos", min=0, max=100_000, help="Of failures, at most, with --output."),
    ] = 5
    record: Annotated[
        list[str] | None,
        typer.Option(
            "--record",
            help="Record every episode as MCAP into OUTPUT/recordings, with this camera; "
            "repeatable. Not with --ray.",
        ),
    ] = None
    as_json: JsonOption = False

    def recorded(self, place: BenchmarkPlace, known: Iterable[str]) -> tuple[str, ...]:
        """The cameras to record."""
        cameras = tuple(dict.fromkeys(self.record or ()))
        if cameras and (self.output is None or place.ray is not None):
            raise typer.BadParameter("--record needs --output, and is not for --ray")
        for camera in cameras:
            if camera not in known:
                meant = nearest(camera, known, "")
                raise typer.BadParameter(
                    f"--record: the benchmark has no camera {camera!r}{meant}; "
                    f"it has: {', '.join(known)}"
                )
        return cameras


@options
def sim(
    benchmark: Annotated[str, typer.Argument(help="Name of a benchmark, or path to its file.")],
    episodes: BenchmarkEpisodes,
    place: BenchmarkPlace,
    model: ModelOptions,
    output: BenchmarkOutput,
    worker: Annotated[
        str | None, typer.Option("--worker", "-w", help="Name of a model, or path to one.")
    ] = None,
    benchmark_settings: Annotated[
        list[str] | None,
        typer.Option("--benchmark-set", help="Option of the benchmark as name=value; repeatable."),
    ] = None,
    replay: Annotated[
        Path | None,
        typer.Option("--replay", help="Folder of a run whose steps are executed again."),
    ] = None,
    list_tasks: Annotated[
        bool, typer.Option("--list", help="Print suites, tasks of --suite, cameras and action.")
    ] = False,
) -> None:
    """Measure how often a model succeeds on a manipulation benchmark, by the published protocol.

    The environment is a robot behind the usual keys, in an environment of its own; the worker is
    any worker. Without --worker it needs --replay or --list.
    """
    from vla_zenoh.runtime.process import stop_on_signals

    chosen = None if worker is None or place.connect else model.choose(None, worker)
    name = REPLAY if replay else chosen.name if chosen else worker or ""
    if not name and not list_tasks:
        raise typer.BadParameter("give --worker NAME, --replay DIR or --list")
    conditions, teacher = episodes.conditions, _teacher(episodes.takeover, name, place, replay)
    setting = BenchmarkSetting(
        benchmark,
        model_options(benchmark_settings or []),
        worker="" if replay or list_tasks else name,
        conditions=replace(conditions, takeover=teacher[0]),
    )
    if output.output is not None:
        check_folder(output.output, begun=(output.output / PLAN).exists())
    stage = BenchmarkStage(
        setting,
        tuple(model.settings or ()),
        str(chosen.model.path) if chosen else "",
        teacher[1],
        model.python,
        place.benchmark_python,
        place.connect or "",
    )
    teller = BenchmarkProcess(setting, "", place.benchmark_python)
    try:
        about = teller.describe(episodes.suite)
        if list_tasks:
            print_json(about)
            return
        cameras = output.recorded(place, about["cameras"])
        requests = episodes.requests(about)
        plan = {
            "benchmark": setting.file.name,
            "benchmark_options": dict(setting.options),
            "suite": requests[0].suite,
            "worker": name,
            "model": name,
            "options": dict(chosen.options) if chosen else {},
            **asdict(setting.conditions),
            "record": list(cameras),
            "tasks": list(dict.fromkeys(each.task.name for each in requests)),
            "first": episodes.first,
            "episodes": episodes.episodes,
            "max_steps": {each.task.name: each.task.max_steps for each in requests},
            "dt_s": about["dt_s"],
            "versions": {"vla-zenoh": __version__, **about["versions"]},
        }
        journal = RunJournal(output.output, plan)
        stage = replace(stage, max_width_m=about["max_width_m"])
        if cameras and output.output is not None:
            folder = output.output / RECORDINGS
            folder.mkdir(exist_ok=True)
            recorded = replace(setting, record=cameras, recordings=str(folder.resolve()))
            stage = replace(stage, setting=recorded)
        stop = stop_on_signals()
        try:
            left = [each for each in requests if each.key not in journal.ended]
            if left:
                found = _outcomes(stage, place, replay, left, journal, stop)
                _run(found, journal, len(requests))
        finally:
            result = _result(requests, journal, replay)
            if result["all"]:
                print_json(result) if output.as_json else _print(result)
            if output.output is not None and result["all"]:
                write_json(output.output / "result.json", result)
                write_page(output.output, result)
        if stop.is_set():
            raise typer.Exit(130)
        if output.output is not None and replay is None and about["cameras"]:
            ended = [(each, journal.ended.get(each.key)) for each in requests]
            failed = [each for each, end in ended if end is not None and not end.success]
            camera = shown_camera(about["cameras"]) or ""
            for file in write_videos(output.output, teller, failed, camera, output.videos):
                errors().print(f"{file}", soft_wrap=True)
            write_page(output.output, result)
    finally:
        teller.close()


def _teacher(word: str, worker: str, place: BenchmarkPlace, replay: Path | None) -> tuple[str, str]:
    """Name and file of the model that takes over; empty: none does."""
    if not word:
        return "", ""
    if replay is not None or place.connect or place.ray is not None:
        raise typer.BadParameter("--takeover: not with --replay, --connect or --ray")
    name, model = find_worker(word, {})
    if name == worker:
        raise typer.BadParameter(f"--takeover: {name} leads already; name another model")
    return name, str(model.path)


def _run(
    outcomes: Iterable[tuple[EpisodeRequest, EpisodeOutcome]], journal: RunJournal, total: int
) -> None:
    with progress_bars(44) as bars:
        bars.columns = (*bars.columns, TimeRemainingColumn())
        bar = bars.add_task("starting", total=total, completed=len(journal.ended))
        for request, outcome in outcomes:
            journal.add(request, outcome)
            done = sum(each.success for each in journal.ended.values())
            word = "done" if outcome.success else outcome.failure
            bars.update(
                bar,
                completed=len(journal.ended),
                description=f"{done} of {len(journal.ended)} done; {request.task.name[:18]} {word}",
            )


def _outcomes(
    stage: BenchmarkStage,
    place: BenchmarkPlace,
    replay: Path | None,
    left: Sequence[EpisodeRequest],
    journal: RunJournal,
    stop: threading.Event,
) -> Iterator[tuple[EpisodeRequest, EpisodeOutcome]]:
    if place.ray is not None:
        from vla_zenoh_benchmarks.run import RayPlace, connect_ray

        if replay is not None or place.connect:
            raise typer.BadParameter("--ray: not with --replay or --connect")
        ray = connect_ray(place.ray)
        yield from run_at_places([lambda: RayPlace(stage, ray)] * place.processes, left, stop)
        return
    log = journal.folder / "nodes.log" if journal.folder is not None else None
    with LocalRun(stage, place.processes, log) as run:
        if replay is None:
            yield from run.run(left, stop)
            return
        folder = replay
        makers = [lambda i=i: _Replay(run.place(i), folder) for i in range(place.processes)]
        yield from run_at_places(makers, left, stop)


class _Replay(Does):
    """Carries out recorded steps in place of asking a model."""

    def __init__(self, place: BenchmarkProcess, folder: Path) -> None:
        self._place, self._folder = place, folder

    def run(self, request: EpisodeRequest) -> EpisodeOutcome:
        file = actions_file(self._folder, request)
        if not file.exists():
            raise ResourceError(f"{self._folder} has no steps of {request.key}")
        with tempfile.TemporaryDirectory(prefix="vla-zenoh-") as folder:
            return self._place.replay(request, np.load(file), "", Path(folder))

    def close(self) -> None:
        self._place.close()


def _result(
    requests: Sequence[EpisodeRequest], journal: RunJournal, replay: Path | None
) -> dict[str, Any]:
    ended = [journal.ended[each.key] for each in requests if each.key in journal.ended]
    result = summary(journal.plan, ended)
    if replay is not None:
        before = read_episodes(replay)
        pairs = [(before.get(f"{e.suite}/{e.task}/{e.episode}"), e) for e in ended]
        result["same_end"] = sum(bool(a and a.end and a.end == b.end) for a, b in pairs)
        result["replayed"] = read_json(replay / PLAN)["worker"]
    return result


def _chosen(text: str, known: Sequence[BenchmarkTask]) -> list[BenchmarkTask]:
    names = {task.name: task for task in known}
    out: dict[str, BenchmarkTask] = {}
    for part in text.split(","):
        low, dash, high = part.strip().partition("-")
        if part.strip() in names:
            found = [names[part.strip()]]
        elif low.isdigit() and (high.isdigit() or not dash):
            found = list(known[int(low) : int(high or low) + 1])
        else:
            found = []
        if not found:
            raise typer.BadParameter(
                f"--tasks {part!r}: 0 to {len(known) - 1}, or a name; --list prints them"
            )
        out |= {task.name: task for task in found}
    return list(out.values())


def _print(result: dict[str, Any]) -> None:
    title = f"{result['benchmark']} {result['suite']}, {result['worker']}, {result['mode']}"
    title += f", {result['delay_ms']:g} ms" if result["delay_ms"] else ""
    columns = ("", "done", "of", "rate", "95 %", "steps p50", "failures")
    table = new_table(*columns, title=title, left=("", "failures"))
    for name, row in [("all", result), *result["by_task"].items()]:
        steps = row["steps_to_success_p50"]
        median = f"{steps:g}" if steps is not None else ""
        table.add_row(name, *rate_cells(row), median, counts(row["failures"]))
    console().print(table)
    if result["begun_again"]:
        console().print(f"{result['begun_again']} episodes were begun again")
    if "same_end" in result:
        same, of = result["same_end"], len(result["all"])
        console().print(f"{same} of {of} ended in the same state, bit by bit, as when recorded")
