"""vla-zenoh profile new: a profile for an arm from its description."""

from __future__ import annotations

import os
import re
import shutil
import sys
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer

from vla_zenoh.cli.options import JsonOption, model_options, options
from vla_zenoh.cli.output import console, errors, fail, styled
from vla_zenoh.errors import OutputError, VlaZenohError
from vla_zenoh.lab.cli.output import print_json
from vla_zenoh.lab.cli.output_path import ForceOption, output_file
from vla_zenoh.lab.profile.check import check_profile
from vla_zenoh.resources import PACKAGED, robot_urdf
from vla_zenoh_newarm.answers import Answers
from vla_zenoh_newarm.arm import Arm, found_arm, meshes_of
from vla_zenoh_newarm.picture import picture
from vla_zenoh_newarm.profile_text import profile_text


@dataclass(frozen=True)
class Given:
    """What a person knows better than a guess."""

    base: Annotated[
        str | None, typer.Option("--base", help="Link in which poses are; default: the root.")
    ] = None
    tcp: Annotated[
        str | None, typer.Option("--tcp", help="Link that is controlled; default: the outermost.")
    ] = None
    home: Annotated[
        str | None, typer.Option("--home", help="Joint positions at home, as 0,-1.2,1.5,0.")
    ] = None
    workspace: Annotated[
        str | None,
        typer.Option("--workspace", help="Box of the TCP in m, as x0,x1,y0,y1,z0,z1."),
    ] = None
    table: Annotated[
        str | None,
        typer.Option("--table", help="Height of the table in the base frame in m, or none."),
    ] = None
    acceleration: Annotated[
        str | None,
        typer.Option("--acceleration", help="Of the joints: rad/s^2 (m/s^2), one or one each."),
    ] = None
    jerk: Annotated[
        str | None, typer.Option("--jerk", help="Of the joints: rad/s^3 (m/s^3), one or one each.")
    ] = None
    gripper: Annotated[
        str | None,
        typer.Option(
            "--gripper",
            help="Its width in m; of a finger joint that turns also its positions when open and "
            "shut, as 0.085,0,0.8; or none.",
        ),
    ] = None


@options
def new(
    description: Annotated[
        str, typer.Argument(help="URDF, xacro or MJCF of the arm, or example-robot-data:PATH.")
    ],
    given: Given,
    output: Annotated[
        Path | None, typer.Option("--output", "-o", help="The profile; default: NAME.yaml here.")
    ] = None,
    settings: Annotated[
        list[str] | None,
        typer.Option("--set", help="Argument of a xacro as name=value; repeatable."),
    ] = None,
    drawn: Annotated[
        Path | None,
        typer.Option(
            "--picture",
            help="SVG of the arm at home, its frames and its workspace, to compare with guesses.",
        ),
    ] = None,
    yes: Annotated[
        bool, typer.Option("--yes", "-y", help="Ask nothing: every guess is taken.")
    ] = False,
    force: ForceOption = False,
    as_json: JsonOption = False,
) -> None:
    """Write a profile for an arm from its description, and check it.

    What the description does not say is guessed: an option answers it, on a terminal a question
    does. Guesses are listed in the profile under `unconfirmed`; the simulated arm works with them,
    a real one is not activated before they are gone.
    """
    source = robot_urdf(description)
    name = _name(output or source)
    file = output or Path(f"{name}.yaml")
    copy = file.with_name(f"{file.stem}_mended.urdf")
    with ExitStack() as outputs:
        part, *sketch = (
            outputs.enter_context(output_file(each, force=force, inputs=[source]))
            for each in (file, drawn)
            if each is not None
        )
        for made in (copy, meshes_of(copy)):
            if made.exists() and not force:
                raise OutputError(f"{made} exists; give another --output, or --force to replace it")
        shutil.rmtree(meshes_of(copy), ignore_errors=True)
        answers = Answers(vars(given), ask=sys.stdin.isatty() and not yes)
        try:
            arm = found_arm(source, copy, model_options(settings or []), answers)
        except VlaZenohError:
            copy.unlink(missing_ok=True)
            shutil.rmtree(meshes_of(copy), ignore_errors=True)
            raise
        named = description if arm.file == source and _is_named(description) else ""
        path = named or os.path.relpath(arm.file.resolve(), file.resolve().parent)
        text = profile_text(name, description, path, arm)
        part.write_text(text, "utf-8")
        for each in sketch:
            each.write_text(picture(name, arm), "utf-8")
    _report(file, arm, as_json)


def _name(file: Path) -> str:
    """A name for a robot after its file."""
    words = re.sub(r"[^a-z0-9_]+", "_", file.name.partition(".")[0].lower())
    return words.strip("_") or "arm"


def _is_named(description: str) -> bool:
    return description.startswith(PACKAGED)


def _report(file: Path, arm: Arm, as_json: bool) -> None:
    report = check_profile(str(file))
    for line in report.errors:
        errors().print(styled(line, "red"), soft_wrap=True)
    if report.errors:
        fail(f"{file} was written and does not pass `vla-zenoh profile check`: correct it")
    if as_json:
        guesses = {guess.place: guess.what for guess in arm.guesses}
        print_json({"file": str(file), "changes": list(arm.changes), "guesses": guesses})
        return
    out = console()
    out.print(styled("ok", "green"), str(file), soft_wrap=True)
    for line in arm.changes:
        out.print(line, soft_wrap=True)
    for guess in arm.guesses:
        out.print(styled("guess", "yellow"), f"{guess.place}: {guess.what}", soft_wrap=True)
    out.print(f"simulate it: vla-zenoh up {file} --sim", soft_wrap=True)
