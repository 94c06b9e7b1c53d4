"""vla-zenoh profile: list, show and check profiles; configure the bridge for one."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer
from rich.syntax import Syntax

from vla_zenoh.cli.bridge_config import bridge_config
from vla_zenoh.cli.options import HostOption, JsonOption
from vla_zenoh.cli.output import console, errors, fail, new_table, print_json, styled
from vla_zenoh.errors import MissingExtraError, ProfileError, RecordError, ResourceError
from vla_zenoh.profile import Profile, load_profile, profile_file, profile_names, to_yaml
from vla_zenoh.profile.advice import advice
from vla_zenoh.resources import shipped

profile_app = typer.Typer(help="List, show and check profiles.", no_args_is_help=True)
profile_app.command("bridge-config")(bridge_config)

LONG_BRAKE_S = 2.5
"""`up` ends a robot's node 2.8 s after Ctrl-C, less the time until the node gets the signal.
See `STOP_ORDER` in `vla_zenoh.runtime.supervisor`."""


@profile_app.command("list")
def list_profiles(as_json: JsonOption = False) -> None:
    """List your profiles on VLA_ZENOH_PATH, then the shipped ones."""
    rows = [_row(name) for name in profile_names()]
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


@profile_app.command("show")
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


@profile_app.command("check")
def check(
    names: Annotated[list[str], typer.Argument(help="Names or paths of profiles.", metavar="NAME")],
    host: HostOption = None,
) -> None:
    """Check profiles: every error with file and line, then advice.

    The robot's description must have the joints and links that a profile names. The host of the
    command node also needs the file and its meshes; --host names this host where there are several.
    Exits with 1 when a profile is invalid, with 0 when there is only advice.
    """
    wrong = False
    for name in names:
        try:
            profile = load_profile(name)
            hints = [*advice(profile), *_check_arm(profile, name, host), *_check_brake(profile)]
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


def _check_arm(profile: Profile, name: str, host: str | None) -> list[str]:
    """Build the arm as the command node does; advice where this host does not run that node.

    Raises:
        ProfileError: the description lacks what the profile names or cannot be read; or files are
            missing on the host of the command node.
    """
    needed = _runs_command(profile, name, host)
    try:
        from vla_zenoh.control.reachability import make_reachability_filter

        make_reachability_filter(profile)
    except ResourceError as error:
        if needed:
            raise ProfileError(f"{profile_file(name)}: robot.description: {error}") from error
        return [f"robot.description: {error}"]
    except MissingExtraError as error:
        return [f"robot.description: {error}"]
    except ImportError as error:
        return [f"robot: its joints and links were not checked: {error}"]
    except (ProfileError, RecordError) as error:
        raise ProfileError(f"{profile_file(name)}: robot: {error}") from error
    except ValueError as error:  # from Pinocchio, for a file that is no URDF
        what = f"{profile.robot.description!r} cannot be read: {error}"
        raise ProfileError(f"{profile_file(name)}: robot.description: {what}") from error
    return []


def _check_brake(profile: Profile) -> list[str]:
    """Advice where `up` would end the robot's node while it still brakes."""
    if profile.robot.driver == "sim":
        return []
    try:
        from vla_zenoh.guard.arm_guard import max_braking_time_s
    except ImportError:
        return []  # `_check_arm` has already said so
    brake_s = max_braking_time_s(profile)
    if brake_s <= LONG_BRAKE_S:
        return []
    return [
        f"limits: braking from full speed may take {brake_s:.1f} s, but `vla-zenoh up` ends the "
        "robot's node within 3 s of Ctrl-C: lower the velocity, or raise acceleration and jerk"
    ]


def _runs_command(profile: Profile, name: str, host: str | None) -> bool:
    """Whether this computer runs the command node, as far as its host is known.

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
