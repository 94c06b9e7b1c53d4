"""``vla-zenoh``: puts the commands together. One file a command."""

from __future__ import annotations

import sys
from typing import NoReturn

import typer
import zenoh
from rich.text import Text

from vla_zenoh import __version__
from vla_zenoh.cli import (
    bench,
    camera,
    check,
    command,
    compare,
    dataset,
    demo,
    doctor,
    echo,
    evaluate,
    keys,
    net,
    profile,
    record,
    replay,
    ros2,
    router,
    secure,
    seen,
    serve,
    set_prompt,
    sim,
    status,
    switches,
    teleop,
    up,
    view,
    worker,
)
from vla_zenoh.cli.output import errors, printable
from vla_zenoh.errors import VlaZenohError

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
NODES = frozenset({"up", "router", "sim", "ros2", "camera", "worker", "command"})
"""Commands whose output is a log: that of Zenoh belongs to it."""
RUN, DRIVE, LOOK = "Run", "Drive the robot", "Look"

app = typer.Typer(
    name="vla-zenoh",
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


for panel, name, function in (
    (RUN, "demo", demo.demo),
    (RUN, "up", up.up),
    (RUN, "router", router.router),
    (RUN, "sim", sim.sim),
    (RUN, "ros2", ros2.ros2),
    (RUN, "camera", camera.camera),
    (RUN, "worker", worker.worker),
    (RUN, "command", command.command),
    (RUN, "teleop", teleop.teleop),
    (DRIVE, "prompt", set_prompt.prompt),
    (DRIVE, "activate", switches.activate),
    (DRIVE, "deactivate", switches.deactivate),
    (DRIVE, "use", switches.use),
    (DRIVE, "rate", switches.rate),
    (DRIVE, "stop", switches.stop),
    (DRIVE, "reset", switches.reset),
    (LOOK, "view", view.view),
    (LOOK, "record", record.record),
    (LOOK, "replay", replay.replay),
    (LOOK, "eval", evaluate.evaluation),
    (LOOK, "status", status.status),
    (LOOK, "echo", echo.echo),
    (LOOK, "keys", keys.keys),
    (LOOK, "seen", seen.seen),
    (LOOK, "compare", compare.compare),
    (LOOK, "check", check.check),
    (LOOK, "net", net.net),
    (LOOK, "doctor", doctor.doctor),
):
    app.command(name, rich_help_panel=panel)(function)

app.add_typer(bench.bench_app, name="bench", rich_help_panel=LOOK)
app.add_typer(dataset.dataset_app, name="dataset", rich_help_panel=LOOK)
app.add_typer(profile.profile_app, name="profile", rich_help_panel=LOOK)
app.add_typer(serve.serve_app, name="serve", rich_help_panel=RUN)
app.add_typer(secure.secure_app, name="secure", rich_help_panel=RUN)


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
            f"{error}; install it with: pip install 'vla-zenoh[{extra}]'"
            if extra
            else f"{error}; `vla-zenoh doctor` names the system package"
        )
    except KeyboardInterrupt:
        sys.exit(130)


def _complain(message: str) -> NoReturn:
    text = Text("error: ", style="bold red").append(printable(message), style="not bold default")
    errors().print(text, soft_wrap=True)
    sys.exit(1)
