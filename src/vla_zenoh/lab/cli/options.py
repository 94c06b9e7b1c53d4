"""Options that several of the lab's commands share, beside those of `cli.options`."""

from __future__ import annotations

from typing import Annotated

import typer

SimulatedProfileOption = Annotated[
    str, typer.Option("--profile", "-p", help="Name or path of a simulated robot's profile.")
]


def number_list(option: str, text: str, low: float, high: float) -> list[float]:
    """Parse numbers separated by commas.

    Raises:
        typer.BadParameter: not numbers, or out of [low, high]; names the option.
    """
    try:
        numbers = [float(part) for part in text.split(",")]
    except ValueError as error:
        raise typer.BadParameter(f"{option} wants numbers separated by commas: {error}") from error
    if not all(low <= number <= high for number in numbers):
        raise typer.BadParameter(f"{option} wants numbers from {low:g} to {high:g}")
    return numbers
