"""vla-zenoh figure: motion, latency and success as figures for a paper."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer
from vla_zenoh_benchmarks.paired_tasks import read_run

from vla_zenoh.cli.options import JsonOption
from vla_zenoh.errors import ResourceError
from vla_zenoh.lab.cli.output import print_json, progress
from vla_zenoh.lab.cli.output_path import ForceOption
from vla_zenoh.lab.evaluation.evaluate import EMPTY, evaluate, recordings
from vla_zenoh.lab.evaluation.result import STAGES, Evaluation
from vla_zenoh_figures import style
from vla_zenoh_figures.latency import latency as draw_latency
from vla_zenoh_figures.motion import motion as draw_motion
from vla_zenoh_figures.success import Result
from vla_zenoh_figures.success import success as draw_success

Runs = Annotated[list[Path], typer.Argument(help="Recordings (.mcap), or folders of them.")]
Results = Annotated[
    list[Path],
    typer.Argument(help="Results of `bench task` or `bench sim`: folders or JSON files."),
]
OutputOption = Annotated[
    Path, typer.Option("--output", "-o", help="File to write: .pdf, .svg or .png.")
]
PageOption = Annotated[
    bool,
    typer.Option(
        "--page",
        help=f"As wide as a page ({style.PAGE_IN:g} in), not as a column ({style.COLUMN_IN:g} in).",
    ),
]


def motion(
    runs: Runs,
    output: OutputOption,
    page: PageOption = False,
    force: ForceOption = False,
    as_json: JsonOption = False,
) -> None:
    """Draw how the TCP moved: of one run beside what was commanded, of several together.

    Prints the caption, with the number of prompts and chunks and how far the arm was behind.
    """
    style.check_name(output)
    files, found = _evaluated(runs)
    _write(draw_motion(found, _width_in(page)), output, page, force, files, as_json)


def latency(
    runs: Runs,
    output: OutputOption,
    stage: Annotated[
        str, typer.Option("--stage", help=f"Which part: {', '.join(STAGES)}.")
    ] = "end_to_end",
    page: PageOption = False,
    force: ForceOption = False,
    as_json: JsonOption = False,
) -> None:
    """Draw how long requests took, as cumulative distributions.

    Prints the caption, with the number of requests, median and 95th percentile of each run.
    """
    style.check_name(output)
    if stage not in STAGES:
        raise typer.BadParameter(f"--stage {stage!r}: {', '.join(STAGES)}")
    files, found = _evaluated(runs)
    _write(draw_latency(found, _width_in(page), stage), output, page, force, files, as_json)


def success(
    results: Results,
    output: OutputOption,
    page: PageOption = False,
    force: ForceOption = False,
    as_json: JsonOption = False,
) -> None:
    """Draw success rates with their intervals, of one result or of several side by side.

    Prints the caption, with the number of episodes and the seeds.
    """
    style.check_name(output)
    files = [path / "result.json" if path.is_dir() else path for path in results]
    read: list[Result] = []
    for path, file in zip(results, files, strict=True):
        try:
            content = file.read_bytes()
        except OSError as error:
            raise ResourceError(f"{path} cannot be read: {error.strerror}") from error
        read.append(Result("", read_run(content, str(path))))
    named = [
        each._replace(name=name) for each, name in zip(read, _names(read, results), strict=True)
    ]
    _write(draw_success(named, _width_in(page)), output, page, force, files, as_json)


def _names(read: list[Result], paths: list[Path]) -> list[str]:
    """The models, or the names of the files where two results have the same."""
    models = [each.file.model for each in read]
    return models if len(set(models)) == len(models) else [path.stem for path in paths]


def _evaluated(paths: list[Path]) -> tuple[list[Path], list[Evaluation]]:
    """The files, and a run of each. Raises ResourceError: one cannot be evaluated."""
    files = [file for path in paths for file in recordings([path])]
    empty = [path for path in paths if not list(recordings([path]))]
    if empty:
        raise ResourceError(EMPTY.format(empty[0]))
    with progress("evaluating"):
        found, faults = evaluate(files)
    if faults:
        raise ResourceError(next(iter(faults.values())))
    return files, found


def _width_in(page: bool) -> float:
    return style.PAGE_IN if page else style.COLUMN_IN


def _write(
    drawn: style.Drawn, output: Path, page: bool, force: bool, inputs: list[Path], as_json: bool
) -> None:
    style.write(drawn, output, force=force, inputs=inputs)
    if as_json:
        told: dict[str, Any] = {"file": str(output), "width_in": _width_in(page)}
        print_json(told | {"caption": drawn.caption})
        return
    typer.echo(drawn.caption)
