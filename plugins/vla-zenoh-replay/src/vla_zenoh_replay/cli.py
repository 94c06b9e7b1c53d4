"""vla-zenoh replay: a recorded run on its keys."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from vla_zenoh.cli.options import JsonOption, options
from vla_zenoh.cli.output import console, errors, fail
from vla_zenoh.cli.plain import warn
from vla_zenoh.cli.target import RobotTarget
from vla_zenoh.errors import counted
from vla_zenoh.lab.cli.output import print_json
from vla_zenoh.profile import Profile, as_robot
from vla_zenoh.runtime.process import run_node
from vla_zenoh.security.roles import Role
from vla_zenoh.security.store import Store


@options
def replay(
    file: Annotated[Path, typer.Argument(help="A file of `vla-zenoh record`.")],
    target: RobotTarget,
    speed: Annotated[
        float, typer.Option("--speed", help="2 is twice as fast.", min=0.01, max=100)
    ] = 1.0,
    loop: Annotated[bool, typer.Option("--loop", help="Start again at the end.")] = False,
    only: Annotated[
        list[str] | None,
        typer.Option("--only", help="Only this group: cameras, state, task, ...; repeatable."),
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Publish a recorded run again with its own timing, as the recorded robot or as --robot.

    Workers receive it as from the robot. All stamps are moved to now by the same amount. Rejected
    where a robot is alive on these keys, unless only images are replayed.
    """
    from vla_zenoh.lab.recording.reader import open_recording
    from vla_zenoh_replay.replay import Replay, ReplayResult, parse_groups

    groups = parse_groups(only or ())
    run_file = open_recording(file)
    loaded = as_robot(target.load(), target.robot or run_file.keys.robot)
    _require_replay_role(loaded)
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
            f"{replayed.samples.total():,} samples of {counted(len(replayed.samples), 'key')} in "
            f"{replayed.seconds:.1f} s"
            + (f", time between samples off by {error['p95']:.2f} ms (p95)" if error else "")
        )
    for node, count in replayed.left_out.items():
        errors().print(f"left out: {count} samples of node {node}, which is alive itself")
    if replayed.damage:
        warn(f"{file} is {replayed.damage}")
    if replayed.failure:
        fail(replayed.failure)


def _require_replay_role(profile: Profile) -> None:
    """The router would silently drop what this computer's certificate may not publish."""
    security = profile.session.security
    if security is None:
        return
    store = Store(security.folder)
    who = store.identity_files(security.host, None, security.people).certificate.stem
    if who == Role.REPLAY.value:
        return
    able = [host for host in store.hosts() if store.has(host, Role.REPLAY.value)]
    how = (
        f"--host {able[0]} has one that may"
        if able
        else f"`vla-zenoh secure add HOST --role {Role.REPLAY.value}` makes one that may, for a "
        "computer of its own"
    )
    fail(
        f"the certificate of this computer has the role {who}, which may not publish for other "
        f"nodes: {how}"
    )
