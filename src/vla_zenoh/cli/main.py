"""``vla-zenoh``: the table of all commands, each imported only when it is called."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from importlib import import_module
from pathlib import Path
from typing import Any, NamedTuple

import typer
import zenoh
from typer.core import TyperCommand, TyperGroup

from vla_zenoh import __version__
from vla_zenoh.cli.words import WORDS
from vla_zenoh.errors import describe_fault

NODES = frozenset({"up", "worker", "node"})
"""Commands that write a log, which includes Zenoh's own."""


class Group(NamedTuple):
    """Several commands under one word: name -> ``module:function`` inside the package."""

    help: str
    commands: Mapping[str, str]


COMMANDS: Mapping[str, Mapping[str, str | Group]] = {
    "Run": {
        "demo": "lab.cli.demo:demo",
        "up": "cli.up:up",
        "worker": "cli.nodes:worker",
        "teleop": "lab.cli.teleop:teleop",
        "node": Group(
            "Run one node by hand; `up` runs all nodes of a host, `worker` a model.",
            {
                "router": "cli.nodes:router",
                "sim": "cli.nodes:sim",
                "ros2": "cli.nodes:ros2",
                "arm": "cli.nodes:arm",
                "camera": "cli.nodes:camera",
                "command": "cli.nodes:command",
                "primitives": "lab.cli.primitives:node",
            },
        ),
    },
    "Drive the robot": {
        "prompt": "cli.drive:prompt",
        "activate": "cli.drive:activate",
        "deactivate": "cli.drive:deactivate",
        "use": "cli.drive:use",
        "rate": "cli.drive:rate",
        "speed": "cli.drive:speed",
        "stop": "cli.drive:stop",
        "reset": "cli.drive:reset",
        "do": Group(
            "Guarded motions: go to a pose, home, grip, run a model until a condition holds.",
            {
                "move-to": "lab.cli.primitives:move_to",
                "home": "lab.cli.primitives:home",
                "grip": "lab.cli.primitives:grip",
                "run": "lab.cli.primitives:run",
            },
        ),
        "web": "lab.cli.web:web",
        "serve": Group("Let agents drive the robot.", {"mcp": "lab.cli.mcp:mcp"}),
    },
    "Watch and record": {
        "status": "cli.status:status",
        "view": "lab.cli.view:view",
        "record": "lab.cli.record:record",
        "replay": "lab.cli.replay:replay",
        "eval": "lab.cli.evaluate:evaluation",
        "keys": "lab.cli.keys:keys",
        "echo": "lab.cli.keys:echo",
    },
    "Check and measure": {
        "check": "lab.cli.check:check",
        "doctor": "lab.cli.doctor:doctor",
        "profile": "lab.cli.profile:profile_app",
        "robot": Group(
            "Compare a robot with its profile.",
            {"check": "lab.cli.doctor:robot_check"},
        ),
        "camera": Group(
            "Cameras of this computer.",
            {"list": "lab.cli.camera:camera_list"},
        ),
        "secure": "lab.cli.secure:secure_app",
        "dataset": "lab.cli.dataset:dataset_app",
        "bench": Group(
            "Measure this computer, and how well models do tasks.",
            {
                "command": "lab.cli.bench_command:command",
                "task": "lab.cli.bench_task:task",
                "sim": "lab.cli.bench_sim:sim",
                "compare": "lab.cli.bench_compare:compare",
            },
        ),
        "lab": Group(
            "Compare and inspect models, and the network between the hosts; the rolling record.",
            {
                "trial": "lab.cli.trial:trial",
                "compare": "lab.cli.compare:compare",
                "inspect": "lab.cli.inspect:inspect",
                "net": "lab.cli.net:net",
                "serve": "lab.cli.serve:serve",
                "rolling": "lab.cli.rolling:rolling",
                "save": "lab.cli.rolling:save",
                "audit": "lab.cli.rolling:audit",
            },
        ),
    },
}


