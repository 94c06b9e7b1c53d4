"""vla-zenoh profile: the profiles there are, what one comes to, and whether it is right."""

from __future__ import annotations

from typing import Annotated, Any

import typer
from rich.syntax import Syntax
from rich.table import Table

from vla_zenoh.cli.options import HostOption
from vla_zenoh.cli.output import console, errors, fail, print_json, styled
from vla_zenoh.errors import MissingExtraError, ProfileError, RecordError, ResourceError
from vla_zenoh.profile import Profile, load_profile, profile_file, profile_names, to_yaml
from vla_zenoh.profile.advice import advice

profile_app = typer.Typer(
    help="Profiles: what there is, what one comes to, and whether it is right.",
    no_args_is_help=True,
)

LONG_BRAKE_S = 2.5
"""`up` ends a robot's node 2.8 s after Ctrl-C; a part of that goes by until this node hears of it.
See `STOP_ORDER` in `vla_zenoh.runtime.supervisor`."""

JsonOption = Annotated[bool, typer.Option("--json", help="Print JSON for a script.")]


@profile_app.command("list")
def list_profiles(as_json: JsonOption = False) -> None:
    """List the profiles that can be found: your own of VLA_ZENOH_PATH, then the shipped ones."""
    rows = [_row(name) for name in profile_names()]
    if as_json:
        print_json(rows)
        return
    table = Table(header_style="bold")
    for column in ("name", "about", "robot", "driver", "hosts", "file"):
        table.add_column(column, no_wrap=column == "name", overflow="fold")
    for row in rows:
        if "fault" in row:
            wrong = styled(row["fault"], "red")
            table.add_row(row["name"], wrong, "", "", "", row["file"])
        else:
            told = ("name", "about", "robot", "driver")
            cells = [*(row[key] for key in told), ", ".join(row["hosts"]), row["file"]]
            table.add_row(*cells)
    console().print(table)


@profile_app.command("show")
def show(
    name: Annotated[str, typer.Argument(help="Name or path of a profile.")],
    as_json: JsonOption = False,
) -> None:
    """Print a profile as it is in force, with what it extends and every default written out."""
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


@profile_app.command("check")
def check(
    names: Annotated[list[str], typer.Argument(help="Names or paths of profiles.", metavar="NAME")],
    host: HostOption = None,
) -> None:
    """Check profiles: every fault with file and line, then what is worth a second look.

    The robot's description has to have the joints and links that a profile names. On the host that
    runs the command node it has to be there with its meshes: say which host this is with --host,
    where there are several. Exits with 1 when a profile is wrong; advice leaves the exit code at 0.
    """
    wrong = False
    for name in names:
        try:
            profile = load_profile(name)
            hints = [*advice(profile), *_arm(profile, name, host), *_brake(profile)]
        except ProfileError as error:
            wrong = True
            for line in str(error).splitlines():
                errors().print(line, style="red", soft_wrap=True)
            continue
        console().print(styled("ok", "green"), name, soft_wrap=True)
        for line in dict.fromkeys(hints):
            errors().print(styled("advice", "yellow"), line, soft_wrap=True)
    if wrong:
        raise typer.Exit(1)


def _arm(profile: Profile, name: str, host: str | None) -> list[str]:
    """Builds the arm as the command node does; gives advice where this computer need not.

    Raises:
        ProfileError: its description does not have what the profile names, or cannot be read; or
            it is not here, nor are its meshes, and the command node is to run here.
    """
    commands = _runs_command(profile, name, host)
    try:
        from vla_zenoh.control.reachability import make_reachability_filter

        make_reachability_filter(profile)
    except ResourceError as error:
        if commands:
            raise ProfileError(f"{profile_file(name)}: robot.description: {error}") from error
        return [f"robot.description: {error}"]
    except MissingExtraError as error:
        return [f"robot.description: {error}"]
    except ImportError as error:
        return [f"robot: its joints and links were not looked at: {error}"]
    except (ProfileError, RecordError) as error:
        raise ProfileError(f"{profile_file(name)}: robot: {error}") from error
    except ValueError as error:  # Pinocchio's, of a file that is no URDF
        what = f"{profile.robot.description!r} cannot be read: {error}"
        raise ProfileError(f"{profile_file(name)}: robot.description: {what}") from error
    return []


def _brake(profile: Profile) -> list[str]:
    """Where `up` would end the robot's node while that still brakes."""
    if profile.robot.driver == "sim":
        return []
    try:
        from vla_zenoh.guard.arm_guard import max_braking_time_s
    except ImportError:
        return []  # the arm was not looked at either, which is told
    brake_s = max_braking_time_s(profile)
    if brake_s <= LONG_BRAKE_S:
        return []
    return [
        f"limits: a brake from full speed may take {brake_s:.1f} s, and `vla-zenoh up` ends the "
        "robot's node within 3 s of Ctrl-C, braked or not: less velocity, or more acceleration and "
        "jerk"
    ]


def _runs_command(profile: Profile, name: str, host: str | None) -> bool:
    """Whether this computer does, as far as is known which host it is.

    Raises:
        ProfileError: the profile has no such host.
    """
    if host is None:
        host = next(iter(profile.hosts)) if len(profile.hosts) == 1 else None
    if host is None:
        return False
    if host not in profile.hosts:
        known = ", ".join(profile.hosts)
        raise ProfileError(f"{profile_file(name)}: hosts: has no {host!r}, it has: {known}")
    return "command" in profile.hosts[host].nodes


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
