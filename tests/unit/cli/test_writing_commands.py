"""Every command that writes: found in the command line, and tried with outputs that are wrong."""

from __future__ import annotations

import resource
import shutil
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import pytest
from dataset_rig import write_run
from typer.main import get_command
from typer.testing import CliRunner

from benchmarks.__main__ import app as benchmarks
from vla_zenoh.errors import VlaZenohError
from vla_zenoh.program.main import app

SHIPPED = Path(__file__).parents[3] / "profiles"
READ = {
    "view file",
    "replay file",
    "eval paths",
    "dataset export runs",
    "dataset stats folder",
    "figure motion runs",
    "figure latency runs",
    "figure success results",
    "bench sim replay",
    "trial setups",
    "nights plan_file",
    "camera calibrate recording",
    "camera calibrate lens",
    "camera calibrate tour_file",
    "teleop leader",
    "web people",
    "web certificate",
    "web key",
    "compare file",
    "profile bridge-config certificates",  # a name on another computer
}
"""Files and folders that commands read."""
LOGS = {"up log_dir", "node rolling folder"}
"""Folders of files that are appended to, and turned over."""
EDITED = {"camera calibrate write", "canary promote file", "canary back file"}
"""A profile in which keys are set; a backup is kept: `tests/unit/lab/test_calibrate_command.py`.
The file of a canary, which is told who was promoted: `tests/unit/lab/test_canary.py`."""
SECOND = {"profile new drawn"}
"""Beside the output, and as it: `MORE`."""
CERTIFICATES = {"secure init folder", "secure here folder", "secure show folder"}
"""Folders whose files only ``secure add --renew`` replaces; see `tests/unit/security`."""
NAMED = ("file", "folder", "out", "save", "into", "directory")
"""Names of options that may be a path given as text."""


class Writer(NamedTuple):
    """A command that writes.

    Args:
        words: of its command line, but for the output; ``RUN`` is a recording, ``DATASET`` a data
            set.
        name: of the output, beside the others.
        inputs: outputs that are also inputs.
        app: whose command it is.
    """

    words: str
    name: str
    inputs: tuple[str, ...] = ()
    app: Any = app


WRITERS = {
    "demo": Writer("demo --prompt HARD:+go+up", "out"),
    "view": Writer("view RUN", "out.rrd", ("RUN",)),
    "record": Writer("record", "out.mcap"),
    "eval": Writer("eval RUN", "out.html"),
    "dataset export": Writer("dataset export RUN", "out", (".",)),
    "dataset stats": Writer("dataset stats DATASET", "out.json", ("DATASET/meta/info.json",)),
    "figure motion": Writer("figure motion RUN", "out.pdf"),
    "figure latency": Writer("figure latency RUN", "out.svg"),
    "figure success": Writer("figure success own.yaml", "out.png"),
    "motion": Writer("motion", "out", app=benchmarks),
    "bench command": Writer("bench command", "out.json"),
    "bench task": Writer("bench task --model hold", "out"),
    "bench sim": Writer("bench sim metaworld --worker scripted", "out"),
    "canary watch": Writer("canary watch scripted", "out.json"),
    "camera list": Writer("camera list", "out"),
    "camera board": Writer("camera board", "out.pdf"),
    "camera calibrate": Writer("camera calibrate front --recording RUN", "out"),
    "trial": Writer("trial --workers a --prompt go", "out"),
    "nights": Writer("nights plan.yaml", "out"),
    "inspect": Writer("inspect", "out"),
    "profile new": Writer("profile new arm.urdf", "out.yaml", ("arm.urdf",)),
    "secure init": Writer(
        "secure init --profile own.yaml --folder keys", "out.yaml", ("own.yaml",)
    ),
}
MORE = {
    "demo": Writer("demo", "out"),
    "view": Writer("view", "out.rrd"),
    "eval": Writer("eval .", "out.csv"),
    "motion": Writer("motion --lockstep", "out", app=benchmarks),
    "bench task": Writer("bench task --model hold --lockstep", "out"),
}
"""The same commands in another mode."""
CONTINUE = ("trial", "nights", "bench sim", "delay", "flywheel")
"""Their output is filled by several calls."""
CONTINUING = [WRITERS[name] for name in CONTINUE if name in WRITERS]
PLAN = """\
workers: [a]
tasks: [{name: cup, prompt: lift the cup, episodes: 1, seconds: 1}]
reset: {primitive: home}
judge: {file: judge.py}
"""
CASES = [*WRITERS.values(), *MORE.values()]


def commands(root: Any, path: tuple[str, ...] = ()) -> Iterator[tuple[str, Any]]:
    """Words of every command that is not a group, and the command."""
    if not hasattr(root, "commands"):
        yield " ".join(path), root
        return
    for name in root.commands:
        yield from commands(root.commands[name], (*path, name))


