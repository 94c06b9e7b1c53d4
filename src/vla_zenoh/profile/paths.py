"""Files that a profile names are looked for beside it, wherever a node is started."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from vla_zenoh.resources import ROBOT_DATA_PREFIX, is_path

FILE_SOURCE = "file:"


def anchor(data: dict[str, Any], folder: Path) -> None:
    """Make the relative paths in `data` absolute, in place; what is no text is left to the schema.

    Args:
        data: as a profile file has it.
        folder: where that file is.
    """
    for section, name, prefix in list(paths_in(data)):
        section[name] = prefix + below(folder, section[name].removeprefix(prefix))


def paths_in(data: dict[str, Any]) -> Iterator[tuple[dict[str, Any], str, str]]:
    """Where `data` names files: (section, name in it, what stands before the path there).

    These are ``robot.description``, ``arm.file``, ``ros2.messages.*``, those of ``models.*`` that
    are no names, and ``cameras.*.source`` of the form ``file:PATH``.
    """
    robot, arm, ros2 = (_map(data.get(name)) for name in ("robot", "arm", "ros2"))
    description = robot.get("description")
    if isinstance(description, str) and not description.startswith(ROBOT_DATA_PREFIX):
        yield robot, "description", ""
    for camera in map(_map, _map(data.get("cameras")).values()):
        source = camera.get("source")
        if isinstance(source, str) and source.startswith(FILE_SOURCE):
            yield camera, "source", FILE_SOURCE
    if isinstance(arm.get("file"), str):
        yield arm, "file", ""
    models, messages = _map(data.get("models")), _map(ros2.get("messages"))
    for name, model in models.items():
        if isinstance(model, str) and is_path(model):
            yield models, name, ""
    for name, path in messages.items():
        if isinstance(path, str):
            yield messages, name, ""


def below(folder: Path, path: str) -> str:
    """`path` as a profile in `folder` means it."""
    # An empty one is refused later, and ~ is the home of whoever reads the file.
    if not path or path.startswith("~"):
        return path
    return os.path.normpath(folder.absolute() / path)


def _map(value: Any) -> dict[str, Any]:
    return value if isinstance(value, dict) else {}
