"""``vla-zenoh``: the table of all commands, each imported only when it is called; help, completion.

The examples in the help are those of ``examples.txt``. What completes a word imports inside: a
command that runs completes nothing.
"""

from __future__ import annotations

import os
import re
import shlex
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import cache, cached_property
from importlib import import_module
from importlib.resources import files
from textwrap import indent
from typing import Any, NamedTuple

import typer
import zenoh
from typer.core import TyperCommand, TyperGroup

from vla_zenoh import __version__, plugins, resources
from vla_zenoh.cli.options import DEFAULT_PROFILE, PROFILE_VARIABLE
from vla_zenoh.errors import PluginError, VlaZenohError, describe_fault
from vla_zenoh.keys import KEY_PATHS

PROGRAM = "vla-zenoh"
MAX_SHORT = 200
VERBATIM = "\b\n"
"""Keeps the lines of a paragraph as they are."""
NODES = frozenset({"up", "worker", "node"})
"""Commands that write a log, which includes Zenoh's own."""


OF_A_PACKAGE = None
"""Of a command that a package in ``plugins/`` brings; `plugins.PACKAGES` has its name."""
OTHERS = "Of other packages"


class CommandGroup(NamedTuple):
    """Several commands under one word: name -> ``module:function``; packages bring more."""

    help: str
    commands: Mapping[str, str] = {}


