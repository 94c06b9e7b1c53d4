"""Declarations of the robot drivers ``sim`` and ``arm``; see `vla_zenoh.plugins`."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from pydantic import Field

from vla_zenoh.errors import VlaZenohError
from vla_zenoh.plugins import Fault, RobotPlugin
from vla_zenoh.profile.profile import Profile
from vla_zenoh.profile.robot import Options
from vla_zenoh.profile.section import Section, Word

if TYPE_CHECKING:  # numpy: who only reads a profile does not need it
    from vla_zenoh.robot import Robot


class ArmOptions(Section):
    """A robot that is driven by a Python class, see `vla_zenoh.robot`.

    Args:
        file: the Python file.
        options: of its constructor.
    """

    file: Word
    options: Options = Field(default_factory=dict)

    @property
    def path(self) -> Path:
        return Path(self.file).expanduser()


# Every command that reads a profile imports this file, so the loader of models is imported below.
def _make(profile: Profile, options: ArmOptions) -> Robot:
    from vla_zenoh.policy.loader import make_robot

    return make_robot(options.path, options.options)


def _script(options: ArmOptions) -> Path | None:
    return options.path if options.path.is_file() else None  # `_make` reports that it is missing


def _check(profile: Profile, options: ArmOptions) -> Iterator[Fault]:
    """Faults of the class in the file, which is not made: that may move something."""
    from vla_zenoh.policy.loader import IS_ROBOT, find_model, find_robot_maker, is_robot

    if not options.path.is_file():
        yield ("arm", "file"), f"there is no file {options.file}"
        return
    try:
        if find_model(str(options.path)).missing():
            return  # its header asks for an environment of its own, in which the node looks
        maker = find_robot_maker(options.path)
        maker.options.check(options.options, maker.where)
        if not is_robot(maker.function):
            yield ("arm",), f"{maker.where} {IS_ROBOT}"
    except VlaZenohError as error:
        yield ("arm",), str(error)


SIM = RobotPlugin()
ARM = RobotPlugin(make=_make, options=ArmOptions, paths=("file",), script=_script, check=_check)
