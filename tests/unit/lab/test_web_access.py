"""Who may use the page, what a browser may say, when a button counts as held."""

from __future__ import annotations

import json
import re
from contextlib import suppress
from pathlib import Path
from typing import get_args

import pytest
from hypothesis import given
from hypothesis import strategies as st
from vla_zenoh_web import requests
from vla_zenoh_web.access import (
    MAX_PEOPLE,
    People,
    Person,
    host_is_ours,
    origin_is_ours,
    read_people,
)
from vla_zenoh_web.hold import HOLD_S, Hold
from vla_zenoh_web.requests import MAX_BYTES, AnyRequest, name_of, parse

from vla_zenoh.errors import CodecError, SecurityError
from vla_zenoh.lab.rate_limit import RateLimit

ANNA = Person("anna", "operator", "0123456789abcdef")
WALL = Person("wall", "viewer", "fedcba9876543210")
NOW_S = 1000.0
TICK = int(NOW_S * 1e3)


def people_file(folder: Path, text: str, mode: int = 0o600) -> Path:
    path = folder / "people.yaml"
    path.write_text(text)
    path.chmod(mode)
    return path


def test_a_person_is_found_by_the_whole_token_alone() -> None:
    people = People([ANNA, WALL])
    assert people.find(ANNA.token) == ANNA
    assert people.find(WALL.token) == WALL
    for wrong in ("", ANNA.token[:-1], ANNA.token + "0", ANNA.token.upper(), "\ud800"):
        assert people.find(wrong) is None


def test_nobody_has_more_rights_than_the_certificate_of_the_server() -> None:
    found = People([ANNA, WALL], "viewer").find(ANNA.token)
    assert found is not None
    assert found.role == "viewer"


def test_an_invited_person_is_found_and_has_no_more_rights_than_the_server() -> None:
    people = People([ANNA])
    assert people.invite("bob", "viewer", "bob's own token!").drives is False
    assert people.find("bob's own token!") == Person("bob", "viewer", "bob's own token!")
    bounded = People([ANNA], "viewer")
    assert bounded.invite("eve", "operator", "eve's own token!").role == "viewer"


@pytest.mark.parametrize(
    ("name", "named"), [("anna", "anna already"), ("", "person"), ("a/b", "person")]
)
def test_a_name_that_is_taken_or_none_is_not_invited(name: str, named: str) -> None:
    people = People([ANNA])
    with pytest.raises(SecurityError, match=named):
        people.invite(name, "viewer", "x" * 16)
    assert people.find("x" * 16) is None


def test_who_is_taken_out_of_the_file_is_out_and_whoever_was_invited_stays(tmp_path: Path) -> None:
    both = f'anna: {{role: operator, token: "{ANNA.token}"}}\n'
    both += f'wall: {{role: viewer, token: "{WALL.token}"}}\n'
    file = people_file(tmp_path, both)
    people = People(read_people(file), file=file)
    bob = people.invite("bob", "viewer", "bob's own token!")
    assert not people.reread()
    assert people.has(ANNA)
    people_file(tmp_path, both.splitlines()[1])
    assert people.reread()
    assert not people.has(ANNA)
    assert people.find(ANNA.token) is None
    assert people.has(WALL)
    assert people.has(bob)
    # A lower role is another person's.
    people_file(tmp_path, both.replace("operator", "viewer"))
    assert people.reread()
    assert not people.has(ANNA)
    assert people.has(ANNA._replace(role="viewer"))


def test_a_file_that_is_being_written_shows_nobody_out(tmp_path: Path) -> None:
    file = people_file(tmp_path, f'anna: {{role: operator, token: "{ANNA.token}"}}\n')
    people = People(read_people(file), file=file)
    people_file(tmp_path, "anna: {role: oper")
    with pytest.raises(SecurityError, match=r"people\.yaml"):
        people.reread()
    assert people.has(ANNA)
    assert not people.reread()  # it is told once


