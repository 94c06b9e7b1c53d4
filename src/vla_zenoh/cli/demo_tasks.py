"""What ``vla-zenoh demo`` does with a policy that does tasks: nodes, run folder, verdicts."""

from __future__ import annotations

import json
import threading
import time
from pathlib import Path
from typing import Any

import typer
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table

from vla_zenoh.bench.task import Ended
from vla_zenoh.bench.task_sheet import sheet
from vla_zenoh.cli.demo_run import MAX_LOG_LINES, RECORDING, film, own_address, recorded, refusals
from vla_zenoh.cli.options import effective_profile
from vla_zenoh.cli.output import console, errors, printable
from vla_zenoh.demo.analysis import latencies
from vla_zenoh.demo.tasks import Tour, judged
from vla_zenoh.nodes.bench_task import TaskRun
from vla_zenoh.nodes.demo import Interrupted
from vla_zenoh.nodes.launch import Host
from vla_zenoh.nodes.process import die_with_parent, stop_on_signals
from vla_zenoh.nodes.recorder import Recorder
from vla_zenoh.profile import Profile, to_yaml
from vla_zenoh.recording.run import load_run
from vla_zenoh.tasks import FAILURES, LIMIT_S

ROUNDS = 3
"""Tasks without a prompt given: one of every family."""


def run_task_demo(
    prompts: list[str],
    seed: int,
    rate: float,
    seconds: float | None,
    profile: str,
    json_file: Path | None,
    out: Path | None,
) -> None:
    """See ``vla-zenoh demo``."""
    stop = stop_on_signals()
    die_with_parent()
    loaded = own_address(effective_profile(profile))
    folder = out or Path("runs") / time.strftime("demo-%Y%m%d-%H%M%S")
    folder.mkdir(parents=True, exist_ok=True)
    screen = errors()
    here = loaded.session.connect[0]
    screen.print(f"profile {loaded.name}, router at {here}, run folder {folder}")
    screen.print(f"watch it from another terminal: vla-zenoh status --connect {here}", style="dim")
    plan = Tour(
        loaded.task.worker,
        len(prompts) or ROUNDS,
        seed,
        rate_hz=rate,
        prompts=tuple(prompts),
        limit_s=seconds or LIMIT_S,
    )
    began_ns = time.time_ns()
    ended, refused = _run(loaded, plan, folder, stop, screen)
    run = load_run(folder / RECORDING)
    summary = {
        "ok": len(ended) == plan.episodes and all(_well(each) is not False for each in ended),
        "profile": loaded.name,
        "model": plan.model,
        "rate_hz": rate,
        "seed": seed,
        "tasks": [each.to_dict() | {"judged": judged(each.prompt)} for each in ended],
        "latency_ms": latencies(run.first_commands()),
        "refusals": refused,
    }
    (folder / "profile.yaml").write_text(to_yaml(loaded), "utf-8")
    text = json.dumps(summary, indent=2) + "\n"
    for path in (folder / "summary.json", json_file):
        if path is not None:
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(text, "utf-8")
    picture = sheet(ended)
    if picture is not None:
        (folder / "tasks.jpg").write_bytes(picture)
    marks = [(at_ns, prompt) for at_ns, prompt in run.prompts() if at_ns >= began_ns]
    film(folder, run, loaded, marks, screen)
    _show(ended, summary, folder)
    if stop.is_set():
        raise typer.Exit(130)
    if not summary["ok"]:
        raise typer.Exit(1)


def _run(
    profile: Profile, plan: Tour, folder: Path, stop: threading.Event, screen: Console
) -> tuple[list[Ended], dict[str, int]]:
    ended: list[Ended] = []
    lines: list[str] = []
    with (
        (folder / "nodes.log").open("w", encoding="utf-8") as log_file,
        Progress(
            TextColumn("{task.description:<52}"),
            BarColumn(),
            MofNCompleteColumn(),
            TimeElapsedColumn(),
            console=screen,
        ) as bars,
    ):
        bar = bars.add_task("starting the nodes", total=plan.episodes)

        def log(node: str, line: str) -> None:
            log_file.write(f"{node:>16} | {line}\n")
            lines.append(f"{node}: {line}")

        host = Host(profile, None, log=log, tell=log, own_router=True)
        camera = "front" if "front" in profile.cameras else None
        try:
            with host as running:
                assert running.session is not None and running.client is not None
                client = running.client
                recorder = Recorder(
                    profile, running.session, folder / RECORDING, expressions=recorded(profile)
                ).start()
                tasks = TaskRun(running, plan, stop, camera)
                try:
                    for each in tasks.run():
                        ended.append(each)
                        said = f"{printable(each.prompt)[:40]}: {_word(each)}"
                        bars.update(bar, completed=len(ended), description=said)
                except Interrupted:
                    pass
                finally:
                    counted = refusals({n: found[0] for n, found in client.snapshot().items()})
                    client.deactivate()
                    recorder.close()
        except Exception:
            screen.print("\n".join(lines[-MAX_LOG_LINES:]), style="dim", markup=False)
            raise
    return ended, counted


def _well(ended: Ended) -> bool | None:
    """Whether it was done; None: nobody here knows what was asked, and the chain was well."""
    if judged(ended.prompt):
        return ended.success
    return None if ended.success or ended.failure in FAILURES else False


def _word(ended: Ended) -> str:
    done = _well(ended)
    if done is None:
        return "not judged: a wording that only the policy may know"
    return f"done in {ended.time_s:.1f} s" if done else ended.failure


def _show(ended: list[Ended], summary: dict[str, Any], folder: Path) -> None:
    table = Table(title="asked by prompt, judged by the true poses", title_justify="left")
    table.add_column("prompt")
    table.add_column("")
    for each in ended:
        colour = {True: "green", False: "red", None: "yellow"}[_well(each)]
        known = judged(each.prompt) and each.failure in FAILURES
        why = FAILURES[each.failure] if known else each.why
        said = f"[{colour}]{_word(each)}[/]{f': {why}' if why else ''}"
        table.add_row(printable(each.prompt), said)
    screen = console()
    screen.print(table)
    latency = summary["latency_ms"]
    if latency.get("p50") is not None:
        screen.print(
            f"latency, camera stamp to pose command: p50 {latency['p50']:.1f} ms, "
            f"p95 {latency['p95']:.1f} ms; inference p50 "
            f"{latency['stages']['inference'].get('p50', 0.0):.1f} ms"
        )
    screen.print(f"run folder: {folder} (run.mcap, summary.json, tasks.jpg, front.mp4)")
