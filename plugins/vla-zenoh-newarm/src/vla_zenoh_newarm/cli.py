"""vla-zenoh profile new: a profile for an arm from its description."""

from __future__ import annotations

import os
import re
import shutil
import sys
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from vla_zenoh.cli.options import JsonOption, model_options, options
from vla_zenoh.cli.output import console, errors, fail, styled
from vla_zenoh.errors import OutputError, ProfileError, VlaZenohError
from vla_zenoh.lab.cli.output import print_json, progress
from vla_zenoh.lab.cli.output_path import ForceOption, output_file
from vla_zenoh.lab.profile.check import check_profile
from vla_zenoh.resources import PACKAGED, robot_urdf
from vla_zenoh_newarm.answers import Answers
from vla_zenoh_newarm.arm import Arm, found_arm, meshes_of
from vla_zenoh_newarm.picture import picture
from vla_zenoh_newarm.profile_text import Drive, profile_text
from vla_zenoh_newarm.running import (
    Running,
    absent_packages,
    driven,
    home_of,
    look,
    robot_name,
)

if TYPE_CHECKING:
    from vla_zenoh_ros2.survey import Survey


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
    command: Annotated[
        str | None,
        typer.Option("--command", help="With --ros2: the topic that commands the arm."),
    ] = None


@options
def new(
    given: Given,
    running: Running,
    description: Annotated[
        str | None,
        typer.Argument(help="URDF, xacro or MJCF of the arm, or example-robot-data:PATH."),
    ] = None,
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
    """Write a profile for an arm from its description or from a running robot, and check it.

    What the description does not say is guessed: an option answers it, on a terminal a question
    does. Guesses are listed in the profile under `unconfirmed`; the simulated arm works with them,
    a real one is not activated before they are gone.
    """
    if output is not None and output.exists() and not force:  # before looking takes its time
        raise OutputError(f"{output} exists; give another --output, or --force to replace it")
    found = _look(running, given, describe=description is None)
    if found is None and description is None:
        raise typer.BadParameter("give the DESCRIPTION of the arm, or --ros2")
    source = Path() if description is None else robot_urdf(description)
    name = _name(output or source)
    if description is None and output is None and found is not None:
        name = _name(Path(robot_name(found.description)))
    file = output or Path(f"{name}.yaml")
    copy = file.with_name(f"{file.stem}_mended.urdf")
    texts = [copy]
    if description is None:
        source = file.with_suffix(".urdf")
        texts.append(source)
    with ExitStack() as outputs:
        part, *sketch = (
            outputs.enter_context(output_file(each, force=force, inputs=[source]))
            for each in (file, drawn)
            if each is not None
        )
        for each in (*texts, meshes_of(copy)):
            if each.exists() and not force:
                raise OutputError(f"{each} exists; give another --output, or --force to replace it")
        shutil.rmtree(meshes_of(copy), ignore_errors=True)
        answers = Answers(vars(given), ask=sys.stdin.isatty() and not yes)
        try:
            if description is None and found is not None:
                source.write_text(found.description, "utf-8")
            arm = found_arm(source, copy, model_options(settings or []), answers)
            drive, notes = Drive(), list[str]()
            if found is not None:
                drive, notes = driven(found, arm, answers, running.connect)
                notes = [*_described(found, source, arm), *notes]
        except VlaZenohError as error:
            for each in texts:
                each.unlink(missing_ok=True)
            shutil.rmtree(meshes_of(copy), ignore_errors=True)
            if copy.name in str(error):  # which nobody has seen
                raise ProfileError(str(error).replace(copy.name, source.name)) from error
            raise
        named = description if arm.file == source and _is_named(description or "") else ""
        path = named or os.path.relpath(arm.file.resolve(), file.resolve().parent)
        text = profile_text(name, description or "--ros2", path, arm, drive)
        part.write_text(text, "utf-8")
        for each in sketch:
            each.write_text(picture(name, arm), "utf-8")
    _report(file, arm, drive, notes, as_json)


def _look(running: Running, given: Given, *, describe: bool) -> Survey | None:
    """What is found of a running robot; None: it is not asked for."""
    if running.ros2:
        with progress("looking for a ROS 2 robot") as status:

            def tell(doing: str) -> None:
                status.update(styled(doing, ""))

            return look(running, given.command, tell, describe=describe)
    only = {"--namespace": running.namespace, "--domain": running.domain}
    only |= {"--command": given.command}
    for option, value in only.items():
        if value is not None:
            raise typer.BadParameter(f"{option} goes with --ros2")
    return None


def _described(found: Survey, source: Path, arm: Arm) -> list[str]:
    """Sentences about a description that came from a robot."""
    lines = [
        f"found: {found.domain.way}" + f", namespace {found.namespace}" * bool(found.namespace)
    ]
    if found.description:
        lines.append(f"description: {found.described_by}, in {source}")
    if absent := absent_packages(source):
        lines.append(
            f"meshes of the package(s) {', '.join(absent)} are not on this computer: for their "
            f"shapes copy each folder beside {source} (ros2 pkg prefix --share NAME), and do this "
            "again with --force"
        )
    if home := home_of(found, arm.structure.arm):
        lines.append(f"home where it stands now: {home}")
    return lines


def _name(file: Path) -> str:
    """A name for a robot after its file."""
    words = re.sub(r"[^a-z0-9_]+", "_", file.name.partition(".")[0].lower())
    return words.strip("_") or "arm"


def _is_named(description: str) -> bool:
    return description.startswith(PACKAGED)


def _report(file: Path, arm: Arm, drive: Drive, notes: list[str], as_json: bool) -> None:
    report = check_profile(str(file))
    for line in report.errors:
        errors().print(styled(line, "red"), soft_wrap=True)
    if report.errors:
        fail(f"{file} was written and does not pass `vla-zenoh profile check`: correct it")
    if as_json:
        guesses = {guess.place: guess.what for guess in arm.guesses}
        told = {"file": str(file), "changes": list(arm.changes), "guesses": guesses}
        print_json(told | ({"notes": notes} if notes else {}))
        return
    out = console()
    out.print(styled("ok", "green"), str(file), soft_wrap=True)
    for line in (*notes, *arm.changes):
        out.print(line, soft_wrap=True)
    for guess in arm.guesses:
        out.print(styled("guess", "yellow"), f"{guess.place}: {guess.what}", soft_wrap=True)
    out.print(f"simulate it: vla-zenoh up {file} --sim", soft_wrap=True)
    if drive.ros2:
        begin = f"vla-zenoh up {file} --dry-run, then without --dry-run"
        out.print(f"drive it, once nothing is unconfirmed: {begin}", soft_wrap=True)
