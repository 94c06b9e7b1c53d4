"""vla-zenoh check: a model against its contract."""

from __future__ import annotations

import contextlib
import os
import sys
from dataclasses import dataclass
from typing import Annotated

import typer
from rich.text import Text

from vla_zenoh.cli.options import (
    MAX_SECONDS,
    PROFILE_VARIABLE,
    JsonOption,
    ModelOptions,
    WorkerChoice,
    node_name,
    not_empty,
    options,
)
from vla_zenoh.cli.output import console, new_table, styled
from vla_zenoh.control.policy_check import error
from vla_zenoh.errors import WorkerError, counted
from vla_zenoh.lab.check.examination import DEFAULT_RUNS, CheckReport, Examination
from vla_zenoh.lab.check.model_runner import ModelRunner
from vla_zenoh.lab.cli.output import print_json, progress
from vla_zenoh.policy import ActionSpec, CameraSpec, DepthSpec
from vla_zenoh.policy.loader import make_policy
from vla_zenoh.profile import Profile, load_profile
from vla_zenoh.runtime.environments import run_in_own_environment

STYLES = {"error": "bold red", "warning": "yellow", "note": "cyan"}


@dataclass(frozen=True)
class CheckPlan:
    """Options for what is tried with the model."""

    prompts: Annotated[
        list[str] | None,
        typer.Option("--prompt", parser=not_empty, help="Prompt to try; repeatable."),
    ] = None
    rate_hz: Annotated[
        float | None, typer.Option("--rate", help="Required chunks per second.", min=0.01, max=1000)
    ] = None
    runs: Annotated[int, typer.Option("--runs", help="Timed inferences.", min=1, max=1_000_000)] = (
        DEFAULT_RUNS
    )
    budget_s: Annotated[
        float,
        typer.Option(
            "--budget",
            help="Seconds after loading at which no further test is started.",
            min=1,
            max=MAX_SECONDS,
        ),
    ] = 30.0
    patience_s: Annotated[
        float, typer.Option("--patience", help="Seconds for one call.", min=0.1, max=MAX_SECONDS)
    ] = 300.0

    def examine(
        self, chosen: WorkerChoice, named: str | None, profile: Profile | None
    ) -> CheckReport:
        """Load the model and test it.

        Args:
            profile: to check it against; None: only against its own spec.
        """
        try:
            policy = make_policy(chosen.model, chosen.options, profile=named)
        except WorkerError as fault:
            return CheckReport(chosen.name, findings=[error("cannot_be_made", str(fault))])
        return Examination(
            policy,
            chosen.name,
            ModelRunner(self.patience_s),
            profile=profile,
            rate_hz=self.rate_hz,
            prompts=self.prompts,
            runs=self.runs,
            budget_s=self.budget_s,
        ).run()


@options
def check(
    model: Annotated[
        str, typer.Argument(help="A worker of the profile, name of a model, or path to one.")
    ],
    model_options: ModelOptions,
    plan: CheckPlan,
    profile: Annotated[
        str | None,
        typer.Option(
            "--profile", "-p", envvar=PROFILE_VARIABLE, help="Also check against this profile."
        ),
    ] = None,
    name: Annotated[
        str | None,
        typer.Option("--name", parser=node_name, help="Worker name; default: the model's name."),
    ] = None,
    strict: Annotated[bool, typer.Option("--strict", help="Fail on warnings too.")] = False,
    as_json: JsonOption = False,
) -> None:
    """Load a model as a worker does and check it against its contract; needs no robot.

    Exits with 1 if it breaks the contract, else with 0.
    """
    against = load_profile(profile) if profile is not None else None
    chosen = model_options.choose(against, model, name)
    run_in_own_environment(chosen.model, model_options.python)
    # A model's own output is not the result.
    with contextlib.redirect_stdout(sys.stderr), progress(f"loading and testing {chosen.name}"):
        report = plan.examine(chosen, profile, against)
    if as_json:
        print_json(report.to_dict())
    else:
        _print(report)
        if against is None:
            out = "cameras, joints, limits and rates of a robot are not checked: give --profile"
            console().print(out, soft_wrap=True)
    failed = not report.ok or (strict and _count(report, "warning"))
    sys.stdout.flush()
    os._exit(1 if failed else 0)  # threads of a model's library may keep the process alive


def _count(report: CheckReport, level: str) -> int:
    return sum(finding.level == level for finding in report.findings)


