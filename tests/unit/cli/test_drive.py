"""The commands that drive a robot: what they load, how a stop starts, their answers as JSON."""

from __future__ import annotations

import json
import os
import resource
import socket
import subprocess
import sys
import time
from collections.abc import Sequence
from contextlib import ExitStack
from functools import cache
from itertools import product
from typing import Any, NamedTuple, cast

import pytest
from typed import typed
from typer.testing import CliRunner

from vla_zenoh.cli import target
from vla_zenoh.cli.plain import json_answer, say, warn
from vla_zenoh.client import client as client_module
from vla_zenoh.client.client import Client
from vla_zenoh.errors import SessionError, StartingError
from vla_zenoh.keys import STARTING
from vla_zenoh.profile import load_profile
from vla_zenoh.program.main import app
from vla_zenoh.types import NodeStatus, Task

FIRST_LINE_S = 1.2
GIVE_UP_S = 0.5
"""Of a stop that finds no router, where only its process is looked at."""
NOWHERE = ("--connect", "tcp/127.0.0.1:9")


def test_help_of_a_stop_is_complete() -> None:
    done = CliRunner().invoke(app, ["stop", "--help"], env={"COLUMNS": "120"})
    for words in ("--all", "--wait-key", "--profile", "--connect", "--host", "--robot"):
        assert words in done.output


@cache
def after_typing(line: str) -> dict[str, Any]:
    """State of a process after the command line has run in it."""
    code = (
        "import json, os, sys\n"
        "import vla_zenoh.cli.stop as stop, vla_zenoh.cli.target as target\n"
        f"stop.GIVE_UP_S = {GIVE_UP_S}\n"
        "target.START_PATIENCE_S = 0.0\n"
        f"sys.argv = {['vla-zenoh', *line.split(), *NOWHERE]!r}\n"
        "from vla_zenoh.program.entry import main\n"
        "try: main()\nexcept SystemExit: pass\n"
        "niceness = os.getpriority(os.PRIO_PROCESS, 0)\n"
        "print(json.dumps({'numpy': 'numpy' in sys.modules, 'niceness': niceness}))"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=60
    )
    return json.loads(done.stdout.strip().splitlines()[-1])


@pytest.mark.parametrize("line", ["stop", "prompt go"])
def test_a_command_that_drives_does_not_load_numpy(line: str) -> None:
    """It takes longer to load than all that the command needs."""
    assert not after_typing(line)["numpy"]


def test_a_stop_starts_with_raised_priority_where_permitted() -> None:
    most, _ = resource.getrlimit(resource.RLIMIT_NICE)
    permitted = os.geteuid() == 0 or 20 - most <= -20
    here = os.getpriority(os.PRIO_PROCESS, 0)
    assert after_typing("prompt go")["niceness"] == here
    assert after_typing("stop")["niceness"] == (-20 if permitted else here)


@pytest.mark.parametrize("line", ["prompt go", "activate", "reset", "use brick", "rate 5"])
def test_with_json_a_failure_is_one_object_and_nothing_else(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, line: str
) -> None:
    monkeypatch.setattr(target, "START_PATIENCE_S", 0.2)
    done = typed(capsys, *line.split(), "--json", *NOWHERE)
    assert done.code == 1
    assert done.stderr == ""
    answer = json.loads(done.stdout)
    assert answer["ok"] is False
    assert "no Zenoh router answers" in answer["errors"][0]
    assert answer["warnings"][0].startswith("waiting, at most 0.2 s: no Zenoh router answers")


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


class Stop(NamedTuple):
    """What `vla-zenoh stop` printed, with its status, and when its first line came."""

    status: int
    lines: list[str]
    first_s: float


