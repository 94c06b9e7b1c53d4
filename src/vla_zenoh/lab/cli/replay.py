"""vla-zenoh replay."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from vla_zenoh.cli.options import (
    DEFAULT_PROFILE,
    ConnectOption,
    HostOption,
    JsonOption,
    ProfileOption,
)
from vla_zenoh.cli.output import console, errors, fail, print_json
from vla_zenoh.cli.target import RobotTarget
from vla_zenoh.profile import Profile, as_robot
from vla_zenoh.runtime.process import run_node
from vla_zenoh.security.identity import Role
from vla_zenoh.security.store import Store


def replay(
    file: Annotated[Path, typer.Argument(help="A file of `vla-zenoh record`.")],
    speed: Annotated[
        float, typer.Option("--speed", help="2 is twice as fast.", min=0.01, max=100)
    ] = 1.0,
    loop: Annotated[bool, typer.Option("--loop", help="Begin anew at the end.")] = False,
    robot: Annotated[
        str | None, typer.Option("--as", help="Robot to replay it as; its own without it.")
    ] = None,
    only: Annotated[
        list[str] | None,
        typer.Option(
            "--only", help="cameras, state, task, ...: only this; may be given more than once."
        ),
    ] = None,
    profile: ProfileOption = DEFAULT_PROFILE,
    connect: ConnectOption = None,
    host: HostOption = None,
    as_json: JsonOption = False,
) -> None:
    """Put a recorded run on keys again, with its own timing.

    A worker hears it as it would hear the robot. Stamps are moved to now, all by the same amount.
    Refused where a robot lives on these keys, unless only pictures are replayed.
    """
    from vla_zenoh.lab.recording.reader import open_recording
    from vla_zenoh.lab.recording.replay import Replay, ReplayResult, parse_groups

    groups = parse_groups(only or ())
    run_file = open_recording(file)
    loaded = RobotTarget(profile, connect, host).load()
    loaded = as_robot(loaded, robot or run_file.keys.robot)
    _refuse_without_the_right(loaded)
    done: list[ReplayResult] = []

    def run(session, stop) -> None:  # pyright: ignore  # as run_node gives them
        node = Replay(loaded, session, run_file, groups=groups, speed=speed, loop=loop)
        errors().print(f"replaying {file} as robot {loaded.robot.name}; Ctrl-C ends it")
        done.append(node.run(stop))

    run_node(loaded, run, identity=None)
    if not done:  # interrupted before it began
        raise typer.Exit(130)
    replayed = done[0]
    if as_json:
        print_json(replayed)
    else:
        error = replayed.interval_error_ms
        console().print(
            f"{replayed.samples.total():,} samples of {len(replayed.samples)} keys in "
            f"{replayed.seconds:.1f} s"
            + (f", time between samples off by {error['p95']:.2f} ms (p95)" if error else "")
        )
    for node, count in replayed.left_out.items():
        errors().print(f"left out: {count} samples of node {node}, which is alive itself")
    if replayed.damage:
        errors().print(f"{file} is {replayed.damage}", style="yellow")
    if replayed.failure:
        fail(replayed.failure)


def _refuse_without_the_right(profile: Profile) -> None:
    """The router would drop what this computer's people may not say, and tell nobody."""
    security = profile.session.security
    if security is None:
        return
    store = Store(security.folder)
    who = store.identity_files(security.host, None, security.people).certificate.stem
    if who == Role.REPLAY.value:
        return
    able = [host for host in store.hosts() if store.has(host, Role.REPLAY.value)]
    how = (
        f"--host {able[0]} is one that may, and lies here"
        if able
        else f"`vla-zenoh secure add HOST --role {Role.REPLAY.value}` makes one that may, for a "
        "computer of its own"
    )
    fail(
        f"this computer has the certificate of the role {who}, which may not play the part of "
        f"others: {how}"
    )
