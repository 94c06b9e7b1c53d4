"""vla-zenoh check."""

from __future__ import annotations

import contextlib
import os
import sys
from typing import Annotated

import typer
from rich.table import Table
from rich.text import Text

from vla_zenoh.cli.options import PROFILE_VARIABLE, JsonOption
from vla_zenoh.cli.output import console, print_json, styled
from vla_zenoh.cli.worker_choice import Chosen, chosen_worker
from vla_zenoh.control.policy_check import Finding, error
from vla_zenoh.errors import WorkerError
from vla_zenoh.lab.check.examination import DEFAULT_RUNS, Examination
from vla_zenoh.lab.check.model_runner import ModelRunner
from vla_zenoh.lab.check.report import CheckReport
from vla_zenoh.policy.loader import make_policy
from vla_zenoh.profile import Profile, load_profile
from vla_zenoh.runtime.environments import run_in_own_environment

STYLES = {"error": "bold red", "warning": "yellow", "note": "cyan"}


def check(
    model: Annotated[
        str, typer.Argument(help="A worker of the profile, name of a model, or path to one.")
    ],
    options: Annotated[
        list[str] | None,
        typer.Option("--set", help="Option of the model as name=value; may be repeated."),
    ] = None,
    profile: Annotated[
        str | None,
        typer.Option(
            "--profile",
            "-p",
            envvar=PROFILE_VARIABLE,
            help="Also hold it against this profile, with its options.",
        ),
    ] = None,
    name: Annotated[
        str | None, typer.Option("--name", help="What the worker is called; the model's name else.")
    ] = None,
    prompts: Annotated[
        list[str] | None,
        typer.Option("--prompt", help="Prompt to try; may be repeated."),
    ] = None,
    rate_hz: Annotated[
        float | None, typer.Option("--rate", help="Chunks per second to be asked of it.", min=0.01)
    ] = None,
    runs: Annotated[int, typer.Option("--runs", help="Timed inferences.", min=1)] = DEFAULT_RUNS,
    budget_s: Annotated[
        float,
        typer.Option(
            "--budget", help="Seconds from loading on after which nothing new is tried.", min=1
        ),
    ] = 30.0,
    patience_s: Annotated[
        float, typer.Option("--patience", help="Seconds for one call of the model.", min=0.1)
    ] = 300.0,
    strict: Annotated[bool, typer.Option("--strict", help="A warning fails, too.")] = False,
    python: Annotated[
        str | None, typer.Option("--python", help="Interpreter of a prepared environment.")
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Load a model as a worker does and hold it against its contract; no robot is needed.

    Exits with 0 when nothing is wrong, 1 when something is.
    """
    against = load_profile(profile) if profile is not None else None
    chosen = chosen_worker(against, model, options or [], name)
    run_in_own_environment(chosen.model, python)
    with contextlib.redirect_stdout(sys.stderr):  # a model's own words are not the result
        report = _examine(
            chosen,
            profile,
            against,
            rate_hz,
            prompts,
            runs,
            budget_s,
            patience_s,
        )
    if as_json:
        print_json(report.to_dict())
    else:
        _print(report)
    failed = not report.ok or (strict and _of(report, "warning"))
    sys.stdout.flush()
    # A model's library may leave threads behind that would keep the process.
    os._exit(1 if failed else 0)


def _examine(
    chosen: Chosen,
    named: str | None,
    profile: Profile | None,
    rate_hz: float | None,
    prompts: list[str] | None,
    runs: int,
    budget_s: float,
    patience_s: float,
) -> CheckReport:
    try:
        policy = make_policy(chosen.model, chosen.options, profile=named)
    except WorkerError as fault:
        return CheckReport(chosen.name, findings=[error("cannot_be_made", str(fault))])
    return Examination(
        policy,
        chosen.name,
        ModelRunner(patience_s),
        profile=profile,
        rate_hz=rate_hz,
        prompts=prompts,
        runs=runs,
        budget_s=budget_s,
    ).run()


def _of(report: CheckReport, level: str) -> list[Finding]:
    return [finding for finding in report.findings if finding.level == level]


def _print(report: CheckReport) -> None:
    out = console()
    table = Table(show_header=False, title=f"worker {report.worker}", title_justify="left")
    for what, said in _lines(report):
        table.add_row(what, said)
    if table.row_count:
        out.print(table)
    for finding in report.findings:
        level = styled(f"{finding.level:<7}", STYLES[finding.level])
        out.print(level, styled(finding.name, "bold"), end=": ")
        out.print(finding.why, soft_wrap=True)
    errors, warnings = len(_of(report, "error")), len(_of(report, "warning"))
    if report.ok:
        out.print(Text.assemble(("keeps its contract", "green"), f", {warnings} warnings"))
    else:
        said = f": {errors} errors, {warnings} warnings"
        out.print(Text.assemble(("breaks its contract", "bold red"), said))


def _lines(report: CheckReport) -> list[tuple[str, str]]:
    spec = report.spec
    if spec is None:
        return []
    action, seen = spec.action, spec.observation
    cameras = [
        f"{c.camera} {f'{c.width}x{c.height} {c.resize}' if c.width else 'as it comes'} {c.colour}"
        for c in seen.cameras
    ]
    lines = [
        ("sees", ", ".join([*cameras, *(f"state/{part}" for part in seen.state)]) or "nothing"),
        (
            "answers",
            f"up to {action.horizon} x {action.dimension}, {action.dt_s:g} s each: {action.kind} "
            f"{action.frame} {action.rotation}, gripper {action.gripper}"
            + (f", normalisation {action.normalisation}" if action.normalisation else ""),
        ),
    ]
    if report.shape is not None:
        lines.append(("first answer", f"{report.shape[0]} x {report.shape[1]}"))
    if report.step_range:
        ranges = ", ".join(f"{low:.3g}..{high:.3g}" for low, high in report.step_range)
        lines.append(("numbers", ranges))
    if report.latency_ms is not None:
        p50, p95, worst = report.latency_ms
        lines.append(
            (
                "inference",
                f"p50 {p50:.2f} ms, p95 {p95:.2f}, worst {worst:.2f} ({report.runs} runs); "
                f"the first {report.first_ms or 0:.1f} ms; load {report.load_s:.2f} s",
            )
        )
    if report.memory_mib is not None:
        before, loaded, after = report.memory_mib
        growth = report.growth_kib_per_run
        lines.append(
            (
                "memory",
                f"{before:.0f} MiB before load, {loaded:.0f} loaded, {after:.0f} after all runs"
                + (f"; {growth:+.1f} KiB a run" if growth is not None else ""),
            )
        )
    if report.deterministic is not None:
        lines.append(("same answer again", "yes" if report.deterministic else "no"))
    words = {True: "yes", False: "no", None: "not known"}
    lines += [(f"depends on {what}", words[known]) for what, known in report.depends_on.items()]
    return lines
