"""Plain text on the setting keys: forgiving about form, strict about meaning."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from random_records import refusal

from vla_zenoh import keys
from vla_zenoh.codec import settings
from vla_zenoh.errors import CodecError
from vla_zenoh.types import HeldBox

DECODERS: dict[str, Callable[[bytes], Any]] = {
    "text": settings.decode_text,
    "bool": settings.decode_bool,
    "rate": settings.decode_rate,
    "percent": settings.decode_percent,
    "name": settings.decode_name,
    "seed": settings.decode_seed,
}
REASONS = {"oversize", "malformed", "invalid"}

by_decoder = pytest.mark.parametrize("decode", DECODERS.values(), ids=DECODERS)


@by_decoder
@given(
    payload=st.binary(max_size=80)
    | st.text(max_size=40).map(lambda t: t.encode("utf-8", "replace"))
)
def test_arbitrary_bytes_are_refused_or_read(
    decode: Callable[[bytes], Any], payload: bytes
) -> None:
    error = refusal(decode, payload)
    assert error is None or error.reason in REASONS


@by_decoder
@pytest.mark.parametrize(
    ("payload", "reason"),
    [
        (b"\xff\xfe", "malformed"),
        (b"\xed\xa0\x80", "malformed"),  # a surrogate
        (b"a\x00b", "invalid"),
        (b"a\x1b[2Jb", "invalid"),
        ("a\x9b2Jb".encode(), "invalid"),  # the same in one character
        (b"a\x7fb", "invalid"),
        (b"x" * (settings.MAX_SETTING_BYTES + 1), "oversize"),
        (b"x" * (settings.MAX_SETTING_BYTES - 1), "oversize"),
    ],
)
def test_what_is_no_text_is_no_setting(
    decode: Callable[[bytes], Any], payload: bytes, reason: str
) -> None:
    with pytest.raises(CodecError) as caught:
        decode(payload)
    assert caught.value.reason == reason
    assert len(str(caught.value)) < 300


def test_a_prompt_may_be_in_any_language_and_on_several_lines() -> None:
    prompt = "lege den roten Stein\nin die Kiste 箱 🧱"
    assert settings.decode_text(f"  {prompt}\r\n".encode()) == prompt
    assert settings.decode_text(b"") == ""


@pytest.mark.parametrize("word", ["true", "TRUE", " True\n", "1", "on", "yes"])
def test_words_for_yes(word: str) -> None:
    assert settings.decode_bool(word.encode()) is True


@pytest.mark.parametrize("word", ["false", "False", "0", "off", "no"])
def test_words_for_no(word: str) -> None:
    assert settings.decode_bool(word.encode()) is False


@pytest.mark.parametrize("word", ["", "2", "maybe", "truefalse", "1.0", "'true'", "null"])
def test_nothing_else_switches_a_robot_on_or_off(word: str) -> None:
    with pytest.raises(CodecError, match="neither true nor false"):
        settings.decode_bool(word.encode())


@given(st.booleans())
def test_a_switch_comes_back_as_it_was(value: bool) -> None:
    assert settings.decode_bool(str(value).lower().encode()) is value


@pytest.mark.parametrize(
    ("word", "rate_hz"),
    [("5", 5.0), ("0.05", 0.05), ("1e1", 10.0), ("+2.", 2.0), (".5", 0.5), (" 100 ", 100.0)],
)
def test_a_rate_is_a_plain_number(word: str, rate_hz: float) -> None:
    assert settings.decode_rate(word.encode()) == rate_hz


@pytest.mark.parametrize(
    "word", ["", "fast", "5 Hz", "1_0", "\u0665", "0x5", "nan", "inf", "5,0", "True"]
)
def test_what_is_no_plain_number_is_no_rate(word: str) -> None:
    with pytest.raises(CodecError, match=r"is not a number: give 0\.05 to 100 chunks per second"):
        settings.decode_rate(word.encode())


@pytest.mark.parametrize("word", ["0", "-5", "0.049", "100.1", "1e999"])
def test_a_rate_stays_within_bounds(word: str) -> None:
    with pytest.raises(CodecError, match=r"out of range: give 0\.05 to 100"):
        settings.decode_rate(word.encode())


@pytest.mark.parametrize(
    ("word", "percent"),
    [("30", 30.0), ("30 %", 30.0), ("30%\n", 30.0), ("0", 0.0), (" 100 ", 100.0), ("12.5", 12.5)],
)
def test_a_speed_is_a_number_of_percent(word: str, percent: float) -> None:
    assert settings.decode_percent(word.encode()) == percent


@pytest.mark.parametrize("word", ["", "%", "slow", "30 % %", "% 30", "nan", "0x5", "5,0", "true"])
def test_what_is_no_percentage_is_no_speed(word: str) -> None:
    with pytest.raises(CodecError, match="is not a percentage: give a number from 0 to 100"):
        settings.decode_percent(word.encode())


@pytest.mark.parametrize("word", ["-1", "100.1 %", "1e999", "1e3"])
def test_a_speed_is_never_more_than_planned_nor_less_than_none(word: str) -> None:
    with pytest.raises(CodecError, match=r"is out of range: give 0 to 100 percent"):
        settings.decode_percent(word.encode())


@given(st.text(st.sampled_from("abzAZ09_.-/*$ é"), max_size=8))
def test_a_name_that_is_read_can_stand_in_a_key(word: str) -> None:
    try:
        name = settings.decode_name(word.encode())
    except CodecError:
        return
    assert keys.Keys("panda").delta(name).endswith(f"/delta/{name}")


@pytest.mark.parametrize("word", ["", ".hidden", "-dash", "a/b", "*", "a b", "é", "x" * 65])
def test_what_cannot_stand_in_a_key_is_no_name(word: str) -> None:
    with pytest.raises(CodecError, match=r"worker name .* cannot be part of a key"):
        settings.decode_name(word.encode())


def test_a_seed_is_nothing_or_a_whole_number() -> None:
    assert settings.decode_seed(b"") is None
    assert settings.decode_seed(b" 42\n") == 42
    for word in ("-1", "1.5", "x", "\u0665", "1" * 11, "²"):
        with pytest.raises(CodecError, match="is not a seed"):
            settings.decode_seed(word.encode())


def test_what_a_gripper_holds_is_a_size_and_may_have_a_place() -> None:
    assert settings.decode_held(b"0.04 0.04 0.12") == HeldBox((0.04, 0.04, 0.12))
    found = settings.decode_held(b" .04,.04,.12 at 0, 0, -2e-2\n")
    assert found == HeldBox((0.04, 0.04, 0.12), (0.0, 0.0, -0.02))
    assert settings.decode_held(str(found).encode()) == found
    assert settings.decode_held(b"") == ""


@pytest.mark.parametrize("word", ["0.1", "0.1 0.1", "a b c", "1 1 1 1", "nan 1 1", "1 1 1 at 1 1"])
def test_what_is_no_box_is_rejected_with_an_example(word: str) -> None:
    with pytest.raises(CodecError, match=r"is no box: give its size .* such as '0.04"):
        settings.decode_held(word.encode())


@pytest.mark.parametrize("word", ["0 1 1", "-1 1 1", "40 40 120", "0.1 0.1 0.1 at 2 0 0"])
def test_a_held_box_in_millimetres_or_without_a_size_is_rejected(word: str) -> None:
    with pytest.raises(CodecError, match=r"out of range: edges 0.001 to 1 m"):
        settings.decode_held(word.encode())
