"""Which keys a recorder listens to."""

from __future__ import annotations

from itertools import product

import pytest

from vla_zenoh.bus.session import covers
from vla_zenoh.keys import Keys
from vla_zenoh.lab.recording.record_types import record_of
from vla_zenoh.lab.recording.recorder import recorded_keys
from vla_zenoh.profile import load_profile
from vla_zenoh.types import JointCommand, PoseState

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


@pytest.mark.parametrize("raw", [False, True])
def test_states_and_commands_of_every_part_are_recorded_once_as_their_records(raw: bool) -> None:
    pair = load_profile("two_pandas_sim")
    expressions = recorded_keys(pair.keys_of_all_parts, raw=raw)
    for part, kind in product(pair.part_names, (PoseState, JointCommand)):
        keys = pair.keys.of_part(part)
        key = keys.state_pose if kind is PoseState else keys.command_joint
        assert heard(expressions, key) == 1
        assert record_of(pair.keys.short(key)) is kind
    assert heard(expressions, pair.keys.camera_jpeg("top")) == 1
    assert heard(expressions, pair.keys.camera_raw("top")) == int(raw)
    assert record_of(pair.keys.short(pair.keys.camera_jpeg("state"))) is None


def test_keys_are_in_place_of_everything_and_raw_pictures_come_to_them() -> None:
    given = ("state/*", KEYS.prompt)
    assert recorded_keys(KEYS, given) == ("vla/panda/state/*", "vla/panda/prompt")
    assert recorded_keys(KEYS, given, raw=True)[-1] == "vla/panda/camera/*/raw"


def test_what_two_expressions_mean_is_recorded_once() -> None:
    expressions = recorded_keys(KEYS, ("**", "state/*", "state/pose", "state/*"), raw=True)
    assert heard(expressions, KEYS.state_pose) == heard(expressions, RAW) == 1
