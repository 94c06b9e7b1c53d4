"""Help and completion of the commands; the examples are in ``examples.txt``.

What completes a word imports inside: a command that runs completes nothing.
"""

from __future__ import annotations

import os
import shlex
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from importlib.resources import files
from textwrap import indent
from typing import Any, NamedTuple

PROGRAM = "vla-zenoh"
MAX_SHORT = 200
VERBATIM = "\b\n"
"""Keeps the lines of a paragraph as they are."""


def examples() -> Iterator[tuple[list[str], str]]:
    """Words and text of every example; the text begins with its comment, if it has one."""
    comment = ""
    text = files("vla_zenoh.cli").joinpath("examples.txt").read_text("utf-8")
    for line in text.splitlines():
        if line.startswith("#"):
            comment = f"{line}\n"
        elif line:
            yield shlex.split(line, comments=True), comment + line
            comment = ""


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
    from vla_zenoh.cli.words import DEFAULT_PROFILE, PROFILE_VARIABLE
    from vla_zenoh.errors import VlaZenohError
    from vla_zenoh.profile import load_profile

    given = context.params
    name = given.get("profile") or next(iter(given.get("names") or ()), None)
    name = name or os.environ.get(PROFILE_VARIABLE)
    try:
        return load_profile(name or DEFAULT_PROFILE)
    except VlaZenohError:
        return load_profile(DEFAULT_PROFILE)


def profiles(context: Any) -> Iterable[str]:
    """Names of profiles."""
    from vla_zenoh.profile import profile_names

    return profile_names()


def models(context: Any) -> Iterable[str]:
    """Workers of the profile, and names of models."""
    from vla_zenoh.resources import names

    return [*_profile(context).workers, *names("models")]


def of_profile(section: str) -> Callable[[Any], Iterable[str]]:
    """What the profile has in a section: workers, hosts or cameras."""
    return lambda context: getattr(_profile(context), section)


def prompts(context: Any) -> Iterable[str]:
    """The profile's prompt, one task of every kind, and some motions of the scripted worker."""
    tasks = ("put the red brick in the box", "stack the red brick on the green brick")
    motions = ("HARD: go up", "HARD: go down", "HARD: yaw left", "HARD: close gripper", "hold")
    return [_profile(context).task.prompt, *tasks, "push the red brick left", *motions]


def keys(context: Any) -> Iterable[str]:
    """Keys of the robot, below ``<root>/<robot>/``."""
    from vla_zenoh.keys import KEY_PATHS

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
    **dict.fromkeys(("profile", "also", "profile show.name", "profile check.names"), profiles),
    "model": models,
    **dict.fromkeys(("worker", "workers", "lab compare.a", "lab compare.b"), of_profile("workers")),
    "host": of_profile("hosts"),
    "cameras": of_profile("cameras"),
    **dict.fromkeys(("prompt", "prompts", "prompt.text"), prompts),
    **dict.fromkeys(("key", "keys"), keys),
}
"""What completes a parameter, by its name, or by command words and its name."""


def add_completion(parameter: Any, command: str) -> None:
    """Let the shell complete a parameter of the command of these words."""
    name = f"{command}.{parameter.name}"
    words = COMPLETIONS.get(name) or COMPLETIONS.get(parameter.name)
    if words is None or name == "lab serve.host":  # an address
        return

    def complete(context: Any, incomplete: str) -> list[Candidate]:
        found = sorted({word for word in words(context) if word.startswith(incomplete)})
        return [Candidate(word) for word in found]

    parameter.shell_complete = complete
