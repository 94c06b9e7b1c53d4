"""vla-zenoh doctor: what is missing on this computer."""

from __future__ import annotations

import functools
import os
from typing import Annotated

import typer
import zenoh
from rich.table import Table

from vla_zenoh import plugins
from vla_zenoh.bus.host import HOST_VARIABLE
from vla_zenoh.bus.session import open_session
from vla_zenoh.cli.options import (
    DEFAULT_PROFILE,
    PROFILE_VARIABLE,
    JsonOption,
    effective_profile,
)
from vla_zenoh.cli.output import console, fail, new_table, styled
from vla_zenoh.errors import SecurityError, SessionError
from vla_zenoh.lab.cli.output import print_json, progress
from vla_zenoh.lab.doctor import HostFinding, Needs, examine, needs_of
from vla_zenoh.lab.doctor.access import access
from vla_zenoh.lab.doctor.plugins import installed_plugins, robot_drivers
from vla_zenoh.lab.doctor.software import robot
from vla_zenoh.profile import SessionProfile


def robot_check(
    profile: Annotated[
        str, typer.Argument(help="Profile of the robot, by name or path.", metavar="NAME")
    ] = DEFAULT_PROFILE,
    as_json: JsonOption = False,
) -> None:
    """Connect to a robot, read it, and compare it with its profile. Moves nothing.

    For drivers that offer it, as franka and ur do: the robot's kinematics against the profile's
    description; of a Franka also joint ranges and limits against the profile's, and no other
    program may be connected to it. Exits with 1 if something is wrong.
    """
    loaded = effective_profile(profile)
    driver = loaded.robot.driver
    check = plugins.load(plugins.ROBOTS, driver).check_robot
    if check is None:
        robots = plugins.load_all(plugins.ROBOTS)
        able = ", ".join(name for name, robot in robots.items() if robot.check_robot)
        fail(
            f"profile {loaded.name} has robot.driver: {driver}; this checks {able or 'none'}; "
            f"`vla-zenoh profile check {loaded.name}` checks the others"
        )
    with progress("reading the robot"):
        findings = list(check(loaded, loaded.driver_options))
    report(findings, as_json=as_json)


COLOURS = {"ok": "green", "warn": "yellow", "fail": "red"}


def try_zenoh(profile: SessionProfile, endpoint: str) -> str:
    """Open and close a Zenoh session at `endpoint`; the reason why it fails, or empty."""
    try:
        open_session(profile, connect=(endpoint,)).close()
    except SessionError as error:
        return str(error.__cause__ or error).split(" at ", maxsplit=1)[0].rstrip("! ")
    except SecurityError as error:
        return str(error)
    return ""


def doctor(
    profile: Annotated[
        str | None,
        typer.Option(
            "--profile", "-p", envvar=PROFILE_VARIABLE, help="Check what this profile needs."
        ),
    ] = None,
    host: Annotated[
        str | None, typer.Option("--host", help="Only what this host of the profile needs.")
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Check this computer: what is missing, and the package or setting that helps.

    Exits with 1 if something will not work, with 0 if there are only warnings.
    """
    if host is not None and profile is None:
        raise typer.BadParameter("--host names a host of a profile: give --profile too")
    zenoh.init_log_from_env_or("off")
    needs, session, loaded = Needs(), SessionProfile(), None
    if profile is not None:
        # The host of the certificates; a computer without nodes is no host of the profile.
        loaded = effective_profile(profile, host=host or os.environ.get(HOST_VARIABLE))
        needs, session = needs_of(loaded, host), loaded.session
    with progress("checking this computer"):
        findings = list(examine(needs, functools.partial(try_zenoh, session)))
        findings += installed_plugins()
        if loaded is not None:
            findings += robot(loaded, host)
            findings += robot_drivers(loaded, host)
            findings += access(loaded)
    report(findings, as_json=as_json)


def report(findings: list[HostFinding], *, as_json: bool) -> None:
    """Print findings, as JSON or as a table with their counts.

    Raises:
        typer.Exit: something will not work.
    """
    fails, warns = (sum(each.level == level for each in findings) for level in ("fail", "warn"))
    if as_json:
        print_json(findings)
    else:
        console().print(_table(findings))
        console().print(f"{fails} will not work, {warns} could work better")
    if fails:
        raise typer.Exit(1)


def _table(findings: list[HostFinding]) -> Table:
    table = new_table("what", "", "found and what to do")
    for column in table.columns[:2]:
        column.no_wrap = True
    for finding in findings:
        text = finding.found if not finding.advice else f"{finding.found}\n-> {finding.advice}"
        table.add_row(finding.name, styled(finding.level, COLOURS[finding.level]), text)
    return table
