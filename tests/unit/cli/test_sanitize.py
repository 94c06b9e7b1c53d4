"""Whatever anybody says reaches a terminal as words: it steers nothing and breaks nothing."""

from __future__ import annotations

import ast
import io
import re
from collections.abc import Callable
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from rich.console import Group
from rich.live import Live
from rich.panel import Panel
from rich.progress import Progress, TextColumn
from rich.table import Table
from rich.text import Text
from vla_zenoh_diagnose import net

from vla_zenoh.cli import status_table
from vla_zenoh.cli.output import Screen, styled
from vla_zenoh.sanitize import one_line
from vla_zenoh.types import Event, Header, NodeStatus

EVIL = "[/x] [red]r[/] :warning: \x1b[2J\r\x07\x9b\u202e"
SHOWN = "[/x] [red]r[/] :warning: \\x1b[2J\\r\\x07\\x9b\\u202e"
WIDTH = 200
MANY = 4000
"""Line breaks, as many as a record takes."""
ROOT = Path(__file__).parents[3]
SOURCES = sorted((ROOT / "src").rglob("*.py")) + sorted((ROOT / "plugins").rglob("*.py"))


def screen(*, colours: bool = False) -> Screen:
    return Screen(file=io.StringIO(), width=WIDTH, force_terminal=colours)


def printed(out: Screen) -> str:
    assert isinstance(out.file, io.StringIO)
    return out.file.getvalue()


def in_a_table(words: str) -> Table:
    table = Table(words, title=words, caption=words)
    table.add_row(words)
    return table


@pytest.mark.parametrize(
    "make",
    [
        str,
        lambda words: styled(words, "bold red"),
        Text,
        in_a_table,
        Panel,
        lambda words: Group(words, Panel(words)),
    ],
)
def test_words_of_anybody_are_printed_as_they_stand(make: Callable[[str], object]) -> None:
    out = screen()
    out.print(make(EVIL))
    said = printed(out)
    assert "[/x] [red]r[/] :warning: \\x1b[2J" in said
    assert not any(ord(c) < 32 and c != "\n" for c in said)


def test_words_of_anybody_are_no_markup_even_where_markup_is_asked_for() -> None:
    out = screen()
    out.print(EVIL, markup=True, emoji=True)
    assert printed(out) == SHOWN + "\n"


def test_colours_and_live_tables_still_steer_the_terminal() -> None:
    out = screen(colours=True)
    out.print(styled("stopped", "bold red"))
    assert "\x1b[1;31mstopped\x1b[0m" in printed(out)
    with Live(console=out, auto_refresh=False) as live:
        live.update(in_a_table(EVIL), refresh=True)
        live.update(in_a_table(EVIL), refresh=True)
    assert "\x1b[1A" in printed(out)  # back up, over the older table
    assert "\x1b[2J" not in printed(out)


def test_a_bar_is_named_by_words_of_anybody() -> None:
    out = screen()
    with Progress(TextColumn("{task.description}", markup=False), console=out) as bars:
        bars.add_task(EVIL, total=1)
    assert "[/x] [red]r[/]" in printed(out)


@given(st.text(), st.integers(0, 50))
def test_one_line_is_one_line_of_no_more_than_was_asked_for(text: str, most: int) -> None:
    shown = one_line(text, most)
    assert not any(c in shown for c in "\n\r\t\x1b\x0b\x85\u2028")
    assert one_line("a" * (most + 1), most) == "a" * most + "..."


# -- nodes that lie -------------------------------------------------------------------------------
def said_by(node: str = "n", state: str = "ok", host: str = "h", **more: object) -> NodeStatus:
    return NodeStatus(node, state, host, 1, 2, **more)  # pyright: ignore[reportArgumentType]


PEER = {"round_trip_ms": 1.0, "offset_ms": 1.0, "uncertainty_ms": 1.0}