def test_people_are_invited_up_to_a_number() -> None:
    people = People([ANNA])
    for number in range(MAX_PEOPLE - 1):
        people.invite(f"guest-{number}", "viewer", f"token number {number:06d}")
    with pytest.raises(SecurityError, match="people have a token"):
        people.invite("one-more", "viewer", "x" * 16)


def test_a_file_of_people_is_read(tmp_path: Path) -> None:
    text = f"anna: {{role: operator, token: '{ANNA.token}'}}\n"
    assert read_people(people_file(tmp_path, text)) == [ANNA]


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ("", "names no person"),
        ("anna: operator", "anna: write"),
        ("anna: {role: boss, token: '0123456789abcdef'}", "a role is operator or viewer"),
        ("anna: {role: operator, token: short}", "16 characters"),
        ("anna: {role: operator, token: 1234567890123456}", "in quotes"),
        ("a/b: {role: operator, token: '0123456789abcdef'}", "person 'a/b'"),
        (
            "a: {role: operator, token: '0123456789abcdef'}\n"
            "b: {role: viewer, token: '0123456789abcdef'}",
            "the same token",
        ),
        ("a: [", "people.yaml"),
    ],
)
def test_a_wrong_file_of_people_is_named(tmp_path: Path, text: str, named: str) -> None:
    with pytest.raises(SecurityError, match=named):
        read_people(people_file(tmp_path, text))


def test_a_file_of_people_that_others_can_read_is_rejected(tmp_path: Path) -> None:
    path = people_file(tmp_path, f"anna: {{role: operator, token: '{ANNA.token}'}}", 0o644)
    with pytest.raises(SecurityError, match="chmod 600"):
        read_people(path)


@pytest.mark.parametrize(
    ("host", "ours"),
    [
        ("localhost:8088", True),
        ("LOCALHOST", True),
        ("127.0.0.1:8088", True),
        ("[::1]:8088", True),
        ("192.168.1.7", True),
        ("robot-desk:8088", True),
        ("robot-desk.evil.example:8088", False),
        ("evil.example", False),
        ("127.0.0.1.evil.example", False),
        ("", False),
        ("[evil]:80", False),
    ],
)
def test_only_own_names_and_addresses_are_ours(host: str, ours: bool) -> None:
    assert host_is_ours(host, ["robot-desk"]) is ours


def test_only_the_page_itself_has_our_origin() -> None:
    assert origin_is_ours("http://localhost:8088", "localhost:8088", secure=False)
    assert origin_is_ours("https://robot-desk", "robot-desk", secure=True)
    for origin in ("http://robot-desk", "https://robot-desk:8443", "https://evil", "null", ""):
        assert not origin_is_ours(origin, "robot-desk", secure=True)
    assert not origin_is_ours("http://", "", secure=False)


def test_a_rate_limit_lets_a_burst_through_and_then_its_rate() -> None:
    limit = RateLimit(rate_hz=10, burst=5, now_s=0.0)
    assert [limit.take(0.0) for _ in range(6)] == [True] * 5 + [False]
    assert limit.take(0.1)
    assert not limit.take(0.1)
    assert [limit.take(1e6) for _ in range(6)] == [True] * 5 + [False]


# -- messages ---------------------------------------------------------------------------------
def test_a_request_has_its_fields() -> None:
    request = parse('{"do": "prompt", "text": "lift the brick"}')
    assert request == requests.PromptRequest("lift the brick")


@pytest.mark.parametrize(
    "text",
    [
        "",
        "1",
        "[]",
        "{}",
        "[" * MAX_BYTES,
        '{"do": []}',
        '{"do": "prompt"}',
        '{"do": "prompt", "text": 1}',
        '{"do": "prompt", "text": "\\ud800"}',
        '{"do": "stop", "now": true}',
        '{"do": "rate", "hz": NaN}',
        '{"do": "rate", "hz": Infinity}',
        '{"do": "rate", "hz": true}',
        '{"do": "rate", "hz": 1' + "0" * 400 + "}",
        '{"do": "beat", "press": 1, "tick": 1, "twist": [0, 0, 0, 0, 0, 2], "opening": 0}',
        '{"do": "beat", "press": 1.5, "tick": 1, "twist": [0, 0, 0, 0, 0, 0], "opening": 0}',
        '{"do": "jog", "on": 1, "frame": "base", "level": 0, "part": ""}',
        '{"do": "jog", "on": true, "frame": ["base"], "level": 0, "part": ""}',
        '{"do": "record", "on": true, "verdict": {}, "note": ""}',
        '{"do": "look", "streams": ["a", 1], "hz": 1}',
        "x" * (MAX_BYTES + 1),
    ],
)
def test_what_is_no_request_is_named(text: str) -> None:
    with pytest.raises(CodecError):
        parse(text)


