"""The words that drive: parsed without Typer, exactly as Typer would."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from typing import Any

import pytest
import typer
from typed import typed
from typer.testing import CliRunner

from vla_zenoh.cli import drive, status
from vla_zenoh.cli import words as table
from vla_zenoh.cli.main import app
from vla_zenoh.cli.plain import json_answer, say, warn
from vla_zenoh.cli.target import RobotTarget
from vla_zenoh.errors import SessionError

COMMANDS: Any = typer.main.get_command(app)
VARIABLES = tuple(table.VARIABLES)
FORBIDDEN = ("typer", "rich", "pydantic", "yaml", "numpy", "cv2", "vla_zenoh.profile.schema")


@pytest.fixture(autouse=True)
def no_variables(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in VARIABLES:
        monkeypatch.delenv(name, raising=False)


@pytest.mark.parametrize("name", table.WORDS)
def test_the_table_of_a_word_is_the_signature_of_its_command(name: str) -> None:
    word, options, arguments = table.WORDS[name], {}, []
    for parameter in COMMANDS.commands[name].params:
        if parameter.param_type_name == "argument":
            arguments.append(parameter.name + ("" if parameter.required else "?"))
            assert (parameter.type_descriptor.annotation is float) == (
                parameter.name in table.NUMBERS
            )
            continue
        assert not parameter.required, parameter.name
        assert parameter.multiple == (parameter.name in table.REPEATABLE)
        for option in (*parameter.opts, *parameter.secondary_opts):
            options[option] = parameter.name
            assert parameter.is_flag == (option in word.flags), option
        known = [variable for variable, field in table.VARIABLES.items() if field == parameter.name]
        assert ([parameter.envvar] if parameter.envvar else []) == known
    assert tuple(arguments) == word.arguments
    assert options == {**word.flags, **table.OPTIONS}


LINES = (
    "prompt 'x'",
    "prompt x --profile a.yaml -p b.yaml",
    "prompt -e tcp/h:1 x --connect=tcp/h:2",
    "activate --hold --robot ur",
    "deactivate --host=desk",
    "use brick",
    "rate 5",
    "rate 1e1",
    "speed",
    "speed 30%",
    "stop --all -p x",
    "stop --wait-key",
    "status --json --once",
)
MISTAKES = (
    "prompt",
    "prompt a b",
    "prompt -- -x",
    "prompt --nosuch x",
    "prompt x --profile",
    "rate fast",
    "rate -5",
    "stop --help",
    "stop -px",
    "stop --all=1",
    "nosuch",
    "",
)


@pytest.mark.parametrize("line", LINES)
@pytest.mark.parametrize("environment", [{}, {"VLA_ZENOH_CONNECT": "tcp/a:1 tcp/b:2"}])
def test_a_line_means_what_it_means_to_typer(
    line: str, environment: dict[str, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    for variable, value in environment.items():
        monkeypatch.setenv(variable, value)
    words = [word.strip("'") for word in line.split()]
    parsed = table.parse(words)
    assert parsed is not None
    name, arguments, target = parsed
    context = COMMANDS.commands[name].make_context(name, words[1:])
    typed = dict(context.params)
    fields = {field: typed.pop(field) for field in ("profile", "connect", "host", "robot")}
    connect = fields["connect"]
    assert RobotTarget(**target) == RobotTarget(
        **{**fields, "connect": list(connect or ()) or None}
    )
    wanted = {key: value for key, value in typed.items() if value is not None}
    assert {key: value for key, value in arguments.items() if value is not None} == wanted


@pytest.mark.parametrize("line", MISTAKES)
def test_help_and_mistakes_are_left_to_typer(line: str) -> None:
    assert table.parse(line.split()) is None


def test_every_word_has_its_function() -> None:
    for name, word in table.WORDS.items():
        assert callable(
            getattr({drive.__name__: drive, status.__name__: status}[word.module], name)
        )


def test_help_of_a_word_is_complete() -> None:
    done = CliRunner().invoke(app, ["stop", "--help"], env={"COLUMNS": "120"})
    for words in ("--all", "--wait-key", "--profile", "--connect", "--host", "--robot"):
        assert words in done.output


def test_a_word_that_drives_loads_nothing_that_it_does_not_need() -> None:
    code = (
        "import sys, vla_zenoh.cli.drive, vla_zenoh.bus.client\n"
        "import vla_zenoh.codec.settings, vla_zenoh.security.store\n"
        f"print([name for name in {FORBIDDEN} if name in sys.modules])"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, env=os.environ
    )
    assert done.stdout.strip() == "[]"


@pytest.mark.parametrize("line", ["prompt go", "activate", "stop", "reset", "use brick", "rate 5"])
def test_with_json_a_failure_is_one_object_and_nothing_else(
    capsys: pytest.CaptureFixture[str], line: str
) -> None:
    done = typed(capsys, *line.split(), "--json", "--connect", "tcp/127.0.0.1:9")
    assert done.code == 1
    assert done.stderr == ""
    answer = json.loads(done.stdout)
    assert answer["ok"] is False
    assert "no Zenoh router answers" in answer["errors"][0]


def test_with_json_every_reason_of_a_rejection_is_an_entry(
    capsys: pytest.CaptureFixture[str],
) -> None:
    with pytest.raises(SystemExit) as ended, json_answer():
        raise SessionError("activate rejected:\n  - no prompt is set\n  - the router is gone")
    assert ended.value.code == 1
    answer = json.loads(capsys.readouterr().out)
    assert answer["reasons"] == ["no prompt is set", "the router is gone"]


def test_with_json_the_lines_of_a_command_are_its_messages(
    capsys: pytest.CaptureFixture[str],
) -> None:
    with json_answer():
        say("rate: 5 Hz")
        warn("not stopped: b")
    captured = capsys.readouterr()
    assert captured.err == ""
    assert json.loads(captured.out) == {
        "ok": True,
        "messages": ["rate: 5 Hz"],
        "warnings": ["not stopped: b"],
        "errors": [],
        "reasons": [],
    }
