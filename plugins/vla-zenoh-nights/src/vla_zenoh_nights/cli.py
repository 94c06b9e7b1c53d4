"""vla-zenoh nights: models on a real arm, without a person."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from vla_zenoh_trial.cli import mapping_of, show_score
from vla_zenoh_trial.folder import TrialFolder

from vla_zenoh.cli.options import JsonOption, options
from vla_zenoh.cli.output import console, errors
from vla_zenoh.cli.plain import warn
from vla_zenoh.cli.target import RobotTarget
from vla_zenoh.lab.cli.output import print_json
from vla_zenoh.lab.cli.output_path import check_folder
from vla_zenoh.lab.episode import Interrupted
from vla_zenoh.runtime.process import stop_on_signals
from vla_zenoh_nights.plan import read_plan
from vla_zenoh_nights.runner import run_unattended
from vla_zenoh_nights.trial import PAGE, PLAN, UnattendedTrial

STOPPED = 3
"""Exit code of a trial that a rule or a person stopped."""


@options
def nights(
    plan_file: Annotated[
        Path, typer.Argument(metavar="PLAN", help="YAML: tasks, models, resets, judge, rules.")
    ],
    output: Annotated[
        Path, typer.Option("--output", "-o", help="Folder; that of a trial continues it.")
    ],
    target: RobotTarget,
    as_json: JsonOption = False,
) -> None:
    """Try models on a real arm without a person: a program resets the scene and judges.

    It moves the arm with nobody beside it. The same command continues it after an interruption.
    Exit status 3: a rule or a person stopped it.
    """
    plan = read_plan(plan_file)
    check_folder(output, begun=(output / PLAN).exists())
    robot = target.load().robot.name
    stop = stop_on_signals()
    with TrialFolder(output).lock():
        trial = UnattendedTrial(output, plan, robot)
        try:
            why = run_unattended(
                trial,
                lambda: target.operator("nights", str(plan_file), "--output", str(output)),
                plan_file.parent,
                stop,
                warn,
            )
        except Interrupted:
            errors().print("interrupted; the same command continues")
            raise typer.Exit(130) from None
    found = trial.scores()
    if as_json:
        tasks = {
            each.name: mapping_of(trial.trial(each)[1], result, episodes)
            for each, result, episodes in found
        }
        print_json({"stopped": why, "tasks": tasks})
    else:
        for each, result, _ in found:
            show_score(trial.trial(each)[1], result)
        console().print(f"page: {output / PAGE}")
    if why:
        warn(f"stopped by a rule or a person: {why}")
        raise typer.Exit(STOPPED)