class _LazyCommands(Mapping[str, Any]):
    """Name -> command, imported when it is first looked up."""

    def __init__(
        self, panels: Mapping[str, Mapping[str, str | Group]], path: Sequence[str]
    ) -> None:
        self._entries = {name: entry for group in panels.values() for name, entry in group.items()}
        self._path = path
        self._loaded: dict[str, Any] = {}

    def __getitem__(self, name: str) -> Any:
        if name not in self._loaded:
            self._loaded[name] = _load((*self._path, name), self._entries[name])
        return self._loaded[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._entries)

    def __len__(self) -> int:
        return len(self._entries)


def _load(path: Sequence[str], entry: str | Group) -> Any:
    from vla_zenoh.cli.help import add_help

    name = path[-1]
    if isinstance(entry, Group):
        group = _lazy_group({"Commands": entry.commands}, path)
        found: Any = typer.Typer(cls=group, help=entry.help, no_args_is_help=True)
    else:
        module, _, attribute = entry.partition(":")
        found = getattr(import_module(f"vla_zenoh.{module}"), attribute)
        if name in WORDS:  # their modules do not load Typer
            from vla_zenoh.cli.options import options

            found = options(found)
    around = typer.Typer(rich_markup_mode=None, add_completion=False)
    around.callback()(lambda: None)  # makes it a group even with a single command
    if isinstance(found, typer.Typer):
        around.add_typer(found, name=name)
    else:
        around.command(name)(found)
    group = typer.main.get_command(around)
    assert isinstance(group, TyperGroup)
    command = group.commands[name]
    if isinstance(entry, Group):
        command.short_help = entry.help
    else:
        add_help(command, path)
    return command


def _short_help(entry: str) -> str | None:
    """Line of a command in the help of its group, from its source: importing all takes 0.5 s.

    None: it is not found there.
    """
    from vla_zenoh.cli.help import MAX_SHORT

    module, _, name = entry.partition(":")
    file = Path(__file__).parents[1].joinpath(*module.split(".")).with_suffix(".py")
    says = rf'(?:def {name}\(.*?^    """|{name} = typer\.Typer\([^)]*?help="\s*)(.*?)"'
    found = re.search(f"^{says}", file.read_text("utf-8"), re.DOTALL | re.MULTILINE)
    return TyperCommand(None, help=found[1]).get_short_help_str(MAX_SHORT) if found else None


def _lazy_group(
    panels: Mapping[str, Mapping[str, str | Group]], path: Sequence[str] = ()
) -> type[TyperGroup]:
    class LazyGroup(TyperGroup):
        def __init__(self, **attributes: Any) -> None:
            super().__init__(**attributes)
            self.commands = _LazyCommands(panels, path)  # pyright: ignore[reportAttributeAccessIssue]

        def format_commands(self, ctx: Any, formatter: Any) -> None:
            width = max(len(name) for names in panels.values() for name in names)
            for title, names in panels.items():
                with formatter.section(title):
                    formatter.write_dl(
                        (f"{name:<{width}}", self._line(name, entry))
                        for name, entry in names.items()
                    )

        def _line(self, name: str, entry: str | Group) -> str:
            line = entry.help if isinstance(entry, Group) else _short_help(entry)
            return line or self.commands[name].short_help

        def invoke(self, ctx: Any) -> Any:
            try:
                return super().invoke(ctx)
            except typer.BadParameter as error:
                faults = getattr(error.__cause__, "errors", None)
                if callable(faults):  # Typer repeats Pydantic, which leaves out what was given
                    fault: Any = next(iter(faults(include_url=False)))  # pyright: ignore
                    given = (
                        "" if fault["type"] == "value_error" else f" (given: {fault['input']!r})"
                    )
                    error.message = describe_fault(fault) + given
                raise

    return LazyGroup


app = typer.Typer(
    name="vla-zenoh",
    cls=_lazy_group(COMMANDS),
    help="Connects vision-language-action models to robots over Zenoh.",
    no_args_is_help=True,
    rich_markup_mode=None,
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
    # Zenoh logs to stdout, where the other commands write what a script reads.
    zenoh.init_log_from_env_or("error" if context.invoked_subcommand in NODES else "off")
