"""All keys of a robot: they differ, can be told apart, and nothing odd gets into them."""

from __future__ import annotations

import re

import pytest
import zenoh
from hypothesis import given
from hypothesis import strategies as st

from vla_zenoh.errors import ProfileError
from vla_zenoh.keys import DEFAULT_ROOT, KEY_PATHS, MAX_CHUNK, Keys, key_chunk, last_chunk
from vla_zenoh.lab.recording.record_types import group_of, part_of

MAX_SENTENCE = 1000  # characters of an error message

KEYS = Keys("panda")
GOOD_CHUNKS = st.from_regex(r"[A-Za-z0-9_][A-Za-z0-9_.-]{0,20}", fullmatch=True)


def fixed_keys(keys: Keys) -> dict[str, str]:
    """Every key that needs no name, by the name of its member."""
    return {n: getattr(keys, n) for n, path in KEY_PATHS.items() if not path.parameters}


def named_keys(keys: Keys, name: str) -> dict[str, str]:
    """Every key that takes names, made with `name`."""
    named = {n: len(path.parameters) for n, path in KEY_PATHS.items() if path.parameters}
    return {member: getattr(keys, member)(*[name] * count) for member, count in named.items()}


def test_there_are_keys_of_both_sorts() -> None:
    assert len(fixed_keys(KEYS)) > 10
    assert len(named_keys(KEYS, "x")) > 5


@given(GOOD_CHUNKS)
def test_no_two_keys_are_the_same(name: str) -> None:
    everything = [*fixed_keys(KEYS).values(), *named_keys(KEYS, name).values()]
    assert len(set(everything)) == len(everything)


@given(GOOD_CHUNKS, GOOD_CHUNKS)
def test_every_key_is_one_that_zenoh_takes_as_it_is(robot: str, name: str) -> None:
    keys = Keys(robot, root=f"lab/{name}")
    for key in [*fixed_keys(keys).values(), *named_keys(keys, name).values()]:
        assert str(zenoh.KeyExpr(key)) == key
        assert str(zenoh.KeyExpr.autocanonize(key)) == key


def test_selectors_find_their_own_keys_and_no_others() -> None:
    named = named_keys(KEYS, "scripted")
    own = {
        "all_deltas": named["delta"],
        "all_specs": named["spec"],
        "all_seen": named["seen"],
        "all_seen_records": named["seen_record"],
        "all_status": named["status"],
        "all_events": named["event"],
        "all_alive": named["alive"],
        "all_holding": named["holding"],
    }
    every = [*fixed_keys(KEYS).values(), *named.values()]
    for selector, key in own.items():
        expression = zenoh.KeyExpr(getattr(KEYS, selector))
        assert [k for k in every if expression.intersects(zenoh.KeyExpr(k))] == [key]
    assert all(zenoh.KeyExpr(KEYS.all_keys).includes(zenoh.KeyExpr(k)) for k in every)


def test_two_robots_never_meet() -> None:
    one, other = zenoh.KeyExpr(KEYS.all_keys), zenoh.KeyExpr(Keys("panda2").all_keys)
    assert not one.intersects(other)


@pytest.mark.parametrize(
    "name",
    [
        "",
        ".",
        ".a",
        "-a",
        "a/b",
        "a*",
        "**",
        "$*",
        "a?b",
        "a#b",
        "@a",
        "a b",
        "é",
        "a\n",
        "a\0",
        "x" * 65,
    ],
)
def test_what_would_mean_something_to_zenoh_is_refused(name: str) -> None:
    with pytest.raises(ProfileError, match=r"camera name .* use letters, digits"):
        KEYS.camera_raw(name)
    with pytest.raises(ProfileError, match="cannot be part of a key"):
        Keys(name)
    with pytest.raises(ProfileError, match=r"root .* cannot be part of a key"):
        Keys("panda", root=f"lab/{name}" if name != "a/b" else "lab/*")


@given(st.text(max_size=80))
def test_a_name_is_taken_whole_or_not_at_all(name: str) -> None:
    if 0 < len(name) <= MAX_CHUNK and name.isascii() and re.fullmatch(r"\w[\w.-]*", name):
        assert key_chunk(name, "name") == name
        return
    with pytest.raises(ProfileError) as caught:
        key_chunk(name, "name")
    assert len(str(caught.value)) < MAX_SENTENCE


def test_a_key_is_shortened_as_people_say_it() -> None:
    assert KEYS.delta("scripted") == f"{DEFAULT_ROOT}/panda/delta/scripted"
    assert KEYS.short(KEYS.delta("scripted")) == "delta/scripted"
    assert KEYS.short("vla/panda2/active") == "vla/panda2/active"
    assert last_chunk(KEYS.delta("scripted")) == "scripted"


def test_a_key_is_told_from_those_of_other_robots() -> None:
    ours, theirs = Keys("panda", "lab/a"), Keys("ur5", "lab/b")
    key = ours.camera_jpeg("front")
    assert Keys.of(key, "lab/a") == ours
    assert Keys.of(key, "lab/b") is None
    assert Keys.of("lab/a/panda", "lab/a") is None
    assert Keys.of("lab/a/-/prompt", "lab/a") is None
    assert group_of(ours, key) == "camera"
    assert group_of(ours, ours.prompt) == "prompt"
    assert group_of(theirs, key) == ""
    left = ours.of_part("left").state_pose
    assert (group_of(ours, left), part_of(ours, left)) == ("state", "left")
    assert [part_of(ours, each) for each in (key, ours.prompt, ours.state_pose)] == ["", "", ""]
    assert part_of(theirs, left) == ""
    assert theirs.full(ours.short(key)) == theirs.camera_jpeg("front")


def test_a_short_key_is_made_whole_and_a_whole_one_left() -> None:
    ours = Keys("panda")
    assert ours.full("state/*") == "vla/panda/state/*"
    assert ours.full(ours.short(ours.state_pose)) == ours.state_pose
    assert ours.full("vla/ur5/**") == "vla/ur5/**"


def test_a_recorder_hears_everything_but_raw_pictures() -> None:
    ours = Keys("panda")
    expressions = [zenoh.KeyExpr(each) for each in ours.without_raw_images]

    def heard(key: str) -> int:
        return sum(each.includes(zenoh.KeyExpr(key)) for each in expressions)

    for key in (ours.prompt, ours.state_pose, ours.delta("w"), ours.seen_record("w")):
        assert heard(key) == 1, key
    assert heard(ours.camera_jpeg("front")) == 1
    assert heard(ours.seen("w", "front")) == 1
    assert heard(ours.camera_raw("front")) == 0
