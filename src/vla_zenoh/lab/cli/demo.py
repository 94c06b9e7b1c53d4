"""vla-zenoh demo: a simulated robot does tasks by prompt."""

from __future__ import annotations

from importlib.util import find_spec
from typing import Annotated

import typer

from vla_zenoh.cli.options import DEFAULT_PROFILE, MAX_INDEX, not_empty, options
from vla_zenoh.errors import MissingExtraError
from vla_zenoh.lab.cli.options import DemoOptions

TASK_PROFILE = "panda_bricks"
NEEDED = ("mujoco", "pinocchio", "ruckig", "daqp", "mcap", "plotly", "av")
EXTRAS = "brick,sim"
"""Extras of the demo; without `sim` nothing of it works."""


@options
def demo(
    given: DemoOptions,
    prompt: Annotated[
        str | None,
        typer.Option(
            "--prompt",
            parser=not_empty,
            help="A task such as 'put the red brick in the box', or a fixed motion such as "
            "'HARD: go up x20'. Default: one task of every kind.",
        ),
    ] = None,
    seed: Annotated[
        int | None, typer.Option("--seed", help="Of the layout of the tasks.", min=0, max=MAX_INDEX)
    ] = None,
) -> None:
    """Start a simulated robot, let prompts move it, and show what it did.

    Exits with 0 only when the arm did what was asked.
    """
    missing = next((name for name in NEEDED if find_spec(name) is None), None)
    if missing is not None:
        raise MissingExtraError(missing, EXTRAS)
    # Imported here: simulation, kinematics and plots take long to load.
    if prompt is not None and prompt.strip().lower().startswith(("hard", "hold")):
        from vla_zenoh.lab.cli.demo_run import run_demo

        run_demo(prompt, given.profile or DEFAULT_PROFILE, given)
        return
    from vla_zenoh.lab.cli.demo_tasks import run_task_demo
    from vla_zenoh.lab.tasks.task import FIRST_SEED

    prompts, first_seed = [prompt] if prompt else [], FIRST_SEED if seed is None else seed
    run_task_demo(prompts, first_seed, given.profile or TASK_PROFILE, given)
