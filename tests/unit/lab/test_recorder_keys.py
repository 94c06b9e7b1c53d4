"""Which keys a recorder listens to."""

from __future__ import annotations

import pytest

from vla_zenoh.keys import Keys, covers
from vla_zenoh.lab.recording.recorder import recorded_keys

KEYS = Keys("panda")
RAW = KEYS.camera_raw("front")
OTHERS = (
    KEYS.camera_jpeg("front"),
    KEYS.state_pose,
    KEYS.command_pose,
    KEYS.delta("scripted"),
    KEYS.seen("scripted", "front"),
    KEYS.status("command"),
    KEYS.prompt,
)


def heard(expressions: tuple[str, ...], key: str) -> int:
    """How often a sample on `key` is recorded."""
    return sum(covers(expression, key) for expression in expressions)


@pytest.mark.parametrize("raw", [False, True])
def test_without_keys_everything_is_recorded_once_and_raw_pictures_by_their_switch(
    raw: bool,
) -> None:
    expressions = recorded_keys(KEYS, raw=raw)
    assert [heard(expressions, key) for key in OTHERS] == [1] * len(OTHERS)
    assert heard(expressions, RAW) == int(raw)


def test_keys_are_in_place_of_everything_and_raw_pictures_come_to_them() -> None:
    given = ("state/*", KEYS.prompt)
    assert recorded_keys(KEYS, given) == ("vla/panda/state/*", "vla/panda/prompt")
    assert recorded_keys(KEYS, given, raw=True)[-1] == "vla/panda/camera/*/raw"


def test_what_two_expressions_mean_is_recorded_once() -> None:
    expressions = recorded_keys(KEYS, ("**", "state/*", "state/pose", "state/*"), raw=True)
    assert heard(expressions, KEYS.state_pose) == heard(expressions, RAW) == 1