EVERY = dict(commands(get_command(app)))
BENCHMARKS = dict(commands(get_command(benchmarks)))
EVERYWHERE = [*EVERY.items(), *BENCHMARKS.items()]


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A working folder with everything that the commands read."""
    monkeypatch.chdir(tmp_path)
    handlers = [(each, signal.getsignal(each)) for each in (signal.SIGINT, signal.SIGTERM)]
    write_run(tmp_path / "RUN")
    (tmp_path / "DATASET" / "meta").mkdir(parents=True)
    (tmp_path / "DATASET" / "meta" / "info.json").write_text("{}")
    (tmp_path / "plan.yaml").write_text(PLAN)
    shutil.copy(SHIPPED / "ur5e.urdf", tmp_path / "arm.urdf")
    (tmp_path / "own.yaml").write_text("extends: panda_sim\n")
    yield tmp_path
    for each, handler in handlers:
        signal.signal(each, handler)


def content(folder: Path) -> dict[str, bytes]:
    return {str(path): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def refusal(writer: Writer, output: str, *more: str) -> str:
    """The sentence with which a command ends that may not write `output`; nothing has changed."""
    before = content(Path.cwd())
    words = [word.replace("+", " ") for word in writer.words.split()]
    done = CliRunner().invoke(writer.app, [*words, "--output", output, *more])
    error = done.exception
    if isinstance(error, VlaZenohError):  # `vla-zenoh` prints it and ends with 1
        said = str(error)
    else:
        assert isinstance(error, SystemExit), (done.output, done.exc_info)
        said = done.stderr
    assert done.exit_code == 1, done.output
    assert done.stdout == ""
    assert content(Path.cwd()) == before
    assert len(said.splitlines()) == 1, said
    return said


# -- what the command line has ----------------------------------------------------------------
def test_every_path_of_a_command_is_read_or_is_its_output() -> None:
    for name, command in EVERY.items():
        for each in command.params:
            path = "Path" in str(each.type_descriptor.annotation) or each.name in NAMED
            if path and "--output" not in each.opts:
                assert f"{name} {each.name}" in READ | EDITED | SECOND | CERTIFICATES | LOGS, (
                    "outputs are called --output"
                )


def test_every_command_that_writes_is_tried_here() -> None:
    found = {
        name
        for name, command in EVERY.items()
        if any("--output" in each.opts for each in command.params)
    }
    assert found == {name for name, writer in WRITERS.items() if writer.app is app}


@pytest.mark.parametrize(("name", "command"), EVERYWHERE, ids=lambda each: str(each)[:30])
def test_options_mean_the_same_in_every_command(name: str, command: Any) -> None:
    options = {word: each for each in command.params for word in each.opts}
    if "--json" in options:
        assert options["--json"].is_flag
    if "--output" in options:
        assert options["-o"] is options["--output"]
        assert "--force" in options or name in CONTINUE
        assert "--json" in options or name == "view"
    assert not {"--out", "--save", "--html", "--csv"} & set(options)


# -- outputs that are wrong -------------------------------------------------------------------
@pytest.mark.parametrize("writer", CASES, ids=lambda each: each.words)
def test_what_exists_is_not_overwritten(writer: Writer, here: Path) -> None:
    path = here / writer.name
    if path.suffix:
        path.write_text("a night's work")
    else:
        path.mkdir()
        (path / "run.mcap").write_text("a night's work")
    said = refusal(writer, str(path))
    assert f"{path} exists" in said
    assert "--force" in said or writer in CONTINUING


@pytest.mark.parametrize("writer", CASES, ids=lambda each: each.words)
def test_a_folder_is_no_file_and_a_file_no_folder(writer: Writer, here: Path) -> None:
    path = here / writer.name
    path.mkdir() if path.suffix else path.write_text("mine")
    more = () if writer in CONTINUING else ("--force",)
    assert f"{path} is not a " in refusal(writer, str(path), *more)


@pytest.mark.parametrize("writer", CASES, ids=lambda each: each.words)
def test_a_folder_that_is_not_there_is_named(writer: Writer, here: Path) -> None:
    path = f"nosuch/{writer.name}"
    said = refusal(writer, path)
    assert f"{path} cannot be written" in said
    assert "there is no folder nosuch" in said
    assert not (here / "nosuch").exists()


@contextmanager
def full_disk() -> Iterator[None]:
    """No file of this process can grow."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (0, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


@pytest.mark.parametrize("writer", CASES, ids=lambda each: each.words)
def test_a_full_disk_is_found_before_the_work_begins(writer: Writer, here: Path) -> None:
    path = here / writer.name
    with full_disk():
        said = refusal(writer, str(path))
    assert f"{path} cannot be written: File too large" in said
    assert not path.exists() or not any(path.iterdir())


OVER_INPUTS: list[tuple[Writer, str]] = [
    (writer, name) for writer in CASES for name in writer.inputs
]


@pytest.mark.parametrize(
    ("writer", "name"), OVER_INPUTS, ids=lambda each: getattr(each, "words", each)
)
def test_an_input_is_not_overwritten_even_by_force(writer: Writer, name: str, here: Path) -> None:
    said = refusal(writer, str(here / name), "--force")
    assert "input" in said or "current folder" in said


def test_neither_a_page_nor_a_table_takes_the_place_of_a_recording(here: Path) -> None:
    for name in ("a.csv", "b.html"):
        (here / "RUN").rename(here / name)
        writer = Writer(f"eval {name}", name)
        assert "is an input" in refusal(writer, name, "--force")
        (here / name).rename(here / "RUN")
    done = CliRunner().invoke(app, ["eval", "RUN", "-o", "RUN", "--force"])
    assert done.exit_code == 2
    assert "must end in" in done.stderr
