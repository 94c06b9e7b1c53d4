"""Wrong command lines and inputs: one sentence, the right status, nothing on stdout."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
from typed import typed

from vla_zenoh.cli import target

USAGE, FAILED = 2, 1
ROOT, NOBODY = 0, 65534
NOWHERE = ("--connect", "tcp/127.0.0.1:9")

WRONG: list[tuple[str, int, str]] = [
    # (words, exit status, part of what is said)
    ("rate abc", USAGE, "Invalid value for 'rate_hz': wants a number (given: 'abc')"),
    (
        "rate 1000",
        FAILED,
        "error: rate '1000' Hz is out of range: give 0.05 to 100 chunks per second",
    ),
    ("rate 0", FAILED, "error: rate '0' Hz is out of range: give 0.05 to 100 chunks per second"),
    (
        "speed fast",
        FAILED,
        "error: 'fast' is not a percentage: give a number from 0 to 100, such as",
    ),
    ("speed 120", FAILED, "error: speed '120' percent is out of range: give 0 to 100 percent"),
    ("use a/b", FAILED, "error: worker name 'a/b' cannot be part of a key"),
    ("prompt a\udc9bb", FAILED, "error: not UTF-8 text: invalid continuation byte"),
    ("use a\udc9bb", FAILED, "error: not UTF-8 text: invalid continuation byte"),
    ("speed a\udc9bb", FAILED, "error: not UTF-8 text: invalid continuation byte"),
    ("use", USAGE, "Missing argument 'worker'"),
    ("prompt", USAGE, "Missing argument 'text'"),
    ("stop --now", USAGE, "No such option: --now"),
    ("stpo", USAGE, "No such command 'stpo'."),
    ("demo --rate abc", USAGE, "Invalid value for '--rate': wants a number (given: 'abc')"),
    ("demo --rate -1", USAGE, "Invalid value for '--rate': must be at least 0.2 (given: '-1')"),
    ("demo --seed 1.5", USAGE, "Invalid value for '--seed': wants a whole number (given: '1.5')"),
    (
        "demo --profile nosuch",
        FAILED,
        "error: no profile called 'nosuch'. Known: fr3, fr3_franka_node, panda_bricks, pan",
    ),
    (
        "demo --profile panda_sin",
        FAILED,
        "no profile called 'panda_sin'; did you mean 'panda_sim'?",
    ),
    (
        "up nosuch",
        FAILED,
        "error: no profile called 'nosuch'. Known: fr3, fr3_franka_node, panda_bricks, pan",
    ),
    ("up ./absent.yaml", FAILED, "error: there is no file or folder './absent.yaml'"),
    ("up --listen x", USAGE, "'x' is not an endpoint: write tcp/HOST:PORT"),
    ("up --connect tpc/a:1", USAGE, "unknown protocol; did you mean 'tcp'? Known: tcp, udp, tls"),
    (
        "up --listen tcp/10.0.0.2:7447",
        FAILED,
        "lets anyone on that network command the robot. Make",
    ),
    ("up panda_sim_two_hosts", FAILED, "has hosts robot, gpu: say which one this is with --host"),
    ("up panda_sim --host desk", FAILED, "profile panda_sim has no host 'desk'; it has: here"),
    (
        "up panda_sim --connect tcp/127.0.0.1:7448",
        FAILED,
        "session.connect: leads to tcp/127.0.0.1:7448, and the router of this host listens on",
    ),
    ("profile check", USAGE, "give NAME, a profile, or set VLA_ZENOH_PROFILE"),
    ("profile check nosuch", FAILED, "no profile called 'nosuch'. Known: "),
    ("profile check panda_sim --host desk", FAILED, "hosts: has no 'desk'. It has: here"),
    ("profile show nosuch", FAILED, "error: no profile called 'nosuch'. Known: "),
    (
        "worker nosuch",
        FAILED,
        "error: no model called 'nosuch'. Known: brick, groot, lerobot, lerobot_server",
    ),
    ("worker scriptd", FAILED, "error: no model called 'scriptd'; did you mean 'scripted'? Known"),
    ("worker ./absent.py", FAILED, "error: there is no file or folder './absent.py'"),
    ("worker scripted --set foo", USAGE, "Invalid value: --set wants name=value, not 'foo'"),
    (
        "worker scripted --set camra=x",
        FAILED,
        "Scripted has no option 'camra'; did you mean 'camera'? Its options: camera, horizon, dt_s",
    ),
    (
        "worker replay",
        FAILED,
        "Replay needs the option 'file': give file=VALUE, with --set or in t",
    ),
    ("worker openvla", FAILED, "model.py needs the option 'checkpoint': give checkpoint=VALUE, wi"),
    (
        "worker openvla --set chekpoint=a",
        FAILED,
        "model.py has no option 'chekpoint'; did you mean 'checkpoint'? Its options: checkpoint,",
    ),
    ("worker lerobot", FAILED, "model.py needs the option 'checkpoint': give checkpoint=VALUE, wi"),
    (
        "worker scripted --delay -1",
        USAGE,
        "Invalid value for '--delay': must be at least 0 (given:",
    ),
    (
        "worker scripted --python no-such-python",
        FAILED,
        "error: --python 'no-such-python' is not a program: give the interpreter of an environment",
    ),
    (
        "worker scripted --python /bin/true2",
        FAILED,
        "error: --python '/bin/true2' is not a program",
    ),
    (
        "worker scripted --python /bin/false",
        FAILED,
        "error: --python '/bin/false' has no vla-zenoh; install it there: pip install",
    ),
    ("node camera nosuch", FAILED, "has no camera 'nosuch'; this node can serve: front, wrist"),
    ("node", USAGE, ""),
    ("teleop --frame foo", USAGE, "Invalid value for '--frame': 'foo' is not one of 'base', 'tcp'"),
    ("eval /absent.mcap", FAILED, "/absent.mcap cannot be read: No such file or directory"),
    (
        "replay /absent.mcap",
        FAILED,
        "error: /absent.mcap cannot be read: No such file or directory",
    ),
    ("view /absent.mcap", FAILED, "error: /absent.mcap cannot be read: No such file or directory"),
    ("compare /a /b", FAILED, "error: /a cannot be read: No such file or directory"),
    ("bench task --model nosuch", FAILED, "error: no model called 'nosuch'. Known: brick, groot,"),
    (
        "check nosuch",
        FAILED,
        "error: no model called 'nosuch'. Known: brick, groot, lerobot, lerobot_server",
    ),
    (
        "check scripted --runs 0",
        USAGE,
        "Invalid value for '--runs': must be at least 1 (given: '0')",
    ),
    ("check scripted --rate x", USAGE, "Invalid value for '--rate': wants a number (given: 'x')"),
    (
        "check openvla",
        FAILED,
        "model.py needs the option 'checkpoint': give checkpoint=VALUE, with",
    ),
    (
        "dataset export /absent.mcap -o out",
        FAILED,
        "error: /absent.mcap cannot be read: No such",
    ),
    ("dataset export", USAGE, "Missing "),
    (
        "secure add desk",
        FAILED,
        "error: profile panda_sim is not secured: run `vla-zenoh secure in",
    ),
    ("compare", USAGE, "Missing argument 'a'"),
    ("trial", USAGE, "Missing option '--output' / '-o'"),
    ("doctor --host desk", USAGE, "--host names a host of a profile: give --profile too"),
]
WITHOUT_A_ROUTER = (
    "status --once",
    "prompt hold",
    "activate",
    "reset",
    "keys",
    "echo task",
)


@pytest.fixture(autouse=True)
def wide(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("COLUMNS", "300")
    monkeypatch.chdir(tmp_path)


@pytest.mark.parametrize(("line", "code", "said"), WRONG, ids=[line for line, *_ in WRONG])
def test_what_is_typed_wrong_gets_one_sentence(
    capsys: pytest.CaptureFixture[str], line: str, code: int, said: str
) -> None:
    done = typed(capsys, *line.split())
    assert done.code == code, done.stderr
    assert said in done.said
    assert done.stdout == ""
    assert "Traceback" not in done.stderr
    assert "pydantic" not in done.stderr


@pytest.mark.parametrize("line", WITHOUT_A_ROUTER)
def test_without_a_router_it_is_said_where_one_was_looked_for(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, line: str
) -> None:
    monkeypatch.setattr(target, "START_PATIENCE_S", 0.0)
    done = typed(capsys, *line.split(), *NOWHERE)
    assert done.code == FAILED
    assert done.stdout == ""
    assert "no Zenoh router answers at tcp/127.0.0.1:9. Start one with `vla-zenoh" in done.said


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("import no_such_module_at_all\n", "No module named 'no_such_module_at_all'"),
        ("class Model:\n    spec = 1\n    def infer(self, o): ...\n", "needs a property `spec`"),
    ],
)
def test_a_file_that_is_no_model_is_refused_with_its_reason(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, text: str, why: str
) -> None:
    (tmp_path / "bad.py").write_text(text)
    done = typed(capsys, "worker", "./bad.py", *NOWHERE)
    assert done.code == FAILED
    assert why in done.said


def test_a_demo_is_refused_a_prompt_that_it_cannot_judge_and_lists_those_it_can(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    done = typed(capsys, "demo", "--prompt", "make me a sandwich")
    assert done.code == FAILED
    assert "'make me a sandwich' is no task that the shipped policy understands" in done.said
    assert "HARD: go up" in done.said
    assert "push the red brick" in done.said
    assert done.stdout == ""
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    "line",
    [
        "dataset stats .",
        "nights nosuch.yaml -o t",
        "web --people nosuch.yaml",
        "eval nosuch.mcap",
        "compare nosuch other",
        "teleop --leader nosuch.py",
        "figure success nosuch -o a.pdf",
        "trial --prompt x --workers a --setups nosuch.txt -o t",
        "profile new nosuch.urdf",
        "replay nosuch.mcap",
    ],
)
def test_a_file_that_is_not_there_is_named_without_numbers_of_the_system(
    capsys: pytest.CaptureFixture[str], line: str
) -> None:
    done = typed(capsys, *line.split())
    assert done.code in (USAGE, FAILED)
    assert "Errno" not in done.said
    assert "arm.file" not in done.said
    assert any(word in done.said for word in ("nosuch", "meta/info.json"))


@pytest.mark.parametrize("words", ["node command --profile panda_sim", "secure show"])
def test_a_user_without_a_home_is_told_to_set_it(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, words: str
) -> None:
    for name in ("HOME", "XDG_STATE_HOME"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr("pwd.getpwuid", {}.__getitem__)
    done = typed(capsys, *words.split())
    assert (done.code, done.said) == (FAILED, "error: this user has no home folder: set HOME")


@pytest.mark.parametrize("command", ["replay", "eval"])
def test_a_file_that_the_system_refuses_is_an_error_with_its_reason(
    capsys: pytest.CaptureFixture[str], command: str
) -> None:
    name = "a" * 300
    done = typed(capsys, command, name)
    assert (done.code, done.said) == (FAILED, f"error: {name}: File name too long")


def test_a_folder_that_this_user_may_not_enter_is_named(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    closed = tmp_path / "lab"
    closed.mkdir(mode=0)
    words = ("secure", "show", "--folder", str(closed))
    typed(capsys, *words)  # imports what it needs
    user = os.geteuid()
    if user == ROOT:  # which may enter any folder
        os.seteuid(NOBODY)
    try:
        done = typed(capsys, *words)
    finally:
        os.seteuid(user)
    assert done.code == FAILED
    assert done.said.startswith(f"error: {closed}")
    assert done.said.endswith(": Permission denied")
