"""Options that several of the lab's commands share, beside those of `cli.options`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer

from vla_zenoh.cli.options import MAX_SECONDS, JsonOption
from vla_zenoh.lab.cli.output_path import ForceOption

SimulatedProfileOption = Annotated[
    str, typer.Option("--profile", "-p", help="Name or path of a simulated robot's profile.")
]

EndAfterOption = Annotated[
    float | None,
    typer.Option("--seconds", "-s", min=0.1, max=MAX_SECONDS, help="End after this time."),
]


@dataclass(frozen=True)
class DemoOptions:
    """Options of both kinds of demo."""

    rate_hz: Annotated[
        float, typer.Option("--rate", help="Chunks per second.", min=0.2, max=50)
    ] = 5.0
    seconds: Annotated[
        float | None,
        typer.Option(
            "--seconds",
            help="Time for the steps of a fixed motion; time limit of a task.",
            min=0.5,
            max=3600,
        ),
    ] = None
    profile: Annotated[
        str | None, typer.Option("--profile", "-p", help="Name or path of a simulated profile.")
    ] = None
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", help="New folder of the run; default: runs/demo-<time>."),
    ] = None
    force: ForceOption = False
    as_json: JsonOption = False


def number_list(
    option: str, text: str, low: float, high: float, count: int | None = None
) -> list[float]:
    """Parse numbers separated by commas; of another `count` than is given they are rejected.

    Raises:
        typer.BadParameter: not numbers, too many, too few, or out of [low, high]; names the option.
    """
    try:
        numbers = [float(part) for part in text.split(",")]
    except ValueError as error:
        raise typer.BadParameter(f"{option} wants numbers separated by commas: {error}") from error
    if count is not None and len(numbers) != count:
        plural = "s separated by commas" if count > 1 else ""
        raise typer.BadParameter(f"{option} wants {count} number{plural}, not {text!r}")
    if not all(low <= number <= high for number in numbers):
        raise typer.BadParameter(f"{option} wants numbers from {low:g} to {high:g}")
    return numbers
