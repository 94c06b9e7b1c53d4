"""``vla-zenoh demo`` with a policy that does tasks: nodes, run folder, verdicts."""

from __future__ import annotations

import time
from typing import Any

import typer
from rich.text import Text

from vla_zenoh.cli.output import console, new_table, styled
from vla_zenoh.errors import ResourceError, nearest
from vla_zenoh.lab.cli.demo_stage import Stage, latencies, open_stage, print_end
from vla_zenoh.lab.cli.options import DemoOptions
from vla_zenoh.lab.cli.output import print_json
from vla_zenoh.lab.evaluation.result import TASKS
from vla_zenoh.lab.tasks.judge import FAILURES, LIMIT_S
from vla_zenoh.lab.tasks.order import COLOURS, DIRECTIONS, PUSH, PUT, STACK, Order, phrase
from vla_zenoh.lab.tasks.task import SCENE, DemoPlan, TaskOutcome, is_judged, order_of, shown_camera
from vla_zenoh.lab.tasks.task_runner import TaskRunner
from vla_zenoh.lab.tasks.task_sheet import sheet
from vla_zenoh.policy.loader import find_model, make_policy
from vla_zenoh.sanitize import one_line, printable

MODEL = "brick"
ROUNDS = 3
"""Tasks without a prompt: one of every family."""


def run_task_demo(prompts: list[str], seed: int, profile: str, given: DemoOptions) -> None:
    """Run tasks and show the verdict on each.

    Raises:
        ResourceError: a prompt cannot be judged; the message lists what can.
    """
    orders = {prompt: _free_wording(prompt) for prompt in prompts if not is_judged(prompt)}
    with open_stage(profile, given) as stage:
        loaded = stage.profile
        if not prompts and loaded.sim.scene != SCENE:
            prompts = [loaded.task.prompt]
        plan = DemoPlan(
            loaded.task.worker,
            len(prompts) or ROUNDS,
            seed,
            rate_hz=given.rate_hz,
            prompts=tuple(prompts),
            orders=orders,
            limit_s=given.seconds or LIMIT_S,
        )
        ended = _run(stage, plan)
        run = stage.recorded()
        summary = {
            "ok": len(ended) == plan.episodes and all(each.success for each in ended),
            "profile": loaded.name,
            "model": plan.model,
            "rate_hz": given.rate_hz,
            "seed": seed,
            "tasks": [each.to_dict() for each in ended],
            "latency_ms": latencies(run),
            "refusals": stage.refusals(),
        }
        stage.write(summary)
        picture = sheet(ended)
        if picture is not None:
            (stage.folder / "tasks.jpg").write_bytes(picture)
        facts = stage.facts[TASKS]
        stage.draw(run, [(fact["ended_ns"], fact["said"], fact["success"]) for fact in facts])
    if given.as_json:
        print_json({**summary, "folder": stage.path})
    else:
        _show(ended)
        print_end(stage, summary, "tasks.jpg")
    if stage.stop.is_set():
        raise typer.Exit(130)
    if not summary["ok"]:
        raise typer.Exit(1)


def _run(stage: Stage, plan: DemoPlan) -> list[TaskOutcome]:
    ended: list[TaskOutcome] = []
    stage.facts.update({TASKS: [], "seed": plan.seed})
    with stage.nodes(52) as (running, _, bars):
        bar = bars.add_task("waiting for the first task", total=plan.episodes)
        run = TaskRunner(running, plan, stage.stop, shown_camera(stage.profile.cameras))
        for each in run.run():
            ended.append(each)
            stage.facts[TASKS].append(_fact(each))
            said = f"{one_line(each.prompt, 40)}: {_word(each)}"
            bars.update(bar, completed=len(ended), description=said)
    return ended


def _free_wording(prompt: str) -> Order:
    """The goal that the shipped policy reads in a prompt; it is judged by that.

    Raises:
        ResourceError: it reads none; lists what is known.
    """
    reading = make_policy(find_model(MODEL)).read(prompt)  # pyright: ignore[reportAttributeAccessIssue]
    order = order_of(reading)
    if order is None:
        raise ResourceError(_not_understood(prompt))
    console().print(styled(f"{one_line(prompt, 80)!r} is read as: {phrase(order, 0)}", "dim"))
    return order


def _not_understood(prompt: str) -> str:
    orders = [Order(PUT, "red"), Order(STACK, "red", onto="blue")]
    orders += [Order(PUSH, "red", direction=direction) for direction in DIRECTIONS]
    known = [phrase(order, 0) for order in orders]
    return "\n".join(
        [
            f"{one_line(prompt, 80)!r} is no task that the shipped policy understands"
            f"{nearest(prompt, known) or '.'} Known, in any of the colours {', '.join(COLOURS)}:",
            *(f"  {text}" for text in known),
            "  HARD: go up, and the other fixed motions",
            "For another prompt or model: `vla-zenoh up`, then `vla-zenoh prompt`",
        ]
    )


def _word(ended: TaskOutcome) -> str:
    return f"done in {ended.time_s:.1f} s" if ended.success else ended.failure


def _fact(ended: TaskOutcome) -> dict[str, Any]:
    return {
        "prompt": ended.prompt,
        "success": ended.success,
        "said": _word(ended),
        "why": ended.why,
        "time_s": round(ended.time_s, 2),
        "ended_ns": time.time_ns(),
    }


def _show(ended: list[TaskOutcome]) -> None:
    table = new_table("prompt", "verdict", title="prompts, judged by the true poses")
    for each in ended:
        colour = "green" if each.success else "red"
        why = FAILURES.get(each.failure, each.why)
        said = Text.assemble(styled(_word(each), colour), printable(f": {why}") if why else "")
        table.add_row(each.prompt, said)
    console().print(table)