VALUES = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=6) | st.dictionaries(st.text(max_size=5), inner),
    max_leaves=8,
)


KINDS = {kind.__struct_config__.tag: kind for kind in get_args(AnyRequest)}


@given(st.sampled_from(sorted(KINDS)), st.data())
def test_whatever_a_field_holds_it_is_taken_or_named(do: str, data: st.DataObject) -> None:
    fields = KINDS[do].__struct_fields__
    message = {"do": do, **{name: data.draw(VALUES) for name in fields}}
    with suppress(CodecError):
        assert name_of(parse(json.dumps(message))) == do


def test_the_page_asks_for_what_the_server_knows_and_hears_what_it_says() -> None:
    """Kinds of messages are declared in `requests`, and in the table RECEIVE of the page."""
    folder = Path(requests.__file__).parent
    page = (folder / "static/page.js").read_text("utf-8")
    asked = set(re.findall(r'do: "([a-z_]+)"', page)) | {"activate", "deactivate", "reset"}
    assert asked == KINDS.keys()
    server = (folder / "server.py").read_text() + (folder / "tables.py").read_text()
    table = page.partition("const RECEIVE = {")[2].partition("};")[0]
    heard = set(re.findall(r"^  ([a-z_]+): ", table, re.M))
    assert set(re.findall(r'"is": "([a-z_]+)"', server)) == heard


@given(st.text())
def test_any_text_is_a_request_or_is_named(text: str) -> None:
    with suppress(CodecError):
        assert name_of(parse(text)) in KINDS


# -- hold-to-run ------------------------------------------------------------------------------
def test_a_hold_lasts_as_long_as_its_echoes_are_new() -> None:
    hold = Hold()
    assert hold.press(1, 1, TICK, NOW_S) == ""
    assert hold.beat(1, 1, TICK + 300, NOW_S + 0.3)
    hold.expire(NOW_S + 0.3 + HOLD_S - 0.01)
    assert hold.held is not None
    hold.expire(NOW_S + 0.3 + HOLD_S)
    assert hold.held is None


def test_a_late_message_is_no_echo_however_many_come() -> None:
    hold = Hold()
    hold.press(1, 1, TICK, NOW_S)
    for late_s in (0.1, 0.2, 0.5):
        assert hold.beat(1, 1, TICK, NOW_S + late_s)  # the same old tick
    assert not hold.beat(1, 1, TICK, NOW_S + HOLD_S)
    assert not hold.beat(1, 1, TICK + 700, NOW_S + 0.7)  # it does not come back
    assert hold.press(1, 1, TICK + 700, NOW_S + 0.7)
    assert hold.press(1, 2, TICK + 700, NOW_S + 0.7) == ""


def test_a_tick_of_the_future_is_no_echo() -> None:
    hold = Hold()
    assert hold.press(1, 1, TICK + 1000, NOW_S)
    hold.press(1, 1, TICK, NOW_S)
    hold.beat(1, 1, TICK + 10**9, NOW_S)
    hold.expire(NOW_S + HOLD_S)
    assert hold.held is None


def test_one_page_holds_at_a_time_and_no_other_lets_it_go() -> None:
    hold = Hold()
    hold.press(1, 1, TICK, NOW_S)
    assert hold.press(2, 1, TICK, NOW_S) == "another page holds the arm"
    assert not hold.beat(2, 1, TICK, NOW_S)
    hold.release(2)
    assert hold.held is not None
    hold.forget(1)
    assert hold.press(2, 2, TICK, NOW_S) == ""