def _print(report: CheckReport) -> None:
    out = console()
    table = new_table("", "", show_header=False, title=f"worker {report.worker}")
    for name, value in _rows(report):
        table.add_row(name, value)
    if table.row_count:
        out.print(table)
    for finding in report.findings:
        level = styled(f"{finding.level:<7}", STYLES[finding.level])
        out.print(level, styled(finding.name, "bold"), end=": ")
        out.print(finding.why, soft_wrap=True)
    warnings = counted(_count(report, "warning"), "warning")
    if report.ok:
        out.print(Text.assemble(("keeps its contract", "green"), f", {warnings}"))
    else:
        counts = f": {counted(_count(report, 'error'), 'error')}, {warnings}"
        out.print(Text.assemble(("breaks its contract", "bold red"), counts))


def _rows(report: CheckReport) -> list[tuple[str, str]]:
    spec = report.spec
    if spec is None:
        return []
    action = spec.action
    rows = [
        ("inputs", _inputs(report)),
        (
            "outputs",
            f"up to {action.horizon} x {action.dimension}, {action.dt_s:g} s each: "
            + _meaning(action),
        ),
    ]
    if report.shape is not None:
        rows.append(("first answer", f"{report.shape[0]} x {report.shape[1]}"))
    if report.step_range:
        ranges = ", ".join(
            f"{column} {low:.3g}..{high:.3g}"
            for column, (low, high) in zip(column_names(action), report.step_range, strict=True)
        )
        rows.append(("values", ranges))
    if report.latency_ms is not None:
        p50, p95, worst = report.latency_ms
        timing = (
            f"p50 {p50:.2f} ms, p95 {p95:.2f}, worst {worst:.2f} ({report.runs} runs); "
            f"the first {report.first_ms or 0:.1f} ms; load {report.load_s:.2f} s"
        )
        rows.append(("inference", timing))
    if report.memory_mib is not None:
        before, loaded, after = report.memory_mib
        growth = report.growth_kib_per_run
        memory = f"{before:.0f} MiB before load, {loaded:.0f} loaded, {after:.0f} after all runs"
        rows.append(
            ("memory", memory + (f"; {growth:+.1f} KiB a run" if growth is not None else ""))
        )
    if report.deterministic is not None:
        rows.append(("same answer again", "yes" if report.deterministic else "no"))
    words = {True: "yes", False: "no", None: "unknown"}
    return rows + [
        (f"depends on {what}", words[known]) for what, known in report.depends_on.items()
    ]


def _added_to(action: ActionSpec) -> str:
    """What its deltas are added to, where that is not the default."""
    out = "" if action.anchor == "goal" else ", from the measured pose"
    out += "" if action.relative_to == "previous" else ", all from the start of the chunk"
    if action.controller is not None:
        gains = action.controller
        out += f", by a controller of kp {gains.kp:g} and damping ratio {gains.damping_ratio:g}"
    return out


def _meaning(action: ActionSpec) -> str:
    """What the numbers of a step mean."""
    if action.parts:
        return "; ".join(f"{each.part} {_meaning(each.action)}" for each in action.parts)
    motion = "of joints" if action.space == "joint" else f"{action.frame} {action.rotation}"
    normalised = f", normalisation {action.normalisation}" if action.normalisation else ""
    return f"{action.kind} {motion}{_added_to(action)}, gripper {action.gripper}{normalised}"


def column_names(action: ActionSpec) -> list[str]:
    """Name and unit of each number of a step."""
    if action.parts:
        return [
            f"{each.part} {name}" for each in action.parts for name in column_names(each.action)
        ]
    per = "/s" if action.kind == "velocity" else ""
    gripper = ["gripper"] if action.gripper != "none" else []
    if action.space == "joint":
        return [*(f"{name} rad{per}" for name in action.joints), *gripper]
    scale = "" if action.position_scale_m == 1.0 else f"* {action.position_scale_m:g} "
    unit = f" rad{per}" if action.rotation in ("rpy", "rotvec") else ""
    rotation = [f"{name}{unit}" for name in action.rotation_form.names]
    return [*(f"{axis} {scale}m{per}" for axis in "xyz"), *rotation, *gripper]


def _inputs(report: CheckReport) -> str:
    assert report.spec is not None
    observation = report.spec.observation
    cameras = [f"{c.camera} {_size(c)} {c.colour}" for c in observation.cameras]
    depths = [
        f"depth of {d.camera} {_size(d)} {d.unit_m * 1e3:g} mm a count" for d in observation.depth
    ]
    parts = ", ".join([*cameras, *depths, *(f"state/{part}" for part in observation.state)])
    if observation.history > 1:
        parts += (
            f"; {observation.history} observations {observation.history_spacing_s:g} s apart, at "
            f"the start of an episode: {observation.history_start}"
        )
    return parts or "none"


def _size(of: CameraSpec | DepthSpec) -> str:
    return f"{of.width}x{of.height} {of.resize}" if of.width else "in its own size"
