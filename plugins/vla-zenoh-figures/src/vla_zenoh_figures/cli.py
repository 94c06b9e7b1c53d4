"""vla-zenoh figure: motion, latency and success as figures for a paper."""

from __future__ import annotations

from contextlib import AbstractContextManager
from pathlib import Path
from typing import Annotated, Any

import typer
from vla_zenoh_benchmarks.paired_tasks import TaskResultFile, read_run

from vla_zenoh.cli.options import JsonOption
from vla_zenoh.cli.output import console
from vla_zenoh.errors import ResourceError
from vla_zenoh.lab.cli.output import print_json, progress
from vla_zenoh.lab.cli.output_path import ForceOption, output_file
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
    with _output(output, force, files := _recordings(runs)) as file:
        drawn = draw_motion(_evaluated(files), _width_in(page))
        style.write(drawn, file)
    _tell(drawn, output, page, as_json)


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
    if stage not in STAGES:
        raise typer.BadParameter(f"--stage {stage!r}: {', '.join(STAGES)}")
    with _output(output, force, files := _recordings(runs)) as file:
        drawn = draw_latency(_evaluated(files), _width_in(page), stage)
        style.write(drawn, file)
    _tell(drawn, output, page, as_json)


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
    files = [path / "result.json" if path.is_dir() else path for path in results]
    with _output(output, force, files) as file:
        read = [_result(path, name) for path, name in zip(files, results, strict=True)]
        names = _names(read, results)
        named = [Result(name, each) for name, each in zip(names, read, strict=True)]
        drawn = draw_success(named, _width_in(page))
        style.write(drawn, file)
    _tell(drawn, output, page, as_json)


def _result(file: Path, given: Path) -> TaskResultFile:
    try:
        content = file.read_bytes()
    except OSError as error:
        raise ResourceError(f"{given} cannot be read: {error.strerror}") from error
    return read_run(content, str(given))


def _names(read: list[TaskResultFile], paths: list[Path]) -> list[str]:
    """The models, or the names of the files where two results have the same."""
    models = [each.model for each in read]
    return models if len(set(models)) == len(models) else [path.stem for path in paths]


def _recordings(paths: list[Path]) -> list[Path]:
    """The recordings in `paths`. Raises ResourceError: there are none in one of them."""
    for path in paths:
        if not list(recordings([path])):
            raise ResourceError(EMPTY.format(path))
    return list(recordings(paths))


def _evaluated(files: list[Path]) -> list[Evaluation]:
    """A run of each file. Raises ResourceError: one cannot be evaluated."""
    with progress("evaluating"):
        found, faults = evaluate(files)
    if faults:
        raise ResourceError(next(iter(faults.values())))
    return found


def _output(path: Path, force: bool, inputs: list[Path]) -> AbstractContextManager[Path]:
    """The file to write, tried before the work begins."""
    style.check_name(path)
    return output_file(path, force=force, inputs=inputs)


def _width_in(page: bool) -> float:
    return style.PAGE_IN if page else style.COLUMN_IN


def _tell(drawn: style.Drawn, output: Path, page: bool, as_json: bool) -> None:
    if as_json:
        told: dict[str, Any] = {"file": str(output), "width_in": _width_in(page)}
        print_json(told | {"caption": drawn.caption})
        return
    console().print(drawn.caption, soft_wrap=True)
