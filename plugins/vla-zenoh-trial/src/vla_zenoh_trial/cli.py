"""vla-zenoh trial: models on a real arm, judged by a person."""

from __future__ import annotations

import signal
import sys
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any

import typer

from vla_zenoh.cli.options import MAX_INDEX, MAX_SECONDS, JsonOption, options
from vla_zenoh.cli.output import console, errors, fail, new_table
from vla_zenoh.cli.plain import warn
from vla_zenoh.cli.target import RobotTarget
from vla_zenoh.errors import RecordingError, in_words
from vla_zenoh.lab.cli.output import print_json
from vla_zenoh.lab.cli.output_path import check_folder
from vla_zenoh_trial.folder import TrialFolder
from vla_zenoh_trial.plan import TrialPlan
from vla_zenoh_trial.score import TrialScore, score
from vla_zenoh_trial.verdict import EpisodeVerdict


@dataclass(frozen=True)
class PlanOptions:
    """Options for a new trial; one that is continued has them in its folder."""

    workers: Annotated[
        str | None, typer.Option("--workers", "-w", help="One or more, separated by commas.")
    ] = None
    prompt: Annotated[str | None, typer.Option("--prompt", help="The task.")] = None
    episodes: Annotated[
        int | None, typer.Option("--episodes", "-n", min=1, max=100_000, help="Per worker.")
    ] = None
    setups: Annotated[
        Path | None,
        typer.Option("--setups", help="Text file with a setup per line; every worker does each."),
    ] = None
    seconds: Annotated[
        float | None,
        typer.Option("--seconds", "-s", min=0.1, max=MAX_SECONDS, help="Time limit of an episode."),
    ] = None
    seed: Annotated[
        int | None,
        typer.Option(
            "--seed", min=0, max=MAX_INDEX, help="Of the order of workers; default: random."
        ),
    ] = None
    is_open: Annotated[
        bool, typer.Option("--open", help="Show which worker runs; default: blind.")
    ] = False

    def asked(self, robot: str) -> dict[str, Any]:
        """Fields of the plan that were given, None for the others."""
        workers = None if self.workers is None else self.workers.split(",")
        return {
            "robot": robot,
            "workers": None if workers is None else tuple(map(str.strip, workers)),
            "prompt": None if self.prompt is None else self.prompt.strip(),
            "setups": _setups(self.episodes, self.setups),
            "seconds": self.seconds,
            "seed": self.seed,
            "blind": False if self.is_open else None,
        }


@options
def trial(
    output: Annotated[
        Path, typer.Option("--output", "-o", help="Folder; that of a trial continues it.")
    ],
    plan_options: PlanOptions,
    target: RobotTarget,
    yes_setup: Annotated[
        bool, typer.Option("--yes-setup", help="Every setup is prepared; do not ask.")
    ] = False,
    report: Annotated[bool, typer.Option("--report", help="Only show the results so far.")] = False,
    as_json: JsonOption = False,
) -> None:
    """Try models on a real arm; you judge whether each episode succeeded.

    Every worker does every setup, in an order that you do not see. Enter ends an episode, Ctrl-C
    the trial; the arm brakes first. The same command continues it.
    """
    folder = TrialFolder(output)
    if report:
        plan = folder.plan()
        if plan is None:
            fail(f"{output} holds no trial")
        found = folder.episodes()
        if (done := score(plan, found).done) < plan.episodes:
            warn(
                f"{done} of {plan.episodes} episodes done: p and intervals hold where the number "
                "of episodes was fixed beforehand, not where the results so far decide when to stop"
            )
    else:
        asked = plan_options.asked(target.load().robot.name)
        check_folder(output, begun=folder.begun())
        with folder.lock():
            plan = _plan(folder, asked)
            found = folder.episodes()
            if folder.truncated:
                warn("the last line of trials.jsonl was cut off; its episode is repeated")
            if plan.next_due(found) is not None:
                found = _run(folder, plan, found, target, yes_setup)
    result = score(plan, found)
    if as_json:
        print_json(mapping_of(plan, result, found))
    else:
        show_score(plan, result)