Panels = Mapping[str, Mapping[str, str | CommandGroup | None]]
"""Heading in the help -> the commands below it."""
COMMANDS: Panels = {
    "Run": {
        "demo": "lab.cli.demo:demo",
        "up": "cli.up:up",
        "worker": "cli.nodes:worker",
        "teleop": OF_A_PACKAGE,
        "node": CommandGroup(
            "Run one node by hand; `up` runs all nodes of a host, `worker` a model.",
            {
                "router": "cli.nodes:router",
                "sim": "cli.nodes:sim",
                "arm": "cli.nodes:arm",
                "camera": "cli.nodes:camera",
                "command": "cli.nodes:command",
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
        "do": CommandGroup(
            "Guarded motions: go to a pose, home, grip, run a model until a condition holds."
        ),
        "canary": CommandGroup(
            "Try a new model in shadow on several robots; promote it or take it back."
        ),
        "web": OF_A_PACKAGE,
        "serve": CommandGroup("Offer a model to clients of other frameworks."),
    },
    "Watch and record": {
        "status": "cli.status:status",
        "view": OF_A_PACKAGE,
        "record": "lab.cli.record:record",
        "save": OF_A_PACKAGE,
        "replay": OF_A_PACKAGE,
        "eval": "lab.cli.evaluate:evaluation",
        "otel": OF_A_PACKAGE,
        "keys": OF_A_PACKAGE,
        "echo": OF_A_PACKAGE,
    },
    "Check and measure": {
        "check": "lab.cli.check:check",
        "conform": CommandGroup(
            "Judge a robot, worker or camera of others by the rules of the wire."
        ),
        "doctor": "lab.cli.doctor:doctor",
        "profile": CommandGroup(
            "List, show, check and make profiles.",
            {
                "list": "lab.cli.profile:list_profiles",
                "show": "lab.cli.profile:show",
                "check": "lab.cli.profile:check",
            },
        ),
        "robot": CommandGroup(
            "Compare a robot with its profile.", {"check": "lab.cli.doctor:robot_check"}
        ),
        "camera": CommandGroup(
            "List the cameras of this computer, and calibrate them.",
            {"list": "lab.cli.camera:camera_list"},
        ),
        "secure": CommandGroup(
            "Certificates for a lab, so that only its hosts connect, with the rights of their "
            "roles."
        ),
        "dataset": CommandGroup("Turn recorded runs into training data."),
        "bench": CommandGroup("Measure this computer, and how well models do tasks."),
        "compare": OF_A_PACKAGE,
        "figure": CommandGroup(
            "Figures for a paper: PDF, SVG or PNG at the width of a column or a page."
        ),
        "inspect": OF_A_PACKAGE,
        "net": OF_A_PACKAGE,
        "trial": OF_A_PACKAGE,
        "nights": OF_A_PACKAGE,
    },
}


NEGATIVE = re.compile(r"-\.?[0-9].*")


class _Command(TyperCommand):
    """Takes a negative number for an argument, whose range is then the error, and no option.

    An empty argument is an error: as a path it would be this folder.
    """

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        if "" in args:
            before = ["the first argument", *args][args.index("")]
            raise typer.BadParameter(f"{before}: an empty text; leave it out or give one", ctx=ctx)
        ctx.ignore_unknown_options = any(map(NEGATIVE.fullmatch, args))
        return super().parse_args(ctx, args)


class _Unavailable(TyperCommand):
    """A command that cannot be loaded: whatever follows it, the error says why.

    Args:
        hidden: its package is not installed, so that no help lists it.
    """

    def __init__(self, name: str, why: str, *, hidden: bool = False) -> None:
        def fail() -> None:
            raise PluginError(why)

        anything = {"ignore_unknown_options": True, "allow_extra_args": True}
        super().__init__(
            name,
            callback=fail,
            help=why,
            short_help=why,
            hidden=hidden,
            add_help_option=False,
            context_settings=anything,
        )


class _LazyCommands(Mapping[str, Any]):
    """Name -> command, imported when it is first looked up; those of other packages come last."""

    def __init__(self, panels: Panels, path: Sequence[str]) -> None:
        self._entries = {name: one for panel in panels.values() for name, one in panel.items()}
        self._path = path
        self._loaded: dict[str, Any] = {}

    def __getitem__(self, name: str) -> Any:
        if name not in self._loaded:
            # Who runs a command of ours does not wait until all packages are read.
            entries = self._entries if name in self._entries else self.others
            self._loaded[name] = _load((*self._path, name), entries[name])
        return self._loaded[name]

    def __iter__(self) -> Iterator[str]:
        return iter((*self._entries, *self.others))

    def __len__(self) -> int:
        return len(self._entries) + len(self.others)

    @cached_property
    def others(self) -> dict[str, CommandGroup | None]:
        """Those that packages bring, ours first, and the table does not name."""
        depth = len(self._path)
        found: dict[str, CommandGroup | None] = {}
        for entry in (*plugins.PACKAGES, *plugins.installed(plugins.COMMANDS)):
            words = entry.split(".")
            if words[:depth] != [*self._path] or len(words) == depth:
                continue
            name = words[depth]
            is_group = len(words) > depth + 1
            if name not in self._entries:
                found[name] = CommandGroup(f"Commands of {name}.", {}) if is_group else OF_A_PACKAGE
        return found


def _load(path: Sequence[str], entry: str | CommandGroup | None) -> Any:
    name = path[-1]
    if isinstance(entry, CommandGroup):
        group = _lazy_group({"Commands": entry.commands}, path)
        found: Any = typer.Typer(cls=group, help=entry.help, no_args_is_help=True)
    elif entry is None:
        command = ".".join(path)
        if why := plugins.lacking(command):
            return _Unavailable(name, why, hidden=True)
        try:
            found = plugins.load(plugins.COMMANDS, command)
        except PluginError as error:
            return _Unavailable(name, str(error))
    else:
        module, _, attribute = entry.partition(":")
        found = getattr(import_module(f"vla_zenoh.{module}"), attribute)
    around = typer.Typer(rich_markup_mode=None, add_completion=False)
    around.callback()(lambda: None)  # makes it a group even with a single command
    if isinstance(found, typer.Typer):
        around.add_typer(found, name=name)
    else:
        around.command(name, cls=_Command)(found)
    group = typer.main.get_command(around)
    assert isinstance(group, TyperGroup)
    command = group.commands[name]
    if isinstance(entry, CommandGroup):
        command.short_help = entry.help
    else:
        add_help(command, path)
    return command


def _lazy_group(panels: Panels, path: Sequence[str] = ()) -> type[TyperGroup]:
    class LazyGroup(TyperGroup):
        def __init__(self, **attributes: Any) -> None:
            super().__init__(**attributes)
            self.commands = _LazyCommands(panels, path)  # pyright: ignore[reportAttributeAccessIssue]

        def format_commands(self, ctx: Any, formatter: Any) -> None:
            commands: Any = self.commands
            width = max(map(len, commands))
            # In a group nobody asks who brings what.
            sections = {"Commands": commands} if path else {**panels, OTHERS: commands.others}
            for title, names in sections.items():
                shown = [name for name in names if not commands[name].hidden]
                if not shown:
                    continue
                with formatter.section(title):
                    formatter.write_dl(
                        (f"{name:<{width}}", commands[name].short_help) for name in shown
                    )

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


# -- help, examples and completion ----------------------------------------------------------------
@cache
def examples() -> list[tuple[list[str], str]]:
    """Words and text of every example; the text begins with its comment, if it has one."""
    found: list[tuple[list[str], str]] = []
    comment = ""
    text = files("vla_zenoh.cli").joinpath("examples.txt").read_text("utf-8")
    for line in text.splitlines():
        if line.startswith("#"):
            comment = f"{line}\n"
        elif line:
            found.append((shlex.split(line, comments=True), comment + line))
            comment = ""
    return found


def add_help(command: Any, path: Sequence[str]) -> None:
    """Let a command, and all below it, complete its words and show its examples."""
    command.short_help = command.get_short_help_str(MAX_SHORT)  # Typer would cut it off
    if hasattr(command, "commands"):
        for name, found in command.commands.items():
            add_help(found, (*path, name))
        return
    for parameter in command.params:
        add_completion(parameter, " ".join(path))
    wanted = [PROGRAM, *path]
    found = [text for words, text in examples() if words[: len(wanted)] == wanted]
    if found:
        command.epilog = VERBATIM + "Examples:\n" + indent("\n".join(found), "  ")


def _profile(context: Any) -> Any:
    """The profile on the command line, else that of the environment, else the default."""
    from vla_zenoh.profile import load_profile

    given = context.params
    name = given.get("profile") or next(iter(given.get("names") or ()), None)
    name = name or os.environ.get(PROFILE_VARIABLE)
    try:
        return load_profile(name or DEFAULT_PROFILE)
    except VlaZenohError:
        return load_profile(DEFAULT_PROFILE)


def prompts(context: Any) -> Iterable[str]:
    """The profile's prompt, one task of every kind, and some motions of the scripted worker."""
    tasks = ("put the red brick in the box", "stack the red brick on the green brick")
    motions = ("HARD: go up", "HARD: go down", "HARD: yaw left", "HARD: close gripper", "hold")
    return [_profile(context).task.prompt, *tasks, "push the red brick left", *motions]


def keys(context: Any) -> Iterable[str]:
    """Keys of the robot, below ``<root>/<robot>/``."""
    profile = _profile(context)
    found = profile.keys
    named = [path.text(found) for path in KEY_PATHS.values() if not path.parameters]
    named += map(found.camera_jpeg, profile.cameras)
    for worker in profile.workers:
        named += [found.delta(worker), found.spec(worker), found.seen_record(worker)]
    return map(found.short, named)


class Candidate(NamedTuple):
    """A word for the shell; the fields are those that Typer reads."""

    value: str
    type: str = "plain"
    help: str | None = None


COMPLETIONS: Mapping[str, Callable[[Any], Iterable[str]]] = {
    **dict.fromkeys(
        ("profile", "also", "profile show.name", "profile check.names"),
        lambda _: resources.names("profiles"),
    ),
    "model": lambda context: [*_profile(context).workers, *resources.names("models")],
    **dict.fromkeys(
        ("worker", "workers", "compare.a", "compare.b"),
        lambda context: _profile(context).workers,
    ),
    "host": lambda context: _profile(context).hosts,
    "cameras": lambda context: _profile(context).cameras,
    **dict.fromkeys(("prompt", "prompts", "prompt.text"), prompts),
    **dict.fromkeys(("key", "keys"), keys),
}
"""What completes a parameter, by its name, or by command words and its name."""


def add_completion(parameter: Any, command: str) -> None:
    """Let the shell complete a parameter of the command of these words."""
    name = f"{command}.{parameter.name}"
    words = COMPLETIONS.get(name) or COMPLETIONS.get(parameter.name)
    if words is None or name == "serve policy.host":  # an address
        return

    def complete(context: Any, incomplete: str) -> list[Candidate]:
        found = sorted({word for word in words(context) if word.startswith(incomplete)})
        return [Candidate(word) for word in found]

    parameter.shell_complete = complete


# -- the program ----------------------------------------------------------------------------------
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
