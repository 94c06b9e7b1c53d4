"""vla-zenoh worker, and node: router, sim, arm, camera, command: one node until Ctrl-C."""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from vla_zenoh.cli.options import (
    DEFAULT_PROFILE,
    AlsoOption,
    DryRunOption,
    HostOption,
    ListenOption,
    ModelOptions,
    NodeOptions,
    ProfileOption,
    effective_profile,
    node_name,
    options,
)
from vla_zenoh.cli.plain import say
from vla_zenoh.keys import worker_node
from vla_zenoh.runtime.process import (
    RUN_FOLDER_VARIABLE,
    die_with_parent,
    run_node,
    stop_on_signals,
)

if TYPE_CHECKING:
    from vla_zenoh.policy.inference import Policy
    from vla_zenoh.profile import Profile
    from vla_zenoh.robots.driver import RobotDriver

# Each node is imported in its command: MuJoCo and Pinocchio take long to load.


def router(
    profile: ProfileOption = DEFAULT_PROFILE,
    listen: ListenOption = None,
    host: HostOption = None,
    also: AlsoOption = None,
    show_config: Annotated[
        bool, typer.Option("--config", help="Print its Zenoh configuration and exit.")
    ] = False,
) -> None:
    """Run the Zenoh router that connects all nodes of a lab."""
    from vla_zenoh.runtime.process import prefer_this_process, realtime_links
    from vla_zenoh.runtime.router import router_config, run_router

    loaded = effective_profile(profile, listen=listen, host=host)
    others = [effective_profile(name) for name in also or ()]
    if show_config:
        print(json.dumps(router_config(loaded, host=host, also=others), indent=2))
        return
    die_with_parent()
    prefer_this_process()
    with realtime_links():
        stop = stop_on_signals()
        print(f"routing, {loaded.name}", flush=True)
        run_router(loaded, stop, host=host, also=others)


def latch_file(profile: Profile, node: str) -> Path:
    """File that exists while a stop is latched in a node, beside the log of `up`."""
    from vla_zenoh.cli.up import default_log_folder

    folder = os.environ.get(RUN_FOLDER_VARIABLE) or default_log_folder()
    return Path(folder) / f"stopped-{profile.robot.name}-{node}"


def run_robot(
    node: NodeOptions, identity: str, make_driver: Callable[[Profile], RobotDriver]
) -> None:
    """Run the robot node of a driver, whose certificate is of `identity`."""
    from vla_zenoh.robots.node import RobotNode

    profile = node.load()
    latch = latch_file(profile, identity)
    run_node(
        profile,
        lambda session, stop: RobotNode(make_driver(profile), session, latch=latch).run(stop),
        identity=identity,
        preferred=True,
    )


@options
def sim(
    node: NodeOptions,
    lockstep: Annotated[
        bool, typer.Option("--lockstep", help="Advance time only on queries of the key sim/step.")
    ] = False,
) -> None:
    """Run the simulated robot: receives commands, publishes its state."""
    from vla_zenoh.robots.sim_driver import SimDriver

    run_robot(node, "sim", lambda profile: SimDriver(profile, lockstep=lockstep))


@options
def arm(node: NodeOptions) -> None:
    """Drive an arm with the class of an installed robot driver, or that of `arm.file`.

    A file with a PEP 723 header runs in an environment of its own; a robot of LeRobot does.
    """
    from vla_zenoh import plugins
    from vla_zenoh.policy.loader import find_model
    from vla_zenoh.robots.python_driver import PythonDriver, script_of
    from vla_zenoh.runtime.environments import run_in_own_environment

    profile = node.load()
    if (path := script_of(profile)) is not None:
        driver = plugins.installed(plugins.ROBOTS)[profile.robot.driver]
        packages = plugins.how_to_repeat(plugins.package_of(driver))
        script = find_model(str(path))
        run_in_own_environment(script, None, extra="control", packages=packages)

    run_robot(node, "arm", PythonDriver)


@options
def camera(
    node: NodeOptions,
    cameras: Annotated[
        list[str] | None, typer.Argument(help="Cameras of the profile; default: all.")
    ] = None,
    name: Annotated[
        str,
        typer.Option(
            "--name", parser=node_name, help="Node name; a second camera host needs another one."
        ),
    ] = "camera",
) -> None:
    """Publish images of cameras: V4L2 devices, RTSP streams, files and the simulator's."""
    from vla_zenoh.nodes.camera.node import CameraNode, choose_cameras

    profile = node.load()
    chosen = tuple(cameras) if cameras else None
    choose_cameras(profile, chosen)  # rejects a wrong one before a router is asked
    run_node(
        profile,
        lambda session, stop: CameraNode(profile, session, name=name, cameras=chosen).run(stop),
        identity=name,
    )


@options
def command(node: NodeOptions, dry_run: DryRunOption = False) -> None:
    """Run the command node: turns action chunks into a bounded, smooth command stream."""
    from vla_zenoh.nodes.command.node import CommandNode

    profile = node.load()
    latch = latch_file(profile, "command")
    run_node(
        profile,
        lambda session, stop: CommandNode(profile, session, dry_run=dry_run, latch=latch).run(stop),
        identity="command",
        preferred=True,
    )


@options
def worker(
    model: Annotated[
        str, typer.Argument(help="A worker of the profile, name of a model, or path to one.")
    ],
    node: NodeOptions,
    model_options: ModelOptions,
    name: Annotated[
        str | None,
        typer.Option(
            "--name", parser=node_name, help="Name in its keys; default: the model's name."
        ),
    ] = None,
    delay_ms: Annotated[
        float,
        typer.Option("--delay", min=0, max=60_000, help="Milliseconds added to every inference."),
    ] = 0.0,
    images: Annotated[
        Literal["raw", "jpeg"] | None,
        typer.Option(
            "--images",
            help="Which images to subscribe to; default: raw, where the cameras' node is on HOST.",
        ),
    ] = None,
    host: HostOption = None,
) -> None:
    """Run a model: observations in, action chunks out on its delta key."""
    from vla_zenoh.nodes.worker.node import WorkerNode
    from vla_zenoh.policy.loader import make_policy
    from vla_zenoh.runtime.environments import run_in_own_environment
    from vla_zenoh.runtime.starting import shown_as_crashed, shown_as_starting

    profile = effective_profile(node.profile, node.connect, host=host)
    chosen = model_options.choose(profile, model, name)
    # Returns only if this environment has what the model's header asks for.
    run_in_own_environment(chosen.model, model_options.python)
    own = None if host is None else profile.hosts.get(host)
    nearby = own is None or "camera" in own.nodes
    identity = worker_node(chosen.name)

    def another() -> Policy:
        return make_policy(chosen.model, chosen.options, profile=node.profile)

    with shown_as_crashed(profile, identity, host):
        with shown_as_starting(profile, identity, host):
            policy = another()
        if sys.stdout.isatty():
            say(f"worker {chosen.name} of robot {profile.robot.name} is running; Ctrl-C stops it")
        run_node(
            profile,
            lambda session, stop: WorkerNode(
                profile,
                session,
                policy,
                chosen.name,
                images=images or ("raw" if nearby else "jpeg"),
                host=host,
                delay_s=delay_ms / 1e3,
                robots=profile.serves.get(chosen.name, ()),
                another=another,
            ).run(stop),
            identity=identity,
        )
    os._exit(0)  # threads of a model's library may keep the process alive