@pytest.mark.parametrize(
    "found",
    [
        said_by(rates_hz={EVIL: 1.0, "huge": 1e308}),
        said_by(state=EVIL),
        said_by(counters={f"refused.{EVIL}": 1}),
        said_by(latency_ms={EVIL: (1.0, 2.0)}),
        said_by(detail={"complaint": EVIL, "security": "insecure", "listen": [EVIL]}),
        said_by(detail={"complaint": ["a"] * 9, "security": ["insecure"], "listen": 5}),
        said_by("command", detail={"rate_hz": "abc", "prompt": EVIL, "why": {"a": EVIL}}),
        said_by("command", detail={"rate_hz": True}),
        said_by(host=EVIL, detail={"clocks": {"other": PEER}, "net": {"links": 5}}),
        said_by(
            detail={"clocks": {"other": PEER}, "net": {"links": [EVIL], "lost": {EVIL: 1e308}}}
        ),
        said_by(detail={"net": {"sent": {EVIL: [1e308, 1e308], "b": [EVIL, 1.0]}}}),
        said_by(detail={"net": {"sent": [EVIL], "lost": EVIL}, "clocks": 7}),
    ],
)
@pytest.mark.parametrize("name", ["command", EVIL])
def test_no_status_breaks_or_steers_what_people_look_at(found: NodeStatus, name: str) -> None:
    out = screen()
    out.print(status_table.render("panda", {name: (found, 0.1, True)}, []))
    nodes = {name: found, "other": said_by(host="elsewhere")}
    for table in net.tables("panda", net.pairs_of(nodes, []), net.lines_of(nodes), 100.0):
        out.print(table)
    assert not any(ord(c) < 32 and c != "\n" for c in printed(out))


def test_a_link_is_shown_with_its_brackets() -> None:
    link = "tls/[fe80::1]:7447"
    nodes = {
        "a": said_by(detail={"clocks": {"b": PEER}, "net": {"links": [link]}}),
        "b": said_by(host="other"),
    }
    out = screen()
    out.print(net.tables("panda", net.pairs_of(nodes, []), [], 100.0)[0])
    assert link in printed(out)


def test_only_the_node_of_that_key_is_shown_as_the_command_node() -> None:
    out = screen()
    liar = said_by("command", detail={"prompt": "HARD: go up"})
    out.print(status_table.render("panda", {"worker-a": (liar, 0.1, True)}, []))
    assert "carried out" not in printed(out)


def test_no_table_pushes_the_red_line_from_the_screen() -> None:
    tall = said_by(
        state="\n" * 200,
        rates_hz={str(number): 1.0 for number in range(50)},
        counters={f"refused.{number}": 1 for number in range(50)},
        detail={"complaint": "\n" * MANY},
    )
    event = Event("info", "notice", "\n" * MANY, "\n" * MANY)
    out = screen()
    happened = [("n", Header(1, 2, "n#1"), event)] * 20
    out.print(status_table.render("panda", {"n": (tall, 0.1, True)}, happened, insecure=True))
    lines = printed(out).splitlines()
    assert lines[0].startswith("insecure: anyone on the network can command this robot")
    assert len(lines) < 40


# -- read off the code ----------------------------------------------------------------------------
WORDS = re.compile(
    r"\brich\b|\bConsole\(|(from|render)_markup\(|from_ansi\(|SpinnerColumn\(|echo\(|\bprint\("
)
"""Without one of them a file has no fault: to parse all of them takes seconds."""


def called(node: ast.Call) -> str:
    return node.func.attr if isinstance(node.func, ast.Attribute) else ast.unparse(node.func)


def given_as(node: ast.Call, name: str) -> ast.expr | None:
    return next((given.value for given in node.keywords if given.arg == name), None)


def said_as_it_is(node: ast.expr | None) -> bool:
    return node is None or isinstance(node, ast.Constant)


def of_rich(tree: ast.AST) -> set[str]:
    """Names that a module has from Rich."""
    return {
        alias.asname or alias.name
        for node in ast.walk(tree)
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("rich.")
        for alias in node.names
    }


def faults_in(text: str) -> list[str]:
    if not WORDS.search(text):
        return []
    tree = ast.parse(text)
    names = of_rich(tree)
    return [said for node in ast.walk(tree) if (said := fault(node, names))]


