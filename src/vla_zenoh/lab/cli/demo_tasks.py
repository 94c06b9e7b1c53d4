"""``vla-zenoh demo`` with a policy that does tasks: nodes, run folder, verdicts."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import typer
from rich.text import Text

from vla_zenoh.cli.output import console, new_table, styled
from vla_zenoh.lab.bench.task import DemoPlan, TaskOutcome, is_judged
from vla_zenoh.lab.bench.task_runner import TaskRunner
from vla_zenoh.lab.bench.task_sheet import sheet
from vla_zenoh.lab.cli.demo_options import DemoOptions
from vla_zenoh.lab.cli.demo_stage import Stage, prepare, refusals
from vla_zenoh.lab.demo.segments import latencies
from vla_zenoh.lab.episode import Interrupted
from vla_zenoh.lab.evaluation.result import TASKS
from vla_zenoh.lab.tasks import FAILURES, LIMIT_S
from vla_zenoh.sanitize import one_line, printable

ROUNDS = 3
"""Tasks without a prompt: one of every family."""


def run_task_demo(prompts: list[str], seed: int, profile: str, given: DemoOptions) -> None:
    """Run tasks and show the verdict on each."""
    stage = prepare(profile, given.out)
    loaded, folder = stage.profile, stage.folder
    plan = DemoPlan(
        loaded.task.worker,
        len(prompts) or ROUNDS,
        seed,
        rate_hz=given.rate_hz,
        prompts=tuple(prompts),
        limit_s=given.seconds or LIMIT_S,
    )
    ended, refused = _run(stage, plan)
    run = stage.recorded()
    summary = {
        "ok": len(ended) == plan.episodes and all(_well(each) is not False for each in ended),
        "profile": loaded.name,
        "model": plan.model,
        "rate_hz": given.rate_hz,
        "seed": seed,
        "tasks": [each.to_dict() | {"judged": is_judged(each.prompt)} for each in ended],
        "latency_ms": latencies(run.first_commands()),
        "refusals": refused,
    }
    stage.write(summary, given.json_file)
    picture = sheet(ended)
    if picture is not None:
        (folder / "tasks.jpg").write_bytes(picture)
    stage.draw(run)
    facts = stage.facts[TASKS]
    stage.film(run, [(fact["ended_ns"], fact["said"], fact["success"]) for fact in facts])
    _show(ended, summary, folder)
    if stage.stop.is_set():
        raise typer.Exit(130)
    if not summary["ok"]:
        raise typer.Exit(1)


def _run(stage: Stage, plan: DemoPlan) -> tuple[list[TaskOutcome], dict[str, int]]:
    ended: list[TaskOutcome] = []
    stage.facts.update({TASKS: [], "seed": plan.seed})
    with stage.nodes(52) as (running, bars):
        assert running.client is not None
        client = running.client
        bar = bars.add_task("waiting for the first task", total=plan.episodes)
        try:
            for each in TaskRunner(running, plan, stage.stop, stage.camera).run():
                ended.append(each)
                stage.facts[TASKS].append(_fact(each))
                said = f"{one_line(each.prompt, 40)}: {_word(each)}"
                bars.update(bar, completed=len(ended), description=said)
        except Interrupted:
            pass
        finally:
            counted = refusals({n: found[0] for n, found in client.snapshot().items()})
            client.deactivate()
    return ended, counted


def _well(ended: TaskOutcome) -> bool | None:
    """Whether it was done; None: the prompt cannot be judged, and no node failed."""
    if is_judged(ended.prompt):
        return ended.success
    return None if ended.success or ended.failure in FAILURES else False


def _word(ended: TaskOutcome) -> str:
    done = _well(ended)
    if done is None:
        return "not judged: unknown wording"
    return f"done in {ended.time_s:.1f} s" if done else ended.failure


def _fact(ended: TaskOutcome) -> dict[str, Any]:
    return {
        "prompt": ended.prompt,
        "success": _well(ended),
        "said": _word(ended),
        "why": ended.why,
        "time_s": round(ended.time_s, 2),
        "ended_ns": time.time_ns(),
    }


def _show(ended: list[TaskOutcome], summary: dict[str, Any], folder: Path) -> None:
    table = new_table("prompt", "verdict", title="prompts, judged by the true poses")
    for each in ended:
        colour = {True: "green", False: "red", None: "yellow"}[_well(each)]
        known = is_judged(each.prompt) and each.failure in FAILURES
        why = FAILURES[each.failure] if known else each.why
        said = Text.assemble(styled(_word(each), colour), printable(f": {why}") if why else "")
        table.add_row(each.prompt, said)
    screen = console()
    screen.print(table)
    latency = summary["latency_ms"]
    if latency.get("p50") is not None:
        screen.print(
            f"latency, camera stamp to pose command: p50 {latency['p50']:.1f} ms, "
            f"p95 {latency['p95']:.1f} ms; inference p50 "
            f"{latency['stages']['inference'].get('p50', 0.0):.1f} ms"
        )
    screen.print(f"run folder: {folder} (run.mcap, summary.json, tasks.jpg, plot.png, video.mp4)")
