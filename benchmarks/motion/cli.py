"""python -m benchmarks motion: how well the arm does the thesis's ten motions."""

from __future__ import annotations

import threading
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.progress import TaskID
from vla_zenoh_benchmarks.result_file import write_json

from benchmarks.motion.protocol import PROTOCOL, STEPS, Conditions, MotionCase
from vla_zenoh.cli.options import DEFAULT_PROFILE, JsonOption, effective_profile, options
from vla_zenoh.cli.output import console
from vla_zenoh.lab.cli.options import SimulatedProfileOption, number_list
from vla_zenoh.lab.cli.output import print_json, progress_bars
from vla_zenoh.lab.cli.output_path import ForceOption, if_wanted, output_folder
from vla_zenoh.lab.cli.running_nodes import running_nodes
from vla_zenoh.profile import Profile

if TYPE_CHECKING:
    from vla_zenoh.lab.evaluation.result import Evaluation


@dataclass(frozen=True)
class MotionOptions:
    """Options for what is measured."""

    rates: Annotated[
        str, typer.Option("--rates", help="Chunks per second, separated by commas.")
    ] = "1,2,5,10"
    prompts: Annotated[
        str, typer.Option("--prompts", help="'all', or motions separated by commas.")
    ] = "all"
    chunks: Annotated[
        str, typer.Option("--chunks", help="Steps per chunk, separated by commas: 1,8,50.")
    ] = "1"
    delay_ms: Annotated[
        float, typer.Option("--delay", min=0, max=2000, help="Inference time in ms.")
    ] = 0.0
    jitter: Annotated[
        float, typer.Option("--jitter", min=0, max=0.9, help="Fraction by which it varies.")
    ] = 0.0

    def conditions(self) -> list[Conditions]:
        """Every chunk length at every rate."""
        rates_hz = number_list("--rates", self.rates, 0.2, 50)
        return [
            Conditions(rate_hz, int(horizon), self.delay_ms, self.jitter)
            for horizon in number_list("--chunks", self.chunks, 1, 100)
            for rate_hz in rates_hz
        ]

    def cases(self) -> list[MotionCase]:
        """The motions."""
        names = [case.name for case in PROTOCOL]
        wanted = names
        if self.prompts != "all":
            wanted = [part.strip() for part in self.prompts.split(",")]
        if unknown := [name for name in wanted if name not in names]:
            raise typer.BadParameter(
                f"{unknown[0]!r} is not a motion; there are: {', '.join(names)}"
            )
        return [case for case in PROTOCOL if case.name in wanted]


class _Run:
    """A run of the benchmark: its rows so far, with bars for them.

    Args:
        profile: of a simulated robot.
        measured: motions and conditions.
        stop: set by Ctrl-C.
    """

    def __init__(self, profile: Profile, measured: MotionOptions, stop: threading.Event) -> None:
        self._profile, self._stop = profile, stop
        self._cases, self._conditions = measured.cases(), measured.conditions()
        self.rows: list[dict[str, Any]] = []
        self.evaluated: list[Evaluation] = []
        """Each row that real nodes ran."""
        self.bars = progress_bars(44)
        total = len(self._cases) * len(self._conditions)
        self._everything = self.bars.add_task("all rows", total=total)

    def in_lockstep(self) -> None:
        """Run on a virtual clock."""
        from benchmarks.motion.lockstep import run_in_lockstep

        for row in run_in_lockstep(self._profile, self._cases, self._conditions, self._stop):
            self.rows.append(row)
            self.bars.update(self._everything, advance=1)

    def in_real_time(self) -> None:
        """Run with real nodes."""
        from vla_zenoh.lab.cli.loopback import own_address
        from vla_zenoh.lab.episode import Interrupted
        from vla_zenoh.runtime.process import die_with_parent

        die_with_parent()
        profile = own_address(self._profile)
        current = self.bars.add_task("starting the nodes", total=STEPS)
        # The worker's options are fixed at its start: start once per chunk length.
        for horizon in dict.fromkeys(each.horizon for each in self._conditions):
            alike = [each for each in self._conditions if each.horizon == horizon]
            try:
                self._with_one_worker(profile, alike, current)
            except Interrupted:
                return

    def _with_one_worker(
        self, profile: Profile, conditions: Sequence[Conditions], current: TaskID
    ) -> None:
        from benchmarks.motion.real_time import run_in_real_time
        from vla_zenoh.lab.evaluation.mcap_file import evaluate_loaded

        def progress(case: MotionCase, each: Conditions, done: int) -> None:
            self.bars.update(current, description=f"{case.name} at {each.name}", completed=done)

        first = conditions[0]
        settings = (
            f"horizon={first.horizon}",
            f"delay_ms={first.delay_ms:g}",
            f"jitter={first.jitter:g}",
        )
        nodes = running_nodes(profile, worker_options={profile.task.worker: settings})
        with TemporaryDirectory() as folder, nodes as running:
            for row, run in run_in_real_time(
                running, self._cases, conditions, self._stop, Path(folder), progress
            ):
                self.rows.append(row)
                self.bars.update(self._everything, advance=1)
                found = evaluate_loaded(run)
                found.name = f"{row['prompt']}, {row['rate_hz']:g} Hz, {row['horizon']} steps"
                self.evaluated.append(found)


@options
def motion(
    measured: MotionOptions,
    lockstep: Annotated[
        bool,
        typer.Option("--lockstep", help="On a virtual clock, faster than real time, no nodes."),
    ] = False,
    profile: SimulatedProfileOption = DEFAULT_PROFILE,
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", help="New folder for result.json and report.html."),
    ] = None,
    force: ForceOption = False,
    as_json: JsonOption = False,
) -> None:
    """Run the thesis's ten prompts, 50 steps each, through the real nodes, and judge each.

    Exits with 0 only when every row passes.
    """
    from benchmarks.motion.table import motion_table
    from vla_zenoh.runtime.process import stop_on_signals

    with if_wanted(output_folder, output, force=force) as folder:
        stop = stop_on_signals()
        run = _Run(effective_profile(profile), measured, stop)
        try:
            with run.bars:
                run.in_lockstep() if lockstep else run.in_real_time()
        finally:
            if folder is not None and run.rows:
                write_json(folder / "result.json", run.rows)
                if run.evaluated:
                    from vla_zenoh.lab.evaluation.report import page

                    (folder / "report.html").write_text(page(run.evaluated, {}), "utf-8")
    if as_json:
        print_json(run.rows)
    else:
        console().print(motion_table(run.rows))
    if stop.is_set():
        raise typer.Exit(130)
    if not run.rows or not all(row["ok"] for row in run.rows):
        raise typer.Exit(1)