def fault(node: ast.AST, rich: set[str]) -> str:
    """By what Rich would read a string as its markup, or print past a `Screen`; empty: by nothing.

    A `Screen` takes every string as it stands, see above. What is left are Rich's own consoles, the
    places where Rich makes markup of a string before a console has it, and `print`.
    """
    if isinstance(node, ast.ImportFrom) and (node.module or "").partition(".")[0] == "rich":
        own = {alias.name for alias in node.names} & {"print", "get_console", "inspect"}
        return f"imports {node.module}" if own or node.module == "rich.markup" else ""
    if isinstance(node, ast.Import):
        return "imports rich" if any(a.name.split(".")[0] == "rich" for a in node.names) else ""
    if not isinstance(node, ast.Call):
        return ""
    name = called(node)
    if name in ("Console", "from_markup", "render_markup", "from_ansi"):
        return f"calls {name}"
    if name not in rich and name in ("TextColumn", "Live", "Progress", "track", "Status"):
        return ""
    if name == "TextColumn":
        markup = given_as(node, "markup")
        off = isinstance(markup, ast.Constant) and markup.value is False
        return "" if off else "calls TextColumn without markup=False"
    if name in ("Live", "Progress", "track", "Status") and given_as(node, "console") is None:
        return f"calls {name} without a console of ours"
    if name in ("track", "Status", "SpinnerColumn"):  # they read their words as markup
        words = [*node.args[1:], given_as(node, "description")]
        return "" if all(map(said_as_it_is, words)) else f"gives words of somebody to {name}"
    if name in ("echo", "secho") or (name == "print" and isinstance(node.func, ast.Name)):
        ours = len(node.args) == 1 and isinstance(node.args[0], (ast.Constant, ast.Call))
        json_text = ours and ast.unparse(node.args[0]).startswith("json.dumps(")
        constant = ours and isinstance(node.args[0], ast.Constant)
        return "" if json_text or constant else f"calls {name}"
    return ""


PRINTS = {
    "src/vla_zenoh/cli/silence.py": "that a stop is not confirmed, before the imports have ended",
    "src/vla_zenoh/program/main.py": "the version",
    "src/vla_zenoh/cli/plain.py": "lines made printable there",
    "src/vla_zenoh/cli/nodes.py": "the profile's name, for a program that waits for it",
    "src/vla_zenoh/lab/cli/profile.py": "a profile as a file",
    "src/vla_zenoh/runtime/process.py": "what this computer lacks for shared memory",
    "src/vla_zenoh/runtime/environments.py": "the packages of a model that is about to run here",
    "plugins/vla-zenoh-calibrate/src/vla_zenoh_calibrate/accuracy.py": "its own figures",
    "plugins/vla-zenoh-ros2/src/vla_zenoh_ros2/cli.py": "a bridge's configuration as a file",
}
"""Where `print` gets something else than JSON, and what."""


def test_no_command_gives_rich_a_string_as_markup() -> None:
    faults = [
        f"{path.relative_to(ROOT)}: {said}"
        for path in SOURCES
        for said in faults_in(path.read_text("utf-8"))
    ]
    allowed = {f"{file}: calls print" for file in PRINTS}
    assert [said for said in faults if said not in allowed] == []
    assert allowed <= set(faults), "what is excused is there no more"


IMPORTS = "from rich.progress import Progress, TextColumn, track; from rich.live import Live"


@pytest.mark.parametrize(
    "text",
    [
        "Console(stderr=True).print(words)",
        "rich.console.Console()",
        "from rich import print",
        "from rich.markup import escape",
        "import rich",
        "Text.from_markup(words)",
        "Text.from_ansi(words)",
        "TextColumn('{task.description}')",
        "TextColumn(words, markup=True)",
        "Live(table)",
        "Progress(column)",
        "track(rows, words, console=errors())",
        "print(words)",
        "print(f'{words}')",
        "typer.echo(words)",
    ],
)
def test_the_check_sees(text: str) -> None:
    assert faults_in(f"{IMPORTS}; {text}")


@pytest.mark.parametrize(
    "text",
    [
        "console().print(words)",
        "Screen(stderr=True)",
        "from rich.text import Text",
        "TextColumn('{task.description}', markup=False)",
        "Live(console=console())",
        "view.Blueprint(live=True)",
        "track(rows, 'command node', console=errors())",
        "print(json.dumps(words), flush=True)",
        "print('a')",
    ],
)
def test_the_check_lets_pass(text: str) -> None:
    assert not faults_in(f"{IMPORTS}; {text}")
