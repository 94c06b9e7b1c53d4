"""vla-zenoh robot check: connect to a robot, read it, and compare it with its profile."""

from __future__ import annotations

from typing import Annotated

import typer

from vla_zenoh.cli.options import DEFAULT_PROFILE, JsonOption, effective_profile
from vla_zenoh.cli.output import fail
from vla_zenoh.lab.cli.doctor import report
from vla_zenoh.lab.cli.output import progress
from vla_zenoh.lab.doctor.fci import fci_arm
from vla_zenoh.lab.doctor.ur import ur_arm


def robot_check(
    profile: Annotated[
        str, typer.Argument(help="Profile of the robot, by name or path.", metavar="NAME")
    ] = DEFAULT_PROFILE,
    as_json: JsonOption = False,
) -> None:
    """Connect to a Franka or UR arm, read it, and compare it with its profile. Moves nothing.

    Its kinematics against the profile's description; of a Franka also joint ranges and limits
    against the profile's, and no other program may be connected to it. Exits with 1 if something is
    wrong.
    """
    loaded = effective_profile(profile)
    check = {"franka": fci_arm, "ur": ur_arm}.get(loaded.robot.driver)
    if check is None:
        driver = loaded.robot.driver
        fail(f"profile {loaded.name} has robot.driver: {driver}; this checks franka and ur")
    with progress("reading the robot"):
        findings = list(check(loaded))
    report(findings, as_json=as_json)
