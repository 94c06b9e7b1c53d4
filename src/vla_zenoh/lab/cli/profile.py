"""vla-zenoh profile: list, show and check profiles."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.syntax import Syntax

from vla_zenoh.cli.options import (
    PROFILE_VARIABLE,
    ConnectOption,
    HostOption,
    JsonOption,
    ListenOption,
    SimOption,
)
from vla_zenoh.cli.output import console, errors, fail, new_table, styled
from vla_zenoh.errors import ProfileError
from vla_zenoh.lab.cli.output import print_json
from vla_zenoh.lab.profile.check import check_profile
from vla_zenoh.profile import load_profile, profile_file, to_yaml
from vla_zenoh.resources import names, shipped


def list_profiles(as_json: JsonOption = False) -> None:
    """List your profiles on VLA_ZENOH_PATH, then the shipped ones."""
    rows = [_row(name) for name in names("profiles")]
    if as_json:
        print_json(rows)
        return
    table = new_table("name", "about", "robot", "driver", "hosts", "file")
    table.columns[0].no_wrap = True
    for row in rows:
        inside = Path(row["file"]).is_relative_to(shipped("profiles"))
        file = "shipped" if inside else row["file"]
        if "fault" in row:
            wrong = styled(row["fault"], "red")
            table.add_row(row["name"], wrong, "", "", "", row["file"])
        else:
            cells = [row[key] for key in ("name", "about", "robot", "driver")]
            table.add_row(*cells, ", ".join(row["hosts"]), file)
    console().print(table)


def show(
    name: Annotated[str, typer.Argument(help="Name or path of a profile.")],
    as_json: JsonOption = False,
) -> None:
    """Print the effective profile, with what it extends and every default."""
    try:
        profile = load_profile(name)
    except ProfileError as error:
        fail(str(error))
    if as_json:
        print_json(profile)
        return
    text, out = to_yaml(profile), console()
    if out.is_terminal:
        out.print(Syntax(text.rstrip("\n"), "yaml", background_color="default", word_wrap=True))
    else:
        print(text, end="")


def check(
    names: Annotated[
        list[str] | None,
        typer.Argument(
            help=f"Names or paths of profiles; default: {PROFILE_VARIABLE}.", metavar="NAME"
        ),
    ] = None,
    host: HostOption = None,
    connect: ConnectOption = None,
    listen: ListenOption = None,
    sim: SimOption = False,
    as_json: JsonOption = False,
) -> None:
    """Check profiles: everything that `up` would fail with, with file and line; then advice.

    Models are made as a worker makes them, but no weights are loaded, and nothing is connected.
    What only one host needs (files, meshes, packages) is an error on that host, which --host names
    if there are several, and advice elsewhere. Exits with 1 when a profile cannot run.
    """
    names = names or list(filter(None, [os.environ.get(PROFILE_VARIABLE)]))
    if not names:
        raise typer.BadParameter(f"give NAME, a profile, or set {PROFILE_VARIABLE}")
    reports = {name: check_profile(name, host, connect, listen, sim=sim) for name in names}
    if as_json:
        print_json({name: report._asdict() for name, report in reports.items()})
    for name, report in ({} if as_json else reports).items():
        for line in report.errors:
            errors().print(line, style="red", soft_wrap=True)
        if report.errors:
            continue
        bare = "" if load_profile(name).robot.gripper else ": no gripper"
        console().print(styled("ok", "green"), f"{name}{bare}", soft_wrap=True)
        for line in report.advice:
            errors().print(styled("advice", "yellow"), line, soft_wrap=True)
    if any(report.errors for report in reports.values()):
        raise typer.Exit(1)


def _row(name: str) -> dict[str, Any]:
    file = str(profile_file(name))
    try:
        profile = load_profile(name)
    except ProfileError as error:
        return {"name": name, "file": file, "fault": str(error)}
    return {
        "name": name,
        "about": profile.about,
        "robot": profile.robot.name,
        "driver": profile.robot.driver,
        "hosts": list(profile.hosts),
        "file": file,
    }
