"""Lengths in millimetres and angles in degrees are refused in every field of every section."""

from __future__ import annotations

import re
import typing
from collections.abc import Iterator
from functools import cache
from typing import Any

import pytest
from pydantic import ValidationError

from vla_zenoh import plugins
from vla_zenoh.plugins import RobotPlugin
from vla_zenoh.profile import Profile, load_profile
from vla_zenoh.profile.robot import GripperProfile, RobotProfile
from vla_zenoh.profile.section import Section

MILLIMETRES, DEGREES = 1000.0, 200.0
LENGTH, ANGLE = re.compile(r"(?<!_n)_m$"), re.compile(r"(?<!_nm)_rad$|_rotvec$")
BY_THE_DESCRIPTION = {"locked_rad"}
"""Ranges of the joints judge these: `CHECKED` of `wrong_profiles`."""


@cache
def good(section: type[Section]) -> dict[str, Any]:
    """What else such a section has to have."""
    robot = load_profile("panda_sim").robot
    wholes: dict[type[Section], Any] = {RobotProfile: robot, GripperProfile: robot.gripper}
    whole = wholes.get(section)
    return {} if whole is None else whole.model_dump()


def sections(annotation: Any) -> Iterator[type[Section]]:
    if isinstance(annotation, type) and issubclass(annotation, Section):
        yield annotation
        for field in annotation.model_fields.values():
            yield from sections(field.annotation)
    for inner in typing.get_args(annotation):
        yield from sections(inner)


def fields() -> dict[str, tuple[type[Section], str, float]]:
    drivers: list[RobotPlugin] = list(plugins.load_all(plugins.ROBOTS).values())
    tops = [Profile, *(driver.options for driver in drivers if driver.options)]
    found: dict[str, tuple[type[Section], str, float]] = {}
    for section in dict.fromkeys(inner for top in tops for inner in sections(top)):
        for name in section.model_fields:
            length, angle = LENGTH.search(name), ANGLE.search(name)
            if (length or angle) and name not in BY_THE_DESCRIPTION:
                wrong = MILLIMETRES if length else DEGREES
                found[f"{section.__name__}.{name}"] = section, name, wrong
    return found


FIELDS = fields()


def test_drivers_have_fields_of_their_own() -> None:
    assert {"UrOptions.tcp_m", "FrankaLoad.centre_m", "PartBase.position_m"} <= FIELDS.keys()


@pytest.mark.parametrize("where", FIELDS)
def test_another_unit_is_refused_with_its_number(where: str) -> None:
    section, name, value = FIELDS[where]
    said = ""
    for form in (value, [value] * 3, [-value, value], [value] * 7, [[-value, value]] * 7):
        with pytest.raises(ValidationError) as caught:
            section.model_validate({**good(section), name: form})
        said += str(caught.value)
    assert any(why in said for why in ("than or equal to", "give metres", "give radians")), said
