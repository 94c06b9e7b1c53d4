"""What commands print: JSON for programs, and nothing that steers a person's terminal."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vla_zenoh.cli.output import console, errors, fail, print_json
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


@given(st.text(st.characters()))
def test_printable_text_steers_no_terminal(text: str) -> None:
    shown = printable(text)
    shown.encode("utf-8")
    assert not any(ord(c) < 32 and c not in "\n\t" for c in shown)
    assert not any(c in shown for c in "\x7f\x9b\u202e\u2028\u200b")


@given(st.text("aä箱 \n\t[]/"))
def test_ordinary_text_is_printed_as_it_is(text: str) -> None:
    assert printable(text) == text