def _setups(episodes: int | None, file: Path | None) -> tuple[str, ...] | None:
    if file is None:
        return None if episodes is None else ("",) * episodes
    if episodes is not None:
        raise typer.BadParameter("--setups says how many there are: leave --episodes out")
    try:
        lines = [line.strip() for line in file.read_text("utf-8").splitlines()]
    except (OSError, UnicodeError) as error:
        fail(f"--setups cannot be read: {in_words(error)}")
    return tuple(line for line in lines if line)


def _plan(folder: TrialFolder, asked: dict[str, Any]) -> TrialPlan:
    """The plan of the folder, or a new one from `asked`."""
    if folder.plan() is None:
        for name in ("workers", "prompt"):
            if asked[name] is None:
                raise typer.BadParameter(f"--{name} is required: {folder.path} holds no trial yet")
    try:
        return folder.agreed(asked)
    except RecordingError as error:
        fail(str(error))


def _run(
    folder: TrialFolder,
    plan: TrialPlan,
    found: list[EpisodeVerdict],
    target: RobotTarget,
    yes_setup: bool,
) -> list[EpisodeVerdict]:
    from vla_zenoh.lab.episode import Interrupted
    from vla_zenoh.runtime.process import stop_on_signals
    from vla_zenoh_trial.person import TrialPerson
    from vla_zenoh_trial.runner import TrialRunner

    stop = stop_on_signals()
    # Ctrl-Z may leave no moving arm behind.
    signal.signal(signal.SIGTSTP, signal.SIG_IGN)
    done = score(plan, found).done
    blind = "; blind" if plan.blind else ""
    text = f"{folder.path}: {plan.prompt!r}, {done} of {plan.episodes} episodes done{blind}"
    errors().print(text)
    person = TrialPerson(plan, sys.stdin.fileno(), stop, lays=yes_setup)
    try:
        with target.operator("trial", "--output", str(folder.path)) as client:
            return TrialRunner(client, plan, folder, person, stop).run()
    except Interrupted:
        done = score(plan, folder.episodes()).done
        errors().print(f"{done} of {plan.episodes} done; the same command continues")
        raise typer.Exit(130) from None


def mapping_of(plan: TrialPlan, result: TrialScore, found: list[EpisodeVerdict]) -> dict[str, Any]:
    """Plan, results and episodes of a trial, as JSON has them."""
    pair = result.paired
    return {
        "plan": asdict(plan),
        "done": result.done,
        "of": result.of,
        "workers": {each.worker: {**asdict(each), "rate": each.rate} for each in result.workers},
        "paired": None
        if pair is None
        else {
            **asdict(pair),
            "setups": pair.setups,
            "difference": pair.difference,
            "difference_95": pair.stated_95,
            "p": pair.p,
        },
        "episodes": [asdict(each) for each in found],
    }


def show_score(plan: TrialPlan, result: TrialScore) -> None:
    """Print the table of a trial, and of two workers their difference."""
    title = f"{plan.prompt!r}: {result.done} of {result.of} episodes"
    columns = ("worker", "done", "of", "rate", "95 %", "time p50", "brakes", "taken", "void")
    table = new_table(*columns, title=title, left=("worker",))
    for each in result.workers:
        low, high = each.wilson_95
        time_s = each.time_to_success_s
        table.add_row(
            each.worker,
            str(each.successes),
            str(each.episodes),
            "" if each.rate is None else f"{each.rate:.1%}",
            f"{low:.1%}..{high:.1%}",
            "" if time_s is None else f"{time_s:.1f} s",
            str(each.brakes),
            str(each.interventions),
            str(each.void),
        )
    screen = console()
    screen.print(table)
    pair = result.paired
    if pair is not None:
        one, other = plan.workers
        interval = pair.stated_95
        between = "" if interval is None else f" (95 %: {interval[0]:+.1%}..{interval[1]:+.1%})"
        screen.print(
            f"{one} minus {other} over {pair.setups} setups that both did: {pair.difference:+.1%}"
            f"{between}, exact McNemar p = {pair.p:.3g}; both {pair.both}, "
            f"{one} alone {pair.first}, {other} alone {pair.second}, neither {pair.neither}",
            soft_wrap=True,
        )
        if pair.too_few:
            screen.print(f"{pair.too_few}.", soft_wrap=True)
