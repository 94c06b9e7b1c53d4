"""YAML of strangers and of tired people: read as meant, or refused with file and line."""

from __future__ import annotations

from typing import Any

import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

from vla_zenoh.errors import ProfileError
from vla_zenoh.profile.load import read_yaml, write_yaml

FILE = "lab.yaml"


def read(text: str) -> dict[str, Any]:
    return read_yaml(text.encode(), FILE)[0]


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("5", 5),
        ("-5", -5),
        ("010", 10),
        ("5.", 5.0),
        ("1e3", 1000.0),
        ("6.5E-3", 0.0065),
        ("-.5", -0.5),
        ("true", True),
        ("False", False),
        ("~", None),
        ("", None),
        ("yes", "yes"),
        ("on", "on"),
        ("12:30", "12:30"),
        ("2024-01-01", "2024-01-01"),
        ("0x10", "0x10"),
        ("1_000", "1_000"),
        ("'5'", "5"),
        ('"true"', "true"),
        ("!!str 5", "5"),
        ("[1, a, [2]]", [1, "a", [2]]),
        ("{b: {c: 1}}", {"b": {"c": 1}}),
    ],
)
def test_a_value_is_read_as_people_mean_it(text: str, value: Any) -> None:
    found = read(f"a: {text}")["a"]
    assert found == value
    assert type(found) is type(value)


def test_infinity_and_nan_are_numbers_for_the_schema_to_refuse() -> None:
    found = read("a: [.inf, -.inf, .NaN]")["a"]
    assert found[:2] == [float("inf"), -float("inf")]
    assert found[2] != found[2]


def test_a_key_is_a_word_whatever_it_looks_like() -> None:
    assert read("on: 1\n5: 2\nnull: 3") == {"on": 1, "5": 2, "null": 3}


def test_everything_has_its_line() -> None:
    _, lines = read_yaml(b"# first\na:\n  b: [1,\n      2]\n", FILE)
    assert lines == {
        (): "lab.yaml:2",
        ("a",): "lab.yaml:2",
        ("a", "b"): "lab.yaml:3",
        ("a", "b", "0"): "lab.yaml:3",
        ("a", "b", "1"): "lab.yaml:4",
    }


def test_an_empty_file_is_an_empty_map() -> None:
    for raw in (b"", b"# nothing\n", b"---\n", "\ufeff".encode()):
        assert read_yaml(raw, FILE)[0] == {}


def bomb() -> str:
    lines = ["a: &a [x, x, x, x, x, x, x, x, x, x]"]
    for one, other in zip("abcdefghijkl", "bcdefghijklm", strict=True):
        lines.append(f"{other}: &{other} [{', '.join([f'*{one}'] * 10)}]")
    return "\n".join(lines)


@pytest.mark.parametrize(
    ("raw", "said"),
    [
        (b"- a\n- b\n", r"lab\.yaml:1: a profile is a map of sections, this is a list"),
        (b"# x\n5\n", r"lab\.yaml:2: a profile is a map of sections, this is 5"),
        (b"a: 1\nb: 2\na: 3\n", r"lab\.yaml:3: a is given twice"),
        (b"a:\n  b: 1\n  b: 2\n", r"lab\.yaml:3: a\.b is given twice"),
        (b"a: 1\nb: \xe9\n", r"lab\.yaml:2: not UTF-8 text"),
        ("a: ü\n".encode("utf-16"), r"lab\.yaml:1: not UTF-8 text"),
        (b"a: 1\nb: \x07\n", r"lab\.yaml:2: a character that YAML does not allow"),
        (b"a: {b\nc: 1\n", r"lab\.yaml:\d: not valid YAML: while parsing a flow mapping"),
        (b"a:\n\tb: 1\n", r"lab\.yaml:2: not valid YAML: .*cannot start any token"),
        (b"a: *nobody\n", r"lab\.yaml:1: not valid YAML: found undefined alias"),
        (b"a: 1\n---\nb: 2\n", r"lab\.yaml:2: not valid YAML: expected a single document"),
        (b"x: &x {a: 1}\ny:\n  <<: *x\n", r"lab\.yaml:3: merge keys .* use extends"),
        (b"? [a]\n: b\n", r"lab\.yaml:1: a key must be a word"),
        (
            b"a: !!python/object:os.system x\n",
            r"lab\.yaml:1: the tag !!python/object:os.system is not",
        ),
        (b"a: !!binary aGk=\n", r"lab\.yaml:1: the tag !!binary is not read"),
        (b"a: !mine x\n", r"lab\.yaml:1: the tag !mine is not read"),
        (b"a: !!bool maybe\n", r"lab\.yaml:1: 'maybe' is not of the type bool"),
        (b"a: !!int ''\n", r"lab\.yaml:1: '' is not of the type int"),
        (b"a: !!float x\n", r"lab\.yaml:1: 'x' is not of the type float"),
        (b"a: " + b"9" * 5000, r"lab\.yaml:1: a number of 5000 digits"),
        (b"[" * 20_000, r"lab\.yaml: nested too deep"),
        (b"a: " + b"[" * 40 + b"]" * 40, r"lab\.yaml:1: nested too deep"),
        (b"a: &a [*a, *a]\n", r"lab\.yaml:1: nested too deep"),
        (b"a: &a {b: *a}\n", r"lab\.yaml:1: nested too deep"),
        (bomb().encode(), r"lab\.yaml:1: more than 5000 values, aliases counted in full"),
        (b"a: [" + b"1," * 6000 + b"1]", r"lab\.yaml:1: more than 5000 values"),
        (b"#" * 200_000, r"lab\.yaml: 200000 bytes, a profile has at most 100000"),
    ],
)
def test_what_cannot_be_read_is_refused_with_its_line(raw: bytes, said: str) -> None:
    with pytest.raises(ProfileError, match=said):
        read_yaml(raw, FILE)


def test_an_alias_stands_for_what_it_names() -> None:
    assert read("a: &c {x: 1}\nb: *c") == {"a": {"x": 1}, "b": {"x": 1}}


def refused_or_read(raw: bytes) -> bool:
    try:
        return isinstance(read_yaml(raw, FILE)[0], dict)
    except ProfileError as error:
        return str(error).startswith(FILE)


@given(st.binary(max_size=200) | st.text(max_size=200).map(lambda t: t.encode("utf-8", "replace")))
def test_arbitrary_files_are_refused_or_read(raw: bytes) -> None:
    assert refused_or_read(raw)


@given(st.text(st.sampled_from("ab{}[]:,-&*!|>'\"#%@\n \t1.e?<"), max_size=60).map(str.encode))
def test_text_like_yaml_is_refused_or_read(raw: bytes) -> None:
    assert refused_or_read(raw)


PLAIN = st.recursive(
    st.none()
    | st.booleans()
    | st.integers(-(10**15), 10**15)
    | st.floats(allow_nan=False)
    | st.text(max_size=12)
    | st.sampled_from(
        ["1e3", "yes", "on", "~", "null", "12:30", "0x1", ".inf", "1.", "<<", "=", ""]
    ),
    lambda inner: (
        st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=6), inner, max_size=3)
    ),
    max_leaves=8,
)


@given(st.dictionaries(st.text(max_size=6), PLAIN, max_size=4))
def test_what_is_written_is_read_back_here_and_by_yaml_1_1(data: dict[str, Any]) -> None:
    text = write_yaml(data)
    assert read(text) == data
    assert yaml.safe_load(text) == data
