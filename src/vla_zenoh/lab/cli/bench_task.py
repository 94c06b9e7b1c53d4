"""vla-zenoh bench task."""

from __future__ import annotations

import os
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table

from vla_zenoh.cli.options import DEFAULT_PROFILE, effective_profile
from vla_zenoh.cli.output import console, errors
from vla_zenoh.cli.worker_choice import chosen_worker
from vla_zenoh.lab.bench.task import BASELINES, SCENE, TaskPlan, TaskScore
from vla_zenoh.lab.cli.bench_file import (
    LAST_LINES,
    JsonFileOption,
    up_with_last_lines,
    write_json,
)
from vla_zenoh.lab.tasks import FAMILIES, LIMIT_S
from vla_zenoh.policy.loader import find_model
from vla_zenoh.profile import Profile, override
from vla_zenoh.resources import is_path

VARIATIONS = ("lights", "table", "camera", "distractors")
UNSEEN_SEED = 1_000_000
"""Layouts from here on are for measuring; data for training are made from smaller seeds."""


def task(
    model: Annotated[
        str,
        typer.Option(
            "--model",
            "-m",
            help="A worker of the profile, name of a model, or path to one; or hold, scripted: "
            "what gives nothing.",
        ),
    ],
    episodes: Annotated[int, typer.Option("--episodes", "-n", min=1, max=100_000)] = 30,
    seed: Annotated[
        int, typer.Option("--seed", "-s", min=0, help="Of the first layout; the next ones follow.")
    ] = UNSEEN_SEED,
    family: Annotated[
        str | None,
        typer.Option("--family", help="put, stack, push, or stay (nonsense); all three else."),
    ] = None,
    delay_ms: Annotated[
        float, typer.Option("--delay", min=0, max=5000, help="ms added to every inference.")
    ] = 0.0,
    rate_hz: Annotated[
        float | None, typer.Option("--rate", min=0.05, max=100, help="Chunks asked per second.")
    ] = None,
    held_out: Annotated[
        bool, typer.Option("--held-out", help="Prompts in words that no model was trained with.")
    ] = False,
    pairs: Annotated[
        bool, typer.Option("--pairs", help="Every layout twice, with another brick to fetch.")
    ] = False,
    camera_jitter: Annotated[
        bool, typer.Option("--camera-jitter", help="Same as --vary camera.")
    ] = False,
    vary: Annotated[
        list[str] | None,
        typer.Option("--vary", help="lights, table, camera or distractors; may be repeated; all."),
    ] = None,
    prompt: Annotated[
        str | None, typer.Option("--prompt", help="Put this in place of the episode's prompt.")
    ] = None,
    limit_s: Annotated[
        float | None, typer.Option("--limit", min=1, max=600, help="Seconds for an episode.")
    ] = None,
    lockstep: Annotated[
        bool,
        typer.Option("--lockstep", help="On a virtual clock, faster than real time, no nodes."),
    ] = False,
    processes: Annotated[
        int | None, typer.Option("--processes", min=1, help="With --lockstep; one a core else.")
    ] = None,
    options: Annotated[
        list[str] | None,
        typer.Option("--set", help="Option of the model as name=value; may be repeated."),
    ] = None,
    python: Annotated[
        str | None, typer.Option("--python", help="Interpreter of a prepared environment.")
    ] = None,
    profile: Annotated[
        str, typer.Option("--profile", "-p", help="Name or path of a simulated robot's profile.")
    ] = DEFAULT_PROFILE,
    json_file: JsonFileOption = None,
    out: Annotated[
        Path | None,
        typer.Option("--out", help="Folder for result.json, nodes.log and failures.jpg."),
    ] = None,
) -> None:
    """Let a model do tasks by prompt in the simulator, through the real chain, and judge it.

    The judge looks at the true poses of the objects. Tasks come from the scene's layouts: put a
    brick in the box, stack it on another one, push it somewhere.
    """
    from vla_zenoh.runtime.environments import run_in_own_environment
    from vla_zenoh.runtime.process import stop_on_signals

    if family not in (None, "stay", *FAMILIES):
        raise typer.BadParameter(f"--family is one of {', '.join(FAMILIES)}, stay")
    varied = _varied([*(vary or []), *(["camera"] if camera_jitter else [])])
    named, path = _named(model)
    plan = TaskPlan(
        named,
        episodes,
        seed,
        family=family,
        held_out=held_out,
        pairs=pairs,
        prompt=prompt,
        limit_s=limit_s or LIMIT_S,
        rate_hz=rate_hz,
        delay_ms=delay_ms,
    )
    loaded = _with_bricks(effective_profile(profile), plan.worker, varied, path)
    chosen = chosen_worker(loaded, plan.worker, options or [])
    if lockstep:  # the model is made here; comes back only where that can be done
        run_in_own_environment(chosen.model, python, extra="sim")
    stop = stop_on_signals()
    camera = "front" if "front" in loaded.cameras else next(iter(loaded.cameras), None)
    mode = "lockstep" if lockstep else "real_time"
    score = TaskScore(plan, mode, loaded.name, varied, options=chosen.options)
    began_s = time.monotonic()
    try:
        with _bar(episodes) as advance:
            if lockstep:
                _lockstep(loaded, profile, score, camera, stop, processes, advance)
            else:
                _real_time(loaded, score, options or [], python, camera, stop, out, advance)
    finally:
        score.wall_s = time.monotonic() - began_s
        _write(score, json_file, out)
    _print(score.to_dict())
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
    """What a model is called, and where it is if that was given."""
    if not is_path(model):
        return model, ""
    found = find_model(model)
    if found.name in BASELINES:
        raise typer.BadParameter(
            f"--model {model}: {found.name} is what the others are held against; call the file "
            "otherwise"
        )
    return found.name, str(found.path)


