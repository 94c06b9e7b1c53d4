"""``vla-zenoh``: puts the commands together. One file a command, imported when it is called."""

from __future__ import annotations

import sys
from typing import NoReturn

import typer
import zenoh

from vla_zenoh import __version__
from vla_zenoh.cli.lazy_group import Part, commands_of
from vla_zenoh.errors import VlaZenohError, how_to_install

EXTRA_OF = {
    "pinocchio": "control",
    "ruckig": "control",
    "mujoco": "sim",
    "matplotlib": "sim",
    "av": "sim",
    "mcap": "record",
    "plotly": "record",
    "jinja2": "record",
    "rosbags": "record",
    "rerun": "view",
}
"""Modules of the extras, for whoever starts a node whose extra is not installed."""
NODES = frozenset({"up", "router", "sim", "ros2", "arm", "camera", "worker", "command"})
"""Commands whose output is a log: that of Zenoh belongs to it."""
RUN, DRIVE, LOOK = "Run", "Drive the robot", "Look"

PARTS = (
    Part(RUN, "demo", "lab.cli.demo:demo"),
    Part(RUN, "up", "cli.up:up"),
    Part(RUN, "router", "cli.router:router"),
    Part(RUN, "sim", "cli.sim:sim"),
    Part(RUN, "ros2", "cli.ros2:ros2_app"),
    Part(RUN, "arm", "cli.arm:arm"),
    Part(RUN, "camera", "cli.camera:camera"),
    Part(RUN, "worker", "cli.worker:worker"),
    Part(RUN, "command", "cli.command:command"),
    Part(RUN, "teleop", "lab.cli.teleop:teleop"),
    Part(DRIVE, "prompt", "cli.prompt:prompt"),
    Part(DRIVE, "activate", "cli.switches:activate"),
    Part(DRIVE, "deactivate", "cli.switches:deactivate"),
    Part(DRIVE, "use", "cli.switches:use"),
    Part(DRIVE, "rate", "cli.switches:rate"),
    Part(DRIVE, "speed", "cli.switches:speed"),
    Part(DRIVE, "stop", "cli.switches:stop"),
    Part(DRIVE, "reset", "cli.switches:reset"),
    Part(DRIVE, "trial", "lab.cli.trial:trial"),
    Part(LOOK, "view", "lab.cli.view:view"),
    Part(LOOK, "record", "lab.cli.record:record"),
    Part(LOOK, "replay", "lab.cli.replay:replay"),
    Part(LOOK, "eval", "lab.cli.evaluate:evaluation"),
    Part(LOOK, "status", "cli.status:status"),
    Part(LOOK, "echo", "cli.echo:echo"),
    Part(LOOK, "keys", "cli.keys:keys"),
    Part(LOOK, "seen", "cli.seen:seen"),
    Part(LOOK, "compare", "lab.cli.compare:compare"),
    Part(LOOK, "check", "lab.cli.check:check"),
    Part(LOOK, "net", "cli.net:net"),
    Part(LOOK, "doctor", "lab.cli.doctor:doctor"),
    Part(LOOK, "bench", "lab.cli.bench:bench_app"),
    Part(LOOK, "dataset", "lab.cli.dataset:dataset_app"),
    Part(LOOK, "profile", "cli.profile:profile_app"),
    Part(RUN, "serve", "cli.serve:serve_app"),
    Part(RUN, "secure", "cli.secure:secure_app"),
)

app = typer.Typer(
    name="vla-zenoh",
    cls=commands_of(PARTS),
    help="Connects vision-language-action models to robots over Zenoh.",
    no_args_is_help=True,
    rich_markup_mode="rich",
    pretty_exceptions_enable=False,
    add_completion=True,
)


def _version(wanted: bool) -> None:
    if wanted:
        print(f"vla-zenoh {__version__}")
        raise typer.Exit


@app.callback()
def _main(
    context: typer.Context,
    version: bool = typer.Option(
        False, "--version", callback=_version, is_eager=True, help="Print the version."
    ),
) -> None:
    # Zenoh logs to stdout, where the others write what a script reads.
    zenoh.init_log_from_env_or("error" if context.invoked_subcommand in NODES else "off")


def app_entry() -> None:
    """Run the command line. Our own errors become one clear line and exit code 1."""
    try:
        app()
    except VlaZenohError as error:
        _complain(str(error))
    except ImportError as error:
        extra = EXTRA_OF.get((error.name or "").partition(".")[0])
        if extra is None and ".so" not in str(error):
            raise
        _complain(
            f"{error}; install it with: {how_to_install(extra)}"
            if extra
            else f"{error}; `vla-zenoh doctor` names the system package"
        )
    except KeyboardInterrupt:
        sys.exit(130)


def _complain(message: str) -> NoReturn:
    from vla_zenoh.cli.output import complain

    complain(message)
    sys.exit(1)
