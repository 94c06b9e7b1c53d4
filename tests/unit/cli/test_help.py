"""Help, examples and completion of every command."""

from __future__ import annotations

import shlex
from collections.abc import Iterator
from typing import Any

import pytest
from typer.main import get_command
from typer.testing import CliRunner

from vla_zenoh.program.main import COMPLETIONS, app, examples

LEAST_EXAMPLES = 2
ROOT: Any = get_command(app)


def commands(command: Any = ROOT, path: tuple[str, ...] = ()) -> Iterator[tuple[str, ...]]:
    """Words of every command that is not a group."""
    if not hasattr(command, "commands"):
        yield path
        return
    for name in command.commands:
        yield from commands(command.commands[name], (*path, name))


def found(path: tuple[str, ...]) -> Any:
    command = ROOT
    for word in path:
        command = command.commands[word]
    return command


ALL = [*commands()]


@pytest.mark.parametrize("path", ALL, ids=" ".join)
def test_the_help_of_every_command_ends_with_examples(path: tuple[str, ...]) -> None:
    shown = CliRunner().invoke(app, [*path, "--help"])
    assert shown.exit_code == 0
    _, _, end = shown.output.partition("Examples:\n")
    lines = [line for line in end.splitlines() if not line.strip().startswith("#")]
    assert len(lines) >= LEAST_EXAMPLES
    assert all(line.split()[: len(path) + 1] == ["vla-zenoh", *path] for line in lines)


@pytest.mark.parametrize(("words", "text"), [*examples()], ids=lambda each: str(each)[:60])
def test_every_example_is_accepted_by_its_command(words: list[str], text: str) -> None:
    words = words[: words.index("|")] if "|" in words else words
    command, rest = ROOT, words[1:]
    while hasattr(command, "commands"):
        command = command.commands[rest.pop(0)]
    context = command.make_context(command.name, rest)  # raises on a wrong option or value
    assert context.params
    assert shlex.split(text.splitlines()[-1])


@pytest.mark.parametrize("path", [(), ("up",), ("bench",), ("secure", "init")], ids=str)
def test_help_has_neither_boxes_nor_colours(path: tuple[str, ...]) -> None:
    shown = CliRunner().invoke(app, [*path, "--help"], color=True).output
    assert not set("│╭╰─\x1b") & set(shown)


def complete(line: str, path: tuple[str, ...], name: str) -> list[str]:
    """Words that the shell offers for a parameter, after the words of `line`."""
    *before, incomplete = line.split(" ")
    command = found(path)
    context = command.make_context(command.name, before, resilient_parsing=True)
    (parameter,) = (each for each in command.params if each.name == name)
    return [item.value for item in parameter.shell_complete(context, incomplete)]


@pytest.mark.parametrize(
    ("line", "path", "name", "word"),
    [
        ("panda_b", ("up",), "profile", "panda_bricks"),
        ("--profile panda_bricks b", ("use",), "worker", "brick"),
        ("sc", ("worker",), "model", "scripted"),
        ("nosuch", ("prompt",), "text", ""),
        ("put", ("prompt",), "text", "put the red brick in the box"),
        ("state/", ("echo",), "key", "state/pose"),
        ("--profile panda_sim camera/fr", ("echo",), "key", "camera/front/jpeg"),
        ("panda_sim_lab ", ("profile", "check"), "host", "gpu"),
        ("panda_s", ("profile", "show"), "name", "panda_sim"),
        ("", ("compare",), "b", "scripted"),
        ("wr", ("node", "camera"), "cameras", "wrist"),
    ],
)
def test_words_are_completed(line: str, path: tuple[str, ...], name: str, word: str) -> None:
    offered = complete(line, path, name)
    assert (word in offered) if word else not offered


def test_the_address_of_a_policy_server_is_no_host_of_a_lab() -> None:
    assert complete("", ("serve", "policy"), "host") == []


def test_every_profile_option_and_key_is_completed() -> None:
    named = {parameter.name for path in ALL for parameter in found(path).params}
    of_one = {name.rpartition(".")[2] for name in COMPLETIONS}
    assert of_one <= named