def _with_bricks(profile: Profile, worker: str, vary: list[str], path: str = "") -> Profile:
    """The profile with the scene of the tasks and the worker in it, at `path` if it has one."""
    workers = [*dict.fromkeys([worker, *profile.workers])]
    return override(
        profile,
        {
            "sim": {"scene": SCENE, "vary": vary},
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


@contextmanager
def _bar(episodes: int) -> Iterator[Callable[[TaskScore], None]]:
    with Progress(
        TextColumn("{task.description:<44}", markup=False),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        console=errors(),
    ) as bars:
        bar = bars.add_task("starting", total=episodes)

        def advance(score: TaskScore) -> None:
            done = sum(each.success for each in score.ended)
            last = score.ended[-1]
            word = "done" if last.success else last.failure
            bars.update(
                bar,
                completed=len(score.ended),
                description=f"{done} of {len(score.ended)} done; the last: {word}",
            )

        yield advance


def _lockstep(
    profile: Profile,
    named: str,
    score: TaskScore,
    camera: str | None,
    stop: threading.Event,
    processes: int | None,
    advance: Callable[[TaskScore], None],
) -> None:
    from vla_zenoh.lab.bench.task_lockstep import run_in_lockstep

    for ended, latency_ms in run_in_lockstep(
        profile,
        score.plan,
        score.options,
        camera,
        stop,
        processes or os.cpu_count() or 1,
        named=named,
    ):
        score.ended.append(ended)
        score.latency_ms = latency_ms
        advance(score)


def _real_time(
    profile: Profile,
    score: TaskScore,
    options: list[str],
    python: str | None,
    camera: str | None,
    stop: threading.Event,
    out: Path | None,
    advance: Callable[[TaskScore], None],
) -> None:
    from vla_zenoh.cli.free_endpoint import own_address
    from vla_zenoh.lab.bench.task_runner import TaskRunner
    from vla_zenoh.lab.episode import Interrupted
    from vla_zenoh.runtime.launch import Host
    from vla_zenoh.runtime.process import die_with_parent

    die_with_parent()
    if out is not None:
        out.mkdir(parents=True, exist_ok=True)
    plan = score.plan
    arguments = [*(["--delay", f"{plan.delay_ms:g}"] if plan.delay_ms else [])]
    arguments += ["--python", python] if python else []
    last: deque[str] = deque(maxlen=LAST_LINES)
    with Path(os.devnull if out is None else out / "nodes.log").open("w", encoding="utf-8") as log:

        def write(node: str, line: str) -> None:
            last.append(f"{node:>16} | {line}")
            log.write(f"{last[-1]}\n")
            log.flush()

        host = Host(
            own_address(profile),
            None,
            log=write,
            tell=write,
            own_router=True,
            worker_options={plan.worker: options},
            worker_arguments=arguments,
        )
        try:
            with up_with_last_lines(host, last) as running:
                run = TaskRunner(running, plan, stop, camera)
                for ended in run.run():
                    score.ended.append(ended)
                    score.latency_ms = run.latency_ms()
                    advance(score)
        except Interrupted:
            pass


def _write(score: TaskScore, json_file: Path | None, out: Path | None) -> None:
    from vla_zenoh.lab.bench.task_sheet import failure_sheet

    write_json(json_file, score.to_dict())
    if out is not None:
        write_json(out / "result.json", score.to_dict())
        sheet = failure_sheet(score.ended)
        if sheet is not None:
            (out / "failures.jpg").write_bytes(sheet)


def _print(result: dict[str, Any]) -> None:
    table = Table(header_style="bold", title=_title(result), title_justify="left")
    for column in ("", "done", "of", "rate", "95 %", "time p50", "p95", "failures"):
        table.add_column(column, justify="left" if column in ("", "failures") else "right")
    rows = [("all", result), *result["by_family"].items(), *result.get("pairs", {}).items()]
    for name, row in rows:
        low, high = row["wilson_95"]
        times = row["time_to_success_s"]
        table.add_row(
            name,
            str(row["successes"]),
            str(row["episodes"]),
            f"{row['success_rate']:.1%}" if row["episodes"] else "",
            f"{low:.1%}..{high:.1%}",
            f"{times['p50']:.1f} s" if times else "",
            f"{times['p95']:.1f} s" if times else "",
            ", ".join(f"{kind} {count}" for kind, count in row["failures"].items()),
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
