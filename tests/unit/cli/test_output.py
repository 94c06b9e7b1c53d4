"""What commands print: JSON for programs, and nothing that steers a person's terminal."""

from __future__ import annotations

import io
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vla_zenoh.cli.output import Screen, console, errors, fail, new_table, styled
from vla_zenoh.lab.cli.output import print_json
from vla_zenoh.profile import load_profile
from vla_zenoh.sanitize import printable
from vla_zenoh.types import GripperState, SceneState

Captured = pytest.CaptureFixture[str]


@pytest.mark.parametrize(
    ("value", "said"),
    [
        ({"a": np.arange(3), "b": np.float32(0.5)}, {"a": [0, 1, 2], "b": 0.5}),
        ([float("nan"), float("-inf"), 1.0], [None, None, 1.0]),
        ((1, True, None, "\ud800"), [1, True, None, "\ud800"]),
        ({1: {2}, "p": Path("/a")}, {"1": [2], "p": "/a"}),
        (b"\x00\xff", "00ff"),
        (
            GripperState(0.04, moving=False, holding=True),
            {"width_m": 0.04, "moving": False, "holding": True, "mode": "ready", "faults": []},
        ),
        (
            SceneState("table", np.arange(2.0)),
            {"scene": "table", "qpos": [0.0, 1.0], "seed": None},
        ),
    ],
)
def test_whatever_a_node_says_is_valid_json(value: Any, said: Any, capsys: Captured) -> None:
    print_json(value)
    assert json.loads(capsys.readouterr().out) == said


def test_a_profile_is_valid_json(capsys: Captured) -> None:
    print_json(load_profile("panda_sim"))
    assert json.loads(capsys.readouterr().out)["robot"]["name"] == "panda"


def test_what_has_no_json_form_is_a_mistake() -> None:
    with pytest.raises(TypeError, match="object has no JSON form"):
        print_json(object())


def test_a_failure_goes_to_stderr_with_its_code(capsys: Captured) -> None:
    with pytest.raises(SystemExit) as caught:
        fail("no [red]robot[/red] \x1b[2J at [x]", code=3)
    assert caught.value.code == 3
    said = capsys.readouterr()
    assert said.out == ""
    assert said.err == "error: no [red]robot[/red] \\x1b[2J at [x]\n"


def test_a_long_failure_is_one_line_for_a_script(capsys: Captured) -> None:
    with pytest.raises(SystemExit):
        fail("word " * 100)
    assert capsys.readouterr().err.count("\n") == 1


def test_consoles_follow_the_streams_of_the_moment(capsys: Captured) -> None:
    console().print("out")
    errors().print("err")
    said = capsys.readouterr()
    assert (said.out, said.err) == ("out\n", "err\n")


# -- tables -------------------------------------------------------------------------------------
INTERVAL = "34.2%..100.0%"


def rates() -> Any:
    table = new_table("worker", "done", "rate", "95 %", title="a trial", left=("worker",))
    table.add_row("brick_with_a_long_name_of_its_own", "3", "60.0%", INTERVAL)
    table.add_row("other", "10", "100.0%", "72.2%..100.0%")
    return table


def printed(table: Any, *, width: int, terminal: bool) -> str:
    screen = Screen(file=io.StringIO(), force_terminal=terminal, width=width, color_system=None)
    screen.print(table)
    return screen.file.getvalue()


def test_without_a_terminal_a_row_is_a_line_of_columns(capsys: Captured) -> None:
    console().print(rates())
    title, head, first, second = capsys.readouterr().out.splitlines()
    assert title == "a trial"
    assert head.split() == ["worker", "done", "rate", "95", "%"]
    assert first.split() == ["brick_with_a_long_name_of_its_own", "3", "60.0%", INTERVAL]
    assert second.index("other") == first.index("brick")
    assert second.rstrip().endswith("72.2%..100.0%")


def test_without_a_terminal_no_line_is_broken(capsys: Captured) -> None:
    table = new_table("key", "message")
    table.add_row("vla/ur5e/" + "delta/" * 40 + "reach", "one\ntwo")
    console().print(table)
    console().print("word " * 100)
    _, row, text = capsys.readouterr().out.splitlines()
    assert row.endswith("reach  one; two")
    assert text.count("word") == 100


def test_a_narrow_terminal_wraps_words_and_no_figures() -> None:
    shown = printed(rates(), width=50, terminal=True)
    assert INTERVAL in shown
    assert "\u2500" in shown
    assert "\u2026" not in shown


def test_a_terminal_too_narrow_for_the_figures_loses_none() -> None:
    shown = printed(rates(), width=20, terminal=True)
    assert INTERVAL in shown.replace("\n", "")
    assert "\u2500" not in shown


def test_no_color_means_no_style_at_all(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("NO_COLOR", "1")
    screen = Screen(file=io.StringIO(), force_terminal=True, width=80)
    screen.print(styled("active", "bold green"))
    screen.print(rates())
    assert "\x1b" not in screen.file.getvalue()


@given(st.text(st.characters()))
def test_printable_text_steers_no_terminal(text: str) -> None:
    shown = printable(text)
    shown.encode("utf-8")
    assert not any(ord(c) < 32 and c not in "\n\t" for c in shown)
    assert not any(c in shown for c in "\x7f\x9b\u202e\u2028\u200b")


@given(st.text("aä箱 \n\t[]/"))
def test_ordinary_text_is_printed_as_it_is(text: str) -> None:
    assert printable(text) == text