@pytest.fixture(scope="module")
def stops() -> dict[tuple[bool, bool], Stop]:
    """Of each form and each way to have no router; all of them wait together for theirs."""
    stops = {}
    with ExitStack() as running:
        # Accepts connections and says nothing.
        hung = running.enter_context(socket.create_server(("127.0.0.1", 0)))
        started = {}
        for json_form, hangs in product((False, True), repeat=2):
            where = NOWHERE
            if hangs:
                where = ("--connect", f"tcp/127.0.0.1:{hung.getsockname()[1]}")
            words = [sys.executable, "-m", "vla_zenoh", "stop", *["--json"] * json_form, *where]
            began_s = time.monotonic()
            process = running.enter_context(
                subprocess.Popen(words, stdout=subprocess.PIPE, text=True)
            )
            assert process.stdout is not None
            first = process.stdout.readline()
            started[json_form, hangs] = process, first, time.monotonic() - began_s
        for kind, (process, first, first_s) in started.items():
            rest, _ = process.communicate(timeout=60)
            lines = [first, *rest.splitlines()]
            stops[kind] = Stop(process.returncode, lines, first_s)
    return stops


@pytest.mark.realtime
@pytest.mark.parametrize("hangs", [False, True])
@pytest.mark.parametrize("json_form", [False, True])
def test_a_stop_without_a_router_says_at_once_that_nobody_confirmed_it(
    json_form: bool, hangs: bool, stops: dict[tuple[bool, bool], Stop]
) -> None:
    status, lines, first_s = stops[json_form, hangs]
    assert status == 4
    assert len(lines) <= 2  # on a busy computer the first comes before the imports have ended
    if json_form:
        for answer in map(json.loads, lines):
            assert (answer["ok"], answer["outcome"]) == (False, "not_confirmed")
        lines = [json.loads(line)["message"] for line in lines]
    for line in lines:
        assert line.startswith("NOT CONFIRMED: no answer")
        assert "The stop may still" in line
        assert "USE THE ROBOT'S OWN EMERGENCY STOP" in line
    assert "no answer of robot panda" in lines[-1]
    assert first_s < FIRST_LINE_S


class Scripted(Client):
    """A client whose command node gives these answers."""

    def __init__(self, answers: Sequence[Task | SessionError], **patience: Any) -> None:
        super().__init__(load_profile("panda_sim"), cast(Any, None), **patience)
        self.answers: list[Task | SessionError] = [*answers]

    def _ask(self, what: str, text: str, taken: Any, timeout_s: float) -> Task:
        answer = self.answers.pop(0)
        if isinstance(answer, SessionError):
            raise answer
        return answer


OPENING = "a camera is being opened"
TASK = Task(1, True, "go up", "scripted", 5.0, 100.0)


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(client_module, "START_PERIOD_S", 0.0)


@pytest.mark.usefixtures("quick")
def test_activate_waits_while_something_starts_and_says_for_what() -> None:
    told: list[str] = []
    client = Scripted([StartingError(OPENING), StartingError(OPENING), TASK], tell=told.append)
    assert client.activate() is TASK
    assert told == [f"waiting, at most 3 s: {OPENING}"]
    client.answers = [SessionError("no prompt")]
    with pytest.raises(SessionError, match="no prompt"):
        client.activate()


@pytest.mark.usefixtures("quick")
def test_what_is_missing_is_said_when_the_time_is_over() -> None:
    client = Scripted([StartingError(OPENING), TASK])
    with pytest.raises(StartingError, match=OPENING):
        client.activate(timeout_s=-1.0)
    assert len(client.answers) == 1


@pytest.mark.usefixtures("quick")
def test_a_setting_waits_while_a_node_is_started_by_up() -> None:
    client = Scripted([SessionError("no command node is running"), TASK])
    assert client.starting() == []
    status = NodeStatus("command", STARTING, "here", 1, 1)
    client.status_received("command", status, 100)
    assert client.starting() == ["command"]
    assert client.set_prompt("go up") is TASK
    client.token_appeared("command")
    assert client.starting() == []


def test_an_absent_command_node_of_a_router_that_just_appeared_is_starting() -> None:
    assert Scripted([], cold=True, patience_s=20.0).starting() == ["command"]
    assert Scripted([], cold=True, patience_s=0.0).starting() == []
