"""vla-zenoh demo."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from vla_zenoh.cli.options import DEFAULT_PROFILE

DEFAULT_STEPS = 50


def demo(
    prompt: Annotated[
        str | None,
        typer.Option("--prompt", help="One HARD prompt; without it, a tour of all of them."),
    ] = None,
    rate: Annotated[
        float, typer.Option("--rate", help="Chunks per second.", min=0.2, max=50)
    ] = 5.0,
    steps: Annotated[
        int, typer.Option("--steps", help="Steps of the prompt.", min=1, max=10_000)
    ] = DEFAULT_STEPS,
    seconds: Annotated[
        float | None,
        typer.Option("--seconds", help="Let the prompt run this long instead.", min=0.5, max=3600),
    ] = None,
    profile: Annotated[
        str, typer.Option("--profile", "-p", help="Name or path of a simulated robot's profile.")
    ] = DEFAULT_PROFILE,
    json_file: Annotated[
        Path | None, typer.Option("--json", help="Write the summary to this file.")
    ] = None,
    out: Annotated[
        Path | None, typer.Option("--out", help="Run folder; runs/demo-<time> without it.")
    ] = None,
) -> None:
    """Bring a simulated robot up, let a prompt move it, and show what was asked and reached.

    Exits with 0 only when the arm did what was asked.
    """
    # Simulation, kinematics and plots take a while to load, and a camera host has none of them.
    from vla_zenoh.cli.demo_run import run_demo
    from vla_zenoh.demo.segments import make_segment, tour

    segments = [make_segment(prompt, steps)] if prompt is not None else tour()
    run_demo(segments, rate, seconds, profile, json_file, out)
