"""What a stop needs of a profile: the way to the router, the robot's name, and who people are.

The rest is not checked: an arm is stopped although a camera is misspelt or a plug-in is missing.
"""

from __future__ import annotations

from typing import Annotated, Any

from pydantic import AfterValidator, ConfigDict, Field

from vla_zenoh import keys
from vla_zenoh.keys import Keys
from vla_zenoh.profile.load import checked, read_file
from vla_zenoh.profile.profile import checked_root
from vla_zenoh.profile.schema import SIMULATED, SessionProfile
from vla_zenoh.profile.section import Name, Section, Word, Words
from vla_zenoh.resources import profile_file


class Extract(Section):
    """A section of which some values are read."""

    model_config = ConfigDict(extra="ignore")


class RobotName(Extract):
    """The robot, by name."""

    name: Name


class HostNodes(Extract):
    """The kinds of nodes of a host: people at that of the command node are operators."""

    nodes: Words


class StopProfile(Extract):
    """What a stop needs of a profile; see `Profile`."""

    name: Name
    root: Annotated[Word, AfterValidator(checked_root)] = keys.DEFAULT_ROOT
    robot: RobotName
    parts: dict[Name, Any] = Field(default_factory=dict)
    session: SessionProfile = SessionProfile()
    hosts: dict[Name, HostNodes] = Field(
        default_factory=lambda: {"here": HostNodes(nodes=SIMULATED)}
    )

    @property
    def keys(self) -> Keys:
        return Keys(self.robot.name, self.root)

    @property
    def part_names(self) -> tuple[str, ...]:
        return tuple(self.parts) or ("",)


def load_for_stop(name: str, changes: dict[str, Any]) -> StopProfile:
    """The extract of profile `name`, which may be a path, with `changes` as in a profile file.

    Raises:
        ProfileError: one of these values is wrong; each with file and line.
    """
    path = profile_file(name)
    data, lines = read_file(path, changes)
    data.setdefault("name", path.stem)
    return checked(StopProfile, data, lines)
