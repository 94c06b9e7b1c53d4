"""vla-zenoh bench task: how often a model does tasks in the simulator."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from contextlib import AbstractContextManager, suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any

import typer

from vla_zenoh.cli.options import (
    DEFAULT_PROFILE,
    MAX_INDEX,
    JsonOption,
    ModelOptions,
    effective_profile,
    not_empty,
    options,
)
from vla_zenoh.cli.output import console, new_table
from vla_zenoh.lab.cli.options import SimulatedProfileOption
from vla_zenoh.lab.cli.output import print_json, progress_bars
from vla_zenoh.lab.cli.output_path import ForceOption, if_wanted, output_folder, require_free_folder
from vla_zenoh.lab.cli.running_nodes import running_nodes
from vla_zenoh.lab.tasks.judge import LIMIT_S
from vla_zenoh.lab.tasks.order import FAMILIES, LIFT
from vla_zenoh.lab.tasks.task import BASELINES, SCENE, TaskOutcome, TaskPlan, shown_camera
from vla_zenoh.policy.loader import find_model
from vla_zenoh.profile import Profile, override
from vla_zenoh.resources import is_path
from vla_zenoh_benchmarks.result_file import counts, rate_cells, write_json
from vla_zenoh_benchmarks.task_score import TaskScore, failure_sheet

Latencies = dict[str, tuple[float, float]]
VARIATIONS = ("lights", "table", "camera", "distractors")
UNSEEN_SEED = 1_000_000
"""First seed for measuring; training data has smaller seeds."""


@dataclass(frozen=True)
class EpisodeOptions:
    """Options for the episodes."""

    episodes: Annotated[int, typer.Option("--episodes", "-n", min=1, max=100_000)] = 30
    seed: Annotated[
        int,
        typer.Option(
            "--seed", "-s", min=0, max=MAX_INDEX, help="Of the first layout; the next ones follow."
        ),
    ] = UNSEEN_SEED
    family: Annotated[
        str | None,
        typer.Option(
            "--family",
            help="put, stack, push, stay (nonsense), lift (two arms); default: the first three.",
        ),
    ] = None
    delay_ms: Annotated[
        float, typer.Option("--delay", min=0, max=5000, help="ms added to every inference.")
    ] = 0.0
    rate_hz: Annotated[
        float | None, typer.Option("--rate", min=0.05, max=100, help="Chunks per second.")
    ] = None
    held_out: Annotated[
        bool, typer.Option("--held-out", help="Prompts in words that no model was trained with.")
    ] = False
    prompt: Annotated[
        str | None,
        typer.Option("--prompt", parser=not_empty, help="Prompt in place of the episode's."),
    ] = None
    limit_s: Annotated[
        float, typer.Option("--limit", min=1, max=600, help="Seconds per episode.")
    ] = LIMIT_S

    def plan(self, model: str) -> TaskPlan:
        if self.family not in (None, "stay", LIFT, *FAMILIES):
            raise typer.BadParameter(f"--family is one of {', '.join(FAMILIES)}, stay, {LIFT}")
        return TaskPlan(model, **asdict(self))


@dataclass(frozen=True)
class TaskOutput:
    """Options for where the result goes."""

    output: Annotated[
        Path | None,
        typer.Option(
            "--output", "-o", help="New folder for result.json, nodes.log and failures.jpg."
        ),
    ] = None
    force: ForceOption = False
    as_json: JsonOption = False

    def open(self) -> AbstractContextManager[Path | None]:
        """The folder to fill, if one is wanted; see `output_folder`."""
        return if_wanted(output_folder, self.output, force=self.force)


@options
def task(
    model: Annotated[
        str,
        typer.Option(
            "--model",
            "-m",
            help="A worker of the profile, name of a model, or path to one; or the baselines hold "
            "and scripted.",
        ),
    ],
    episodes: EpisodeOptions,
    model_options: ModelOptions,
    output: TaskOutput,
    vary: Annotated[
        list[str] | None,
        typer.Option("--vary", help="lights, table, camera, distractors or all; repeatable."),
    ] = None,
    lockstep: Annotated[
        bool,
        typer.Option("--lockstep", help="On a virtual clock, faster than real time, no nodes."),
    ] = False,
    processes: Annotated[
        int | None,
        typer.Option(
            "--processes", min=1, max=256, help="Processes with --lockstep; default: one per core."
        ),
    ] = None,
    profile: SimulatedProfileOption = DEFAULT_PROFILE,
) -> None:
    """Measure how often a model does tasks by prompt in the simulator, through the real nodes.

    A task is to put a brick in the box, stack it on another one, or push it. The verdict is by the
    true poses of the objects.
    """
    from vla_zenoh.lab.episode import Interrupted
    from vla_zenoh.plugins import how_to_repeat
    from vla_zenoh.runtime.environments import run_in_own_environment
    from vla_zenoh.runtime.process import stop_on_signals

    varied = _varied(vary or [])
    named, path = _named(model)
    plan = episodes.plan(named)
    loaded = effective_profile(profile)
    scene = loaded.sim.scene if plan.family == LIFT else SCENE
    loaded = _with_bricks(loaded, plan.worker, varied, path, scene)
    chosen = model_options.choose(loaded, plan.worker)
    if output.output is not None:  # before an environment is made, which may take minutes
        require_free_folder(output.output, force=output.force)
    if lockstep:  # this process makes the model; returns only where that can be done
        ours = how_to_repeat("vla-zenoh-benchmarks")
        run_in_own_environment(chosen.model, model_options.python, extra="sim", packages=ours)
    stop = stop_on_signals()
    mode = "lockstep" if lockstep else "real_time"
    score = TaskScore(plan, mode, loaded.name, varied, options=chosen.options)
    camera = shown_camera(loaded.cameras)

    def outcomes(folder: Path | None) -> Iterator[tuple[TaskOutcome, Latencies]]:
        if not lockstep:
            return _real_time(loaded, plan, model_options, folder, stop, camera)
        from vla_zenoh_benchmarks.task_lockstep import run_in_lockstep

        return run_in_lockstep(loaded, plan, chosen.options, camera, stop, processes, named=profile)

    began_s = time.monotonic()
    with output.open() as folder:
        try:
            with progress_bars(44) as bars, suppress(Interrupted):
                bar = bars.add_task("starting", total=plan.episodes)
                for ended, latency_ms in outcomes(folder):
                    score.ended.append(ended)
                    score.latency_ms = latency_ms
                    done = sum(each.success for each in score.ended)
                    outcome = "done" if ended.success else ended.failure
                    said = f"{done} of {len(score.ended)} done; the last: {outcome}"
                    bars.update(bar, completed=len(score.ended), description=said)
        finally:
            score.wall_s = time.monotonic() - began_s
            if score.ended:  # printed first: what cannot be written is not lost
                print_json(score.to_dict()) if output.as_json else _print(score.to_dict())
                if folder is not None:
                    write_json(folder / "result.json", score.to_dict())
                    if sheet := failure_sheet(score.ended):
                        (folder / "failures.jpg").write_bytes(sheet)
    if stop.is_set():
        raise typer.Exit(130)


def _varied(names: list[str]) -> list[str]:
    if "all" in names:
        return list(VARIATIONS)
    unknown = [name for name in names if name not in VARIATIONS]
    if unknown:
        raise typer.BadParameter(f"--vary {unknown[0]!r}: {', '.join(VARIATIONS)}, all")
    return [name for name in VARIATIONS if name in names]


def _named(model: str) -> tuple[str, str]:
    """Name of a model, and its path if that was given."""
    if not is_path(model):
        return model, ""
    found = find_model(model)
    if found.name in BASELINES:
        raise typer.BadParameter(
            f"--model {model}: {found.name} is the name of a baseline; rename the file"
        )
    return found.name, str(found.path)


def _with_bricks(
    profile: Profile, worker: str, vary: list[str], path: str = "", scene: str = SCENE
) -> Profile:
    """The profile with the scene of the tasks and the worker, whose file is `path` if not empty."""
    workers = [*dict.fromkeys([worker, *profile.workers])]
    return override(
        profile,
        {
            "sim": {"scene": scene, "vary": vary},
            "workers": workers,
            "models": {worker: path} if path else {},
            "task": {"worker": worker, "prompt": "hold"},
            "hosts": {
                name: host.model_dump(mode="json", exclude_none=True) | {"workers": [worker]}
                for name, host in profile.hosts.items()
                if "worker" in host.nodes
            },
        },
    )


def _real_time(
    profile: Profile,
    plan: TaskPlan,
    model: ModelOptions,
    out: Path | None,
    stop: threading.Event,
    camera: str | None,
) -> Iterator[tuple[TaskOutcome, Latencies]]:
    from vla_zenoh.lab.cli.loopback import own_address
    from vla_zenoh.lab.tasks.task_runner import TaskRunner
    from vla_zenoh.runtime.process import die_with_parent

    die_with_parent()
    arguments = ["--delay", f"{plan.delay_ms:g}"] if plan.delay_ms else []
    arguments += ["--python", model.python] if model.python else []
    nodes = running_nodes(
        own_address(profile),
        None if out is None else out / "nodes.log",
        worker_options={plan.worker: model.settings or []},
        worker_arguments=arguments,
    )
    with nodes as running:
        run = TaskRunner(running, plan, stop, camera)
        for ended in run.run():
            yield ended, run.latency_ms()


def _print(result: dict[str, Any]) -> None:
    columns = ("", "done", "of", "rate", "95 %", "time p50", "p95", "failures")
    table = new_table(*columns, title=_title(result), left=("", "failures"))
    for name, row in [("all", result), *result["by_family"].items()]:
        times = row["time_to_success_s"]
        table.add_row(
            name,
            *rate_cells(row),
            f"{times['p50']:.1f} s" if times else "",
            f"{times['p95']:.1f} s" if times else "",
            counts(row["failures"]),
        )
    out = console()
    out.print(table)
    for stage, (p50, p95) in result["latency_ms"].items():
        out.print(f"{stage}: p50 {p50:.1f} ms, p95 {p95:.1f} ms", style="dim")
    whys = dict.fromkeys(each["why"] for each in result["all"] if each.get("why"))
    for why in list(whys)[:3]:
        out.print(f"- {why}")


def _title(result: dict[str, Any]) -> str:
    parts = [f"{result['model']}, {result['mode'].replace('_', ' ')}, seeds from {result['seed']}"]
    parts += [f"{result['delay_ms']:g} ms added"] if result["delay_ms"] else []
    parts += [f"{result['rate_hz']:g} Hz"] if result["rate_hz"] else []
    parts += ["held-out words"] if result["held_out"] else []
    parts += [f"varied: {', '.join(result['vary'])}"] if result["vary"] else []
    return "; ".join(parts)
