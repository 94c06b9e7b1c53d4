"""The part of a profile that says which Python file moves the robot."""

from __future__ import annotations

from typing import Annotated

from pydantic import AfterValidator, Field

from vla_zenoh.profile.section import Section, Text, Word


def _option(value: str) -> str:
    if not value.isidentifier():
        raise ValueError(f"{value[:80]!r} cannot be the name of an option")
    return value


Options = dict[Annotated[str, AfterValidator(_option)], Text]
"""Given by name, as text, to the constructor of a class in a file."""


class ArmProfile(Section):
    """A robot that is moved by a class of one's own, see `vla_zenoh.robot`.

    Args:
        file: the Python file.
        options: for its constructor.
    """

    file: Word
    options: Options = Field(default_factory=dict)
