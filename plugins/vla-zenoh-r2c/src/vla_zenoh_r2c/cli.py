"""vla-zenoh serve r2c: a model of ours for a robot that speaks R2C."""

from __future__ import annotations

import logging
import os
from typing import Annotated

import typer

from vla_zenoh.cli.options import (
    DEFAULT_PROFILE,
    ConnectOption,
    ModelOptions,
    ProfileOption,
    effective_profile,
    options,
)
from vla_zenoh.cli.output import console
from vla_zenoh.plugins import how_to_repeat
from vla_zenoh.policy.loader import make_policy
from vla_zenoh.runtime.environments import run_in_own_environment
from vla_zenoh.runtime.process import stop_on_signals


@options
def serve(
    worker: Annotated[
        str,
        typer.Option(
            "--worker", "-w", help="A worker of the profile, name of a model, or path to one."
        ),
    ],
    robot: Annotated[
        str, typer.Option("--robot", "-r", help="File that declares what its numbers mean.")
    ],
    model: ModelOptions,
    profile: ProfileOption = DEFAULT_PROFILE,
    connect: ConnectOption = None,
) -> None:
    """Answer a robot that speaks R2C with a model of ours.

    The profile has the robot's kinematics and limits, and the address of the router.
    """
    loaded = effective_profile(profile, connect)
    from vla_zenoh_r2c.declared import read_robot

    declared = read_robot(robot)
    chosen = model.choose(loaded, worker)
    ours = how_to_repeat("vla-zenoh-r2c")
    run_in_own_environment(chosen.model, model.python, extra="control", packages=ours)
    from vla_zenoh_r2c import link
    from vla_zenoh_r2c.answer import Answers
    from vla_zenoh_r2c.gateway import Gateway

    policy = make_policy(chosen.model, chosen.options, profile=profile)
    answers = Answers(policy, declared, loaded)
    logging.basicConfig(level=logging.WARNING, format="%(message)s")
    getattr(policy, "load", lambda: None)()
    stop = stop_on_signals()
    session = link.connected(loaded)
    gateway = Gateway(session, declared, answers)
    where = f"{declared.project}/{declared.device}"
    console().print(f"{chosen.name} for the R2C robot {where}", highlight=False)
    gateway.run(stop)
    told = ", ".join(f"{reason} {count}" for reason, count in sorted(gateway.counts.items()))
    console().print(told or "nothing was asked", highlight=False)
    session.close()
    os._exit(0)  # threads of a model's library may keep the process alive
