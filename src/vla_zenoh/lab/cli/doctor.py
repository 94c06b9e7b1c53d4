"""vla-zenoh doctor: what is missing on this host."""

from __future__ import annotations

import datetime as dt
import functools
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer
import zenoh
from rich.table import Table

from vla_zenoh.bus.host_id import HOST_VARIABLE
from vla_zenoh.bus.session import open_session
from vla_zenoh.cli.options import (
    PROFILE_VARIABLE,
    AlsoOption,
    effective_profile,
)
from vla_zenoh.cli.output import console, errors, print_json, styled
from vla_zenoh.errors import SecurityError, SessionError
from vla_zenoh.lab.doctor import HostFinding, Needs, examine, needs_of
from vla_zenoh.lab.doctor.access import AccessVerdict, access
from vla_zenoh.lab.doctor.access_check import check_access, read_access, try_identity
from vla_zenoh.lab.doctor.software import robot
from vla_zenoh.profile import Profile, SessionProfile

COLOURS = {"ok": "green", "warn": "yellow", "fail": "red"}


def try_zenoh(profile: SessionProfile, endpoint: str) -> str:
    """Opens a Zenoh session at `endpoint` and closes it; returns the reason if it cannot."""
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
            "--profile", "-p", envvar=PROFILE_VARIABLE, help="Look for what this profile needs."
        ),
    ] = None,
    host: Annotated[
        str | None, typer.Option("--host", help="Only what this host of the profile needs.")
    ] = None,
    as_json: Annotated[
        bool, typer.Option("--json", help="Print a list of objects instead of a table.")
    ] = False,
    rules: Annotated[
        Path | None,
        typer.Option(
            "--rules", help="Try the rules of access in this configuration of Zenoh instead."
        ),
    ] = None,
    also: AlsoOption = None,
) -> None:
    """Look at this computer: what is missing, and the package or setting that helps.

    Exits with 1 when something will not work, with 0 when all works or works only less well.
    """
    if host is not None and profile is None:
        raise typer.BadParameter("it is the name of a host in a profile: give --profile too")
    if also and profile is None:
        raise typer.BadParameter("--also names robots beside that of a profile: give --profile too")
    zenoh.init_log_from_env_or("off")
    needs, session, loaded = Needs(), SessionProfile(), None
    if profile is not None:
        # Whose certificates are looked at; a computer of people alone is no host of the profile.
        loaded = effective_profile(profile, host=host or os.environ.get(HOST_VARIABLE))
        needs, session = needs_of(loaded, host), loaded.session
    with errors().status("Looking at this computer"):
        findings = list(examine(needs, functools.partial(try_zenoh, session)))
        if loaded is not None:
            findings += robot(loaded, host)
            findings += access(
                loaded,
                dt.datetime.now(dt.UTC),
                functools.partial(_rehearse, loaded, rules, also or ()),
                functools.partial(try_identity, loaded),
            )
    if as_json:
        print_json(findings)
    else:
        show(findings)
    if any(finding.level == "fail" for finding in findings):
        raise typer.Exit(1)


def _rehearse(profile: Profile, rules: Path | None, also: Sequence[str]) -> list[AccessVerdict]:
    others = [effective_profile(name) for name in also]
    return check_access(profile, None if rules is None else read_access(rules), others)


def show(findings: list[HostFinding]) -> None:
    """Prints a table and how many findings want something done."""
    table = Table(show_lines=False, header_style="bold")
    table.add_column("what", no_wrap=True)
    table.add_column("", no_wrap=True)
    table.add_column("found and what to do", overflow="fold")
    for finding in findings:
        text = finding.found if not finding.advice else f"{finding.found}\n-> {finding.advice}"
        table.add_row(finding.name, styled(finding.level, COLOURS[finding.level]), text)
    out = console()
    out.print(table)
    fails = sum(finding.level == "fail" for finding in findings)
    warns = sum(finding.level == "warn" for finding in findings)
    out.print(f"{fails} will not work, {warns} could work better")
