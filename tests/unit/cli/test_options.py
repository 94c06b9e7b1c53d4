"""Options as dataclasses."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any

import pytest
import typer
from typer.testing import CliRunner

from vla_zenoh.cli.options import options

CALLS: list[tuple[Any, ...]] = []


@dataclass(frozen=True)
class Place:
    """Where."""

    host: Annotated[str, typer.Option("--host", envvar="TEST_OPTIONS_HOST")] = "here"
    ports: Annotated[list[int] | None, typer.Option("--port")] = None


@dataclass(frozen=True)
class Model:
    """What, which has to be given."""

    name: Annotated[str, typer.Option("--model")]


@options
def run(
    place: Place,
    word: Annotated[str, typer.Argument()],
    model: Model,
    loud: Annotated[bool, typer.Option("--loud")] = False,
) -> None:
    """Run it."""
    CALLS.append((place, word, model, loud))


APP = typer.Typer()
APP.command()(run)


@pytest.mark.parametrize(
    ("words", "call"),
    [
        (("a", "--model", "m"), (Place(), "a", Model("m"), False)),
        (
            ("a", "--model", "m", "--port", "1", "--port", "2", "--host", "x", "--loud"),
            (Place("x", [1, 2]), "a", Model("m"), True),
        ),
    ],
)
def test_a_command_gets_its_dataclasses(words: tuple[str, ...], call: tuple[Any, ...]) -> None:
    CALLS.clear()
    done = CliRunner().invoke(APP, words)
    assert done.exit_code == 0, done.output
    assert [call] == CALLS


def test_a_field_may_come_from_the_environment() -> None:
    CALLS.clear()
    CliRunner().invoke(APP, ["a", "--model", "m"], env={"TEST_OPTIONS_HOST": "robot"})
    assert CALLS[0][0] == Place("robot")


def test_a_field_without_a_default_is_required() -> None:
    done = CliRunner().invoke(APP, ["a"], env={"COLUMNS": "200"})
    assert done.exit_code == 2
    assert "Missing option '--model'" in done.output


def test_help_is_that_of_the_command_and_its_fields() -> None:
    done = CliRunner().invoke(APP, ["--help"], env={"COLUMNS": "200", "NO_COLOR": "1"})
    assert "Run it." in done.output
    assert all(word in done.output for word in ("--host", "--port", "--model", "--loud", "word"))
