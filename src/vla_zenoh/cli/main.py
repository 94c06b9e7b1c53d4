"""``vla-zenoh``: puts the commands together. One file a command, imported when it is called."""

from __future__ import annotations

import sys
from typing import NoReturn

import typer
import zenoh

from vla_zenoh import __version__
from vla_zenoh.cli.lazy import Part, commands_of
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
    Part(RUN, "demo", "demo:demo"),
    Part(RUN, "up", "up:up"),
    Part(RUN, "router", "router:router"),
    Part(RUN, "sim", "sim:sim"),
    Part(RUN, "ros2", "ros2:ros2_app"),
    Part(RUN, "arm", "arm:arm"),
    Part(RUN, "camera", "camera:camera"),
    Part(RUN, "worker", "worker:worker"),
    Part(RUN, "command", "command:command"),
    Part(RUN, "teleop", "teleop:teleop"),
    Part(DRIVE, "prompt", "set_prompt:prompt"),
    Part(DRIVE, "activate", "switches:activate"),
    Part(DRIVE, "deactivate", "switches:deactivate"),
    Part(DRIVE, "use", "switches:use"),
    Part(DRIVE, "rate", "switches:rate"),
    Part(DRIVE, "speed", "switches:speed"),
    Part(DRIVE, "stop", "switches:stop"),
    Part(DRIVE, "reset", "switches:reset"),
    Part(DRIVE, "trial", "trial:trial"),
    Part(LOOK, "view", "view:view"),
    Part(LOOK, "record", "record:record"),
    Part(LOOK, "replay", "replay:replay"),
    Part(LOOK, "eval", "evaluate:evaluation"),
    Part(LOOK, "status", "status:status"),
    Part(LOOK, "echo", "echo:echo"),
    Part(LOOK, "keys", "keys:keys"),
    Part(LOOK, "seen", "seen:seen"),
    Part(LOOK, "compare", "compare:compare"),
    Part(LOOK, "check", "check:check"),
    Part(LOOK, "net", "net:net"),
    Part(LOOK, "doctor", "doctor:doctor"),
    Part(LOOK, "bench", "bench:bench_app"),
    Part(LOOK, "dataset", "dataset:dataset_app"),
    Part(LOOK, "profile", "profile:profile_app"),
    Part(RUN, "serve", "serve:serve_app"),
    Part(RUN, "secure", "secure:secure_app"),
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
